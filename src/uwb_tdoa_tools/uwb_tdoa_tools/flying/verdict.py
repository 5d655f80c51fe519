# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly tasks, judge the flights by ground truth, report many of them, and draw them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_picture
from uwb_tdoa_ekf.results import Odometry, rows_of

from ..bags.bag import write_bag
from ..scoring.metrics import nees, position_at, rms
from .mission import DONE, REFUSED, Journey, Mission, yaw_of
from .rover import Drive, drive
from .trial import REST_AFTER, Task, TrialResult, fly
from .vehicle import POSITION, VELOCITY

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
    times = flown.flight.known_truth.t
    inside = slice(*np.searchsorted(times, (mission.begin, end)))
    truth = rows_of(flown.flight.known_truth, inside)
    states, contact = flown.states[inside], flown.contact[inside]
    mine = slice(*np.searchsorted(flown.odometry.t, (mission.begin, end)))
    odometry = sampled(rows_of(flown.odometry, mine), SPACING)
    crash = flown.crash if mission is flown.missions[-1] else ""
    tilt = np.arccos(np.clip(1.0 - 2.0 * (states[:, 6] ** 2 + states[:, 7] ** 2), -1.0, 1.0))
    aloft = np.flatnonzero(states[:, 2] - mission.ground > AIR)
    took_off = bool(len(aloft))
    touchdown: float | None = None
    tracking: float | None = None
    stop = truth.t[-1]
    started, ended = mission.started or stop, mission.ended or stop
    up = down = ended
    if took_off:
        first, last = int(aloft[0]), int(aloft[-1])
        up, down = float(truth.t[first]), float(truth.t[last])
        touchdown = _touchdown(states[last:], contact[last:])
        air = slice(first, last + 1, 8)
        wanted = mission.wanted(truth.t[air])[:, 0]
        off = np.nan_to_num(states[air, POSITION] - wanted)  # the descent has no wanted height
        tracking = rms(np.linalg.norm(off, axis=1))
    begins = [-math.inf, started, max(up, started), max(down, started), max(ended, down)]
    error = odometry.p - position_at(odometry.t, truth)
    under_way = (odometry.t >= started) & (odometry.t < ended)
    far = odometry.t[(np.linalg.norm(error, axis=1) > LOST) & under_way]
    figures = {
        **_common(flown, mission, float(truth.t[-1])),
        **_estimation(odometry, error, dict(zip(PHASES, begins)), "air"),
        "took_off": took_off,
        "place": float(np.linalg.norm(states[-1, :2] - mission.place)),
        "touchdown": touchdown,
        "upright": bool(tilt[-1] < UPRIGHT),
        "tracking": tracking,
        "lost": float(far[0]) if len(far) else None,
    }
    figures["why"] = _why(crash, mission, figures)
    gentle = mission.state == DONE and touchdown is not None and touchdown < GENTLE
    figures["safe"] = bool((gentle or not took_off) and figures["upright"] and not crash)
    return figures


def _touchdown(states: np.ndarray, contact: np.ndarray) -> float | None:
    """Return the largest speed, m/s, before feet touch the ground, or None if none do.

    Parameters
    ----------
    states, contact : numpy.ndarray
        States (n, 17) and numbers of feet on the ground (n,), from the last instant in the air on.
    """
    before = np.flatnonzero((contact[:-1] == 0) & (contact[1:] > 0))
    if not len(before):
        return None
    return float(np.linalg.norm(states[before, VELOCITY], axis=1).max())


def _of_drive(flown: TrialResult) -> dict[str, Any]:
    """Return the verdict of a rover."""
    mission, truth = flown.missions[-1], flown.flight.known_truth
    assert isinstance(mission, Drive)
    end = float(truth.t[-1])
    started, ended = mission.started or end, mission.ended or end
    way = truth.p[(truth.t >= started) & (truth.t <= ended)][::8, :2]
    off = np.linalg.norm(way - mission.path.at(mission.path.nearest(way))[:, :2], axis=1)
    place = float(np.linalg.norm(truth.p[-1, :2] - mission.place))
    why = _first_reason(
        {
            flown.crash: flown.crash,
            "refused to start": mission.state == REFUSED,
            "did not arrive in time": mission.state != DONE,
            "arrived elsewhere": place >= NEAR,
        }
    )
    odometry = sampled(rows_of(flown.odometry, flown.odometry.t <= end), SPACING)
    error = (odometry.p - position_at(odometry.t, truth))[:, :2]
    under_way = (odometry.t >= started) & (odometry.t <= ended)
    yaw = np.interp(odometry.t, truth.t, np.unwrap(yaw_of(truth.q)))
    off_yaw = ((yaw_of(odometry.q) - yaw + np.pi) % (2.0 * np.pi) - np.pi)[under_way]
    variance = odometry.covariance[under_way, 8, 8]  # about the vertical, for a planar vehicle
    has_variance = len(off_yaw) > 0 and bool((variance > 0.0).all())
    begins = dict(zip(DRIVE_PHASES, (-math.inf, started, ended)))
    return {
        "seed": flown.task.seed,
        "arrived": not why,
        "why": why,
        "safe": not flown.crash,
        "place": place,
        "tracking": rms(off) if len(off) else None,
        "farthest": float(off.max()) if len(off) else None,
        **_common(flown, mission, end),
        **_estimation(odometry, error, begins, "drive"),
        "yaw": math.degrees(rms(off_yaw)) if len(off_yaw) else None,
        "yaw_nees": float(np.mean(off_yaw**2 / variance)) if has_variance else None,
    }


def _common(flown: TrialResult, mission: Journey, end: float) -> dict[str, Any]:
    """Return the times of a mission that was recorded until `end`, s, and the error at its start."""
    figures: dict[str, Any] = {
        "started": mission.started,
        "ended": mission.ended,
        "reported_lost": mission.lost,
        "duration": end,
        "armed_off": None,
        "armed_deviations": None,
    }
    if mission.started is None:
        return figures
    odometry, truth = flown.odometry, flown.flight.known_truth
    k = int(np.searchsorted(odometry.t, mission.started, side="right")) - 1
    error = odometry.p[k] - position_at(odometry.t[k : k + 1], truth)[0]
    deviations = float(np.max(np.abs(error) / np.sqrt(np.diag(odometry.covariance[k])[:3])))
    figures["armed_off"] = float(np.linalg.norm(error))
    if math.isfinite(deviations):
        figures["armed_deviations"] = deviations
    return figures


def _why(crash: str, mission: Mission, figures: dict[str, Any]) -> str:
    """Return the reason of the failure, or ""."""
    came_down = figures["touchdown"] is not None and mission.ended is not None
    return _first_reason(
        {
            "refused to arm": mission.state == REFUSED,
            f"{crash} on the ground": crash and not figures["took_off"],
            "did not take off": not figures["took_off"],
            crash: crash,
            "not upright": not figures["upright"],
            "did not come down": not came_down,
            "came down hard": came_down and figures["touchdown"] >= SLOW,
            "landed elsewhere": figures["place"] >= NEAR,
        }
    )


def _first_reason(reasons: dict[str, Any]) -> str:
    """Return the first reason that holds, or ""."""
    return next((reason for reason, holds in reasons.items() if holds), "")


def sampled(odometry: Odometry, spacing: float) -> Odometry:
    """Return the estimates of an Odometry, `spacing`, s, apart."""
    if not len(odometry):
        return odometry
    stamps = np.arange(odometry.t[0], odometry.t[-1], spacing)
    return rows_of(odometry, np.unique(np.searchsorted(odometry.t, stamps)))


def _estimation(
    odometry: Odometry, error: np.ndarray, begins: dict[str, float], scored: str
) -> dict[str, Any]:
    """Return the figures of the estimate for each phase, and the error of one phase.

    Parameters
    ----------
    odometry : Odometry
    error : numpy.ndarray
        Errors of k coordinates (n, k), m.
    begins : dict
        {phase: begin, s}. A phase lasts until the next.
    scored : str
        The phase of the error.
    """
    t, axes = odometry.t, error.shape[1]
    distance, covariance = np.linalg.norm(error, axis=1), odometry.covariance[:, :axes, :axes]
    normalised = nees(error, covariance)
    stops = [*list(begins.values())[1:], math.inf]
    inside = {name: (t >= begins[name]) & (t < stop) for name, stop in zip(begins, stops)}
    phases = {
        name: _figures(distance[rows], normalised[rows])
        for name, rows in inside.items()
        if rows.any()
    }
    return {"estimation": phases[scored]["rmse"] if scored in phases else None, "phases": phases}


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
    known = [one["armed_deviations"] for one in verdicts if one["armed_deviations"] is not None]
    out = {
        "flights": len(verdicts),
        wording.goal: sum(one[wording.goal] for one in verdicts),
        "why": dict(Counter(one["why"] for one in verdicts if one["why"]).most_common()),
        "safe": sum(one["safe"] for one in verdicts),
        "armed": sum(one["started"] is not None for one in verdicts),
        "armed_beyond_three_deviations": (
            sum(value > OVERCONFIDENT for value in known) if known else None
        ),
        "reported_lost": sum(one["reported_lost"] is not None for one in verdicts),
    }
    out |= {name: _spread([one[name] for one in verdicts]) for name in wording.figures}
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


DRAWN = 0.05  # s


@dataclass(frozen=True)
class DrawnFlight:
    """Hold the figures of a flight that are drawn.

    Parameters
    ----------
    t, p : numpy.ndarray
        Stamps (n,), s, and true positions (n, 3), m.
    wanted : numpy.ndarray
        Wanted positions (n, 3), m, or NaN.
    stamps, error, sigma : numpy.ndarray
        Stamps (k,), s, errors and standard deviations (k, 3), m, of the estimate.
    verdict : dict
        See `verdict_of`.
    """

    t: np.ndarray
    p: np.ndarray
    wanted: np.ndarray
    stamps: np.ndarray
    error: np.ndarray
    sigma: np.ndarray
    verdict: dict[str, Any]


def drawn_flight(result: TrialResult, verdict: dict[str, Any]) -> DrawnFlight:
    """Return the figures of a TrialResult to draw."""
    truth, odometry = result.flight.known_truth, sampled(result.odometry, DRAWN)
    every = max(1, round(DRAWN / (truth.t[1] - truth.t[0])))
    t, p = truth.t[::every], truth.p[::every]
    wanted = np.full(p.shape, np.nan)
    for mission in (mission for mission in result.missions if mission.started is not None):
        inside = (t >= mission.started) & (t <= (mission.ended or np.inf))
        wanted[inside] = mission.wanted(t[inside])[:, 0]
    error = odometry.p - position_at(odometry.t, truth)
    sigma = np.sqrt(np.einsum("nii->ni", odometry.covariance[:, :3, :3]))
    return DrawnFlight(t, p, wanted, odometry.t, error, sigma, verdict)


def plot(flights: Sequence[DrawnFlight], anchors: Anchors, path: str | Path) -> None:
    """Draw a map, all heights, and the errors of the worst flight to an image file.

    Parameters
    ----------
    flights : sequence of DrawnFlight
    anchors : Anchors
    path : str or Path
    """
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(14, 8), layout="constrained")
    left, right = figure.subfigures(1, 2)
    goal = wording_of(flights[0].verdict).goal
    figure.suptitle(f"{sum(reached(one.verdict) for one in flights)} of {len(flights)} {goal}")
    above, height = left.subplots(2, 1, height_ratios=(3, 1))
    above.plot(*anchors.positions[:, :2].T, "k^")
    for one in flights:
        colour = "tab:green" if reached(one.verdict) else "tab:red"
        above.plot(*one.p[:, :2].T, color=colour, linewidth=0.7, alpha=0.6)
        above.plot(*one.p[-1, :2], "x", color=colour)
        height.plot(one.t, one.p[:, 2], color=colour, linewidth=0.7, alpha=0.6)
    above.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    height.set(xlabel="t, s", ylabel="z, m")
    worst = max(flights, key=lambda one: (not reached(one.verdict), one.verdict["tracking"] or 0.0))
    right.suptitle(f"seed {worst.verdict['seed']}: {worst.verdict['why'] or goal}")
    for k, (axes, axis) in enumerate(zip(right.subplots(3, 1, sharex=True), "xyz")):
        axes.plot(worst.t, worst.wanted[:, k] - worst.p[:, k], "0.6", label="wanted - true")
        axes.plot(worst.stamps, worst.error[:, k], label="estimated - true")
        axes.fill_between(
            worst.stamps,
            -3 * worst.sigma[:, k],
            3 * worst.sigma[:, k],
            alpha=0.2,
            label="three sigma",
        )
        axes.set(ylabel=f"{axis}, m")
    axes.set(xlabel="t, s")
    axes.legend()
    write_picture(path, figure, 120)


def fly_task(
    record: str | Path | None, draw: bool, task: Task
) -> tuple[dict[str, Any], DrawnFlight | None]:
    """Fly a Task and return (verdict, DrawnFlight or None).

    record : str or Path, optional
        Folder for a bag of the flight.
    draw : bool
        Whether to return figures to draw.
    """
    one = drive(task) if task.vehicle == "rover" else fly(task)
    verdict = verdict_of(one)
    if record is not None:
        write_bag(one.flight, Path(record) / one.flight.name, "mcap", False)
    return verdict, drawn_flight(one, verdict) if draw else None
