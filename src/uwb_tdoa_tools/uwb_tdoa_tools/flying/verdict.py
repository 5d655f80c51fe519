# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge flights by ground truth, and report many of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_ekf.results import rows_of

from ..scoring.metrics import nees, position_at, rms
from .mission import DONE, REFUSED
from .rover import Drive
from .trial import REST_AFTER
from .vehicle import POSITION, VELOCITY

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from uwb_tdoa_bias.common.flight import Truth
    from uwb_tdoa_ekf.results import Odometry

    from .mission import Mission
    from .trial import TrialResult


AIR = 0.3  # m above the ground, least height in the air
UPRIGHT = math.radians(30.0)
NEAR, SLOW = 0.3, 0.6  # m from the wanted place and m/s at touchdown, limits of a landing
GENTLE = 1.0  # m/s at touchdown, limit of a safe landing
LOST = 1.0  # m, error of a lost estimate
SPACING = 0.02  # s between judged estimates
PHASES = "before", "lift_off", "air", "landing", "after"
DRIVE_PHASES = "before", "drive", "after"


def verdict_of(flown: TrialResult) -> dict[str, Any]:
    """Return the verdict of a flight and its figures, for JSON.

    A figure is None if there is no value. Of two flights the figures are those of the last. A failure of
    the first one counts for both.

    A quadrotor has `landed` if it took off, stands upright within NEAR of the wanted place, and touched
    the ground slower than SLOW. A rover has `arrived` if it stands within NEAR of the last place and
    touched no wall.

    Parameters
    ----------
    flown : TrialResult

    Returns
    -------
    dict
        landed or arrived : bool.
        why : reason of the failure, or "".
        safe : no crash: it came down upright slower than GENTLE, or did not take off.
        place : distance to the wanted place, m.
        touchdown : speed, m/s.
        tracking, farthest : root mean square and largest distance to the wanted path, m.
        armed_off : error of the estimate at the start of the rotors, m.
        armed_deviations : largest error of a coordinate there, in standard deviations.
        lost : first time in the air with an error above LOST, s.
        reported_lost : time at which the vehicle noticed, s.
        yaw, yaw_nees : root mean square of the yaw error, degrees, and its NEES (rover).
        phases : figures of the estimate per phase.
    """
    if flown.task.vehicle == "rover":
        return _of_drive(flown)
    ends = [(mission.ended or math.inf) + REST_AFTER for mission in flown.missions]
    verdicts = [_of_mission(flown, mission, end) for mission, end in zip(flown.missions, ends)]
    failed = [one["why"] for one in verdicts if one["why"]]
    if flown.task.again and len(verdicts) == 1:
        failed = failed or ["did not fly again"]
    why = failed[0] if failed else ""
    if len(verdicts) > 1 and why:
        why = f"{'first' if verdicts[0]['why'] else 'second'} flight: {why}"
    return {"seed": flown.task.seed, "landed": not why, **verdicts[-1], "why": why}


def _of_mission(flown: TrialResult, mission: Mission, end: float) -> dict[str, Any]:
    """Return the figures of one Mission until `end`, s."""
    assert flown.flight.truth is not None
    truth = flown.flight.truth
    inside = slice(*np.searchsorted(truth.t, (mission.begin, end)))
    truth = rows_of(truth, inside)
    states, contact = flown.states[inside], flown.contact[inside]
    odometry = rows_of(
        flown.odometry, slice(*np.searchsorted(flown.odometry.t, (mission.begin, end)))
    )
    crash = flown.crash if mission is flown.missions[-1] else ""
    t, height = truth.t, states[:, 2] - mission.ground
    tilt = np.arccos(np.clip(1.0 - 2.0 * (states[:, 6] ** 2 + states[:, 7] ** 2), -1.0, 1.0))
    aloft = np.flatnonzero(height > AIR)
    took_off = bool(len(aloft))
    first: int | None = None
    last: int | None = None
    tracking: float | None = None
    touchdown: float | None = None
    if took_off:
        first, last = int(aloft[0]), int(aloft[-1])
        touched = last + np.flatnonzero(contact[last:] > 0)
        if len(touched):
            speeds = np.linalg.norm(states[last : touched[-1] + 1, VELOCITY], axis=1)
            onset = touched[(contact[touched - 1] == 0)]
            touchdown = float(speeds[np.maximum(onset - 1 - last, 0)].max())
        inside = slice(first, last + 1, 8)
        wanted = mission.wanted(t[inside])[:, 0]
        off = np.nan_to_num(states[inside, POSITION] - wanted)  # the descent has no wanted height
        tracking = rms(np.linalg.norm(off, axis=1))
    place = float(np.linalg.norm(states[-1, :2] - mission.place))
    figures = {
        "took_off": took_off,
        "place": place,
        "touchdown": touchdown,
        "upright": bool(tilt[-1] < UPRIGHT),
        "tracking": tracking,
        "started": mission.started,
        "ended": mission.ended,
        "reported_lost": mission.lost,
        "duration": float(t[-1]),
        **_armed(flown.odometry, flown.flight.truth, mission.started),
        **_estimation(odometry, truth, mission, first, last),
    }
    figures["why"] = _why(crash, mission, figures)
    gentle = not took_off or (
        mission.state == DONE and touchdown is not None and touchdown < GENTLE
    )
    figures["safe"] = bool(gentle and figures["upright"] and not crash)
    return figures


def _of_drive(flown: TrialResult) -> dict[str, Any]:
    """Return the verdict of a rover."""
    mission, truth = flown.missions[-1], flown.flight.truth
    assert isinstance(mission, Drive) and truth is not None
    end = float(truth.t[-1])
    started, ended = mission.started or end, mission.ended or end
    way = truth.p[(truth.t >= started) & (truth.t <= ended)][::8, :2]
    off = np.linalg.norm(way - mission.path.at(mission.path.nearest(way))[:, :2], axis=1)
    place = float(np.linalg.norm(truth.p[-1, :2] - mission.place))
    why = flown.crash or ("refused to start" if mission.state == REFUSED else "")
    if not why and mission.state != DONE:
        why = "did not arrive in time"
    if not why and place >= NEAR:
        why = "arrived elsewhere"
    kept = flown.odometry.t <= end
    odometry = rows_of(flown.odometry, kept)
    figures = {
        "seed": flown.task.seed,
        "arrived": not why,
        "why": why,
        "safe": not flown.crash,
        "place": place,
        "tracking": rms(off) if len(off) else None,
        "farthest": float(off.max()) if len(off) else None,
        "started": mission.started,
        "ended": mission.ended,
        "reported_lost": mission.lost,
        "duration": end,
        **_armed(flown.odometry, truth, mission.started),
    }
    if not len(odometry):
        return {**figures, "estimation": None, "yaw": None, "yaw_nees": None, "phases": {}}
    rows = np.unique(np.searchsorted(odometry.t, np.arange(odometry.t[0], odometry.t[-1], SPACING)))
    odometry = rows_of(odometry, rows)
    error = (odometry.p - position_at(odometry.t, truth))[:, :2]
    normalised = nees(error, odometry.covariance[:, :2, :2])
    phases = _by_phase(
        odometry.t,
        np.linalg.norm(error, axis=1),
        normalised,
        dict(zip(DRIVE_PHASES, (-math.inf, started, ended))),
    )
    under_way = (odometry.t >= started) & (odometry.t <= ended)
    yaw = np.interp(odometry.t, truth.t, np.unwrap(yaws_of(truth.q)))
    off_yaw = ((yaws_of(odometry.q) - yaw + np.pi) % (2.0 * np.pi) - np.pi)[under_way]
    variance = odometry.covariance[under_way, 8, 8]  # about the vertical, for a planar vehicle
    has_variance = len(off_yaw) > 0 and bool((variance > 0.0).all())
    drive = phases.get("drive")
    return {
        **figures,
        "estimation": drive and drive["rmse"],
        "yaw": math.degrees(rms(off_yaw)) if len(off_yaw) else None,
        "yaw_nees": float(np.mean(off_yaw**2 / variance)) if has_variance else None,
        "phases": phases,
    }


def yaws_of(q: np.ndarray) -> np.ndarray:
    """Return the yaws (n,), rad, of attitudes (n, 4) x y z w."""
    x, y, z, w = q.T
    out: np.ndarray = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))
    return out


def _why(crash: str, mission: Mission, figures: dict[str, Any]) -> str:
    """Return the reason of the failure, or ""."""
    if mission.state == REFUSED:
        return "refused to arm"
    if not figures["took_off"]:
        return f"{crash} on the ground" if crash else "did not take off"
    if crash:
        return crash
    if not figures["upright"]:
        return "not upright"
    if figures["touchdown"] is None or mission.ended is None:
        return "did not come down"
    if figures["touchdown"] >= SLOW:
        return "came down hard"
    return "landed elsewhere" if figures["place"] >= NEAR else ""


def _armed(odometry: Odometry, truth: Truth, started: float | None) -> dict[str, float | None]:
    """Return the error of the estimate at the start of the rotors."""
    if started is None:
        return {"armed_off": None, "armed_deviations": None}
    k = int(np.searchsorted(odometry.t, started, side="right")) - 1
    error = odometry.p[k] - position_at(odometry.t[k : k + 1], truth)[0]
    deviations = float(np.max(np.abs(error) / np.sqrt(np.diag(odometry.covariance[k])[:3])))
    return {
        "armed_off": float(np.linalg.norm(error)),
        "armed_deviations": deviations if math.isfinite(deviations) else None,
    }


def _estimation(
    odometry: Odometry, truth: Truth, mission: Mission, first: int | None, last: int | None
) -> dict[str, Any]:
    """Return the figures of the estimate per phase, and the time at which it was lost."""
    if not len(odometry):
        return {"lost": None, "estimation": None, "phases": {}}
    stamps = np.arange(odometry.t[0], odometry.t[-1], SPACING)
    rows = np.unique(np.searchsorted(odometry.t, stamps))
    rows = rows[np.isfinite(odometry.p[rows]).all(axis=1)]  # estimates of a peer may be NaN
    t = odometry.t[rows]
    error = odometry.p[rows] - position_at(t, truth)
    distance, covariance = np.linalg.norm(error, axis=1), odometry.covariance[rows, :3, :3]
    normalised = (
        nees(error, covariance) if np.isfinite(covariance).all() else np.full(len(error), np.nan)
    )  # a peer gives no covariance
    end = truth.t[-1]
    started, ended = mission.started or end, mission.ended or end
    up, down = (float(truth.t[k]) if k is not None else ended for k in (first, last))
    limits = [-math.inf, started, max(up, started), max(down, started), max(ended, down)]
    phases = _by_phase(t, distance, normalised, dict(zip(PHASES, limits)))
    far = np.flatnonzero((distance > LOST) & (t >= started) & (t < ended))
    air = phases.get("air")
    return {
        "lost": float(t[far[0]]) if len(far) else None,
        "estimation": air and air["rmse"],
        "phases": phases,
    }


def _by_phase(
    t: np.ndarray, distance: np.ndarray, normalised: np.ndarray, begins: dict[str, float]
) -> dict[str, dict[str, float | None]]:
    """Return figures per phase of estimates at t (n,) s.

    `begins` holds the start of each phase, s. A phase lasts until the next.
    """
    stops = [*list(begins.values())[1:], math.inf]
    inside = {name: (t >= begins[name]) & (t < stop) for name, stop in zip(begins, stops)}
    return {
        name: _figures(distance[rows], normalised[rows])
        for name, rows in inside.items()
        if rows.any()
    }


def _figures(distance: np.ndarray, normalised: np.ndarray) -> dict[str, float | None]:
    usable = normalised[np.isfinite(normalised)]
    return {
        "rmse": rms(distance),
        "largest": float(distance.max()),
        "nees": float(usable.mean()) if len(usable) else None,
    }


OVERCONFIDENT = 3.0  # standard deviations of a coordinate


@dataclass(frozen=True)
class Wording:
    """Hold the words for verdicts of a vehicle.

    Parameters
    ----------
    goal, begun : str
        Keys of success and start.
    phases : tuple of str
    figures : dict
        Descriptions of the figures. "" hides a figure.
    """

    goal: str
    begun: str
    phases: tuple[str, ...]
    figures: dict[str, str]


QUADROTOR = Wording(
    "landed",
    "armed",
    PHASES,
    {
        "armed_off": "estimate off when armed, m",
        "tracking": "off the path in the air, m",
        "estimation": "",
        "place": "landed from the wanted place, m",
        "touchdown": "touchdown, m/s",
    },
)
ROVER = Wording(
    "arrived",
    "started",
    DRIVE_PHASES,
    {
        "armed_off": "estimate off when started, m",
        "tracking": "off the path, m",
        "farthest": "largest distance to the path, m",
        "estimation": "",
        "place": "stopped from the wanted place, m",
        "yaw": "yaw off, degrees",
        "yaw_nees": "NEES of the yaw",
    },
)


def wording_of(verdict: dict[str, Any]) -> Wording:
    """Return the words for a verdict or a summary."""
    return ROVER if ROVER.goal in verdict else QUADROTOR


def reached(verdict: dict[str, Any]) -> bool:
    """Return whether a vehicle has landed or arrived."""
    return bool(verdict[wording_of(verdict).goal])


def summary(verdicts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return counts, medians and extremes of the figures, for JSON.

    Parameters
    ----------
    verdicts : sequence of dict
        Verdicts of one vehicle, see `verdict_of`.
    """
    wording = wording_of(verdicts[0])
    out = {"flights": len(verdicts), wording.goal: sum(one[wording.goal] for one in verdicts)}
    out["why"] = dict(Counter(one["why"] for one in verdicts if one["why"]).most_common())
    out["safe"] = sum(one["safe"] for one in verdicts)
    out["armed"] = sum(one["started"] is not None for one in verdicts)
    known = [one["armed_deviations"] for one in verdicts if one["armed_deviations"] is not None]
    out["armed_beyond_three_deviations"] = (
        sum(value > OVERCONFIDENT for value in known) if known else None
    )  # a peer gives no covariance
    out["reported_lost"] = sum(one["reported_lost"] is not None for one in verdicts)
    for name in wording.figures:
        out[name] = _spread([one[name] for one in verdicts])
    for phase in wording.phases:
        mine = [one["phases"][phase] for one in verdicts if phase in one["phases"]]
        out[phase] = {
            name: _spread([one[name] for one in mine]) for name in ("rmse", "largest", "nees")
        }
    return out


def _spread(values: Iterable[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {
        "median": float(np.median(known)),
        "least": float(min(known)),
        "most": float(max(known)),
    }


def text(summed: dict[str, Any]) -> str:
    """Return a summary as lines of text."""
    wording = wording_of(summed)
    goal = wording.goal
    lines = [f"{summed[goal]} of {summed['flights']} {goal}; {summed['safe']} without a crash"]
    lines += [f"  {count} {why}" for why, count in summed["why"].items()]
    beyond = summed["armed_beyond_three_deviations"]
    lines.append(
        f"{wording.begun} {summed['armed']}, of these {'?' if beyond is None else beyond} while the "
        "estimate was more than three of its "
        f"deviations off; {summed['reported_lost']} said that they were lost"
    )
    for name, what in wording.figures.items():
        if what:
            lines.append(f"{what:34s}{_range(summed[name])}")
    lines.append(f"{'estimate':10s}{'rmse, m':>24s}{'largest, m':>24s}{'NEES':>24s}")
    for phase in wording.phases:
        lines.append(
            f"{phase:10s}"
            + "".join(f"{_range(summed[phase][name]):>24s}" for name in ("rmse", "largest", "nees"))
        )
    return "\n".join(lines)


def sentence(verdict: dict[str, Any]) -> str:
    """Return a verdict as a sentence."""
    goal = wording_of(verdict).goal
    if not verdict[goal]:
        return f"not {goal}: {verdict['why']}"
    if goal == ROVER.goal:
        return (
            f"arrived {verdict['place']:.2f} m from the wanted place, "
            f"{verdict['tracking']:.2f} m off the path"
        )
    figures = f"{verdict['place']:.2f} m from the wanted place at {verdict['touchdown']:.2f} m/s"
    return f"landed {figures}, in the air {verdict['tracking']:.2f} m off the path"


def _range(spread: dict[str, float] | None) -> str:
    return (
        "-"
        if spread is None
        else f"{spread['median']:.2f} ({spread['least']:.2f} - {spread['most']:.2f})"
    )
