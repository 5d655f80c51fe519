# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A row of the table: what the nodes published during a fault, compared with ground truth."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_tools.scoring.metrics import position_at

from .. import table
from .events import Scene, yaws_at

if TYPE_CHECKING:
    from .catalogue import Fault
    from .play import Heard

RUNNING = 2  # EstimatorStatus
STEP = 0.02  # s between two looks
# s for which an odometry, and a status, count as new; the latter comes each second
FRESH, FRESH_STATUS = (0.5, 2.5)
OTHER_CLOCK = 1.0  # s between stamp and arrival, from which on the stamp is of another clock
# m; stated deviations; s for which both may be exceeded while the status reports no problem
WRONG, SIGMAS, WRONG_LIMIT = (1.0, 3.0, 2.0)
# rad, s: the same for a yaw that the filter reports as known
WRONG_YAW, YAW_LIMIT = (math.radians(20.0), 5.0)
RECOVERED_LIMIT, STOP_LIMIT = 3.0, 5.0  # s
# s by which events may be sent late before the row says that the machine was too busy for it
LATE = 0.2
LEAST = 5.0  # s that are judged of a fault that is over at once
# s from the first message on that do not count of a fault of the whole flight: nothing can be found
# so fast
SETTLED = 6.0
CUT = 60  # characters of a sentence in the table
HEAD = (
    "fault",
    "3D RMSE",
    "largest",
    "stated",
    "gap",
    "`status`",
    "`/diagnostics`",
    "wrong",
    "yaw wrong",
    "recovered",
    "verdict",
)


@dataclass(frozen=True)
class Looks:
    """The odometry and status that a vehicle flies by, sampled each STEP.

    t : (n,) s
    error, std : (n,) m, true error of the position and stated deviation, NaN before the first
        odometry
    yaw_error, yaw_std : (n,) rad
    fresh : (n,) bool, an odometry came lately
    running, clean : (n,) bool, a recent status reports a running filter; clean: with an empty `why`
    """

    t: np.ndarray
    error: np.ndarray
    std: np.ndarray
    yaw_error: np.ndarray
    yaw_std: np.ndarray
    fresh: np.ndarray
    running: np.ndarray
    clean: np.ndarray

    @property
    def wrong(self) -> np.ndarray:
        """(n,) bool: a large error beyond the stated deviation, while the status is clean."""
        return self.clean & (self.error > np.maximum(WRONG, SIGMAS * self.std))

    @property
    def yaw_wrong(self) -> np.ndarray:
        """(n,) bool: the same for the yaw."""
        return self.clean & (self.yaw_error > np.maximum(WRONG_YAW, SIGMAS * self.yaw_std))


def looks_at(heard: Heard, scene: Scene, seconds: float) -> Looks:
    """Return the Looks of received messages.

    An odometry is compared with the truth at its stamp. If the stamp is of another clock, it is
    compared at its arrival. The last one before a gap is compared with the truth of each look.
    """
    t = np.arange(0.0, seconds, STEP)
    arrival = np.array([at for at, _ in heard.odometry])
    newest = np.searchsorted(arrival, t, side="right") - 1
    there = newest >= 0
    if not there.any():
        nothing = np.full(len(t), math.nan)
        return Looks(t, nothing, nothing, nothing, nothing, there, *_status(heard, t))
    messages = [message for _, message in heard.odometry]
    stamp = (
        np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in messages])
        - heard.begin
    )
    stamp = np.where(np.abs(stamp - arrival) > OTHER_CLOCK, arrival, stamp)
    poses = [m.pose.pose for m in messages]
    p = np.array([[of.position.x, of.position.y, of.position.z] for of in poses])
    x, y, z, w = np.array(
        [[of.orientation.x, of.orientation.y, of.orientation.z, of.orientation.w] for of in poses]
    ).T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))
    covariance = np.array([m.pose.covariance for m in messages])
    k = np.maximum(newest, 0)
    fresh = there & (t - arrival[k] < FRESH)
    of = np.where(fresh, stamp[k], t)
    error = np.linalg.norm(p[k] - position_at(of, scene.truth), axis=1)
    turn = (yaw[k] - yaws_at(of, scene.truth) + math.pi) % (2.0 * math.pi) - math.pi
    std = np.sqrt(covariance[k][:, [0, 7, 14]].sum(axis=1))

    def known(values: np.ndarray) -> np.ndarray:
        return np.where(there, values, math.nan)

    return Looks(
        t,
        known(error),
        known(std),
        known(np.abs(turn)),
        known(np.sqrt(covariance[k, 35])),
        fresh,
        *_status(heard, t),
    )


def _status(heard: Heard, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(running, clean), each (n,) bool, by the newest status at (n,) s, if it came lately."""
    arrival = np.array([-math.inf, *(at for at, _ in heard.status)])
    newest = np.searchsorted(arrival, t, side="right") - 1
    fresh = t - arrival[newest] < FRESH_STATUS
    running = np.array([False, *(of.status == RUNNING for _, of in heard.status)])
    clean = np.array([False, *(is_clean(of) for _, of in heard.status)])
    return running[newest] & fresh, clean[newest] & fresh


def is_clean(status: Any) -> bool:
    """Whether an EstimatorStatus says that the odometry can be flown by."""
    return status.status == RUNNING and not status.why


def judged(name: str, fault: Fault, heard: Heard, scene: Scene) -> dict[str, Any]:
    """The figures of a fault, by name, and its verdict.

    Times count from the begin of the fault; the time to recover counts from its end.
    """
    if heard.failed:
        return {
            "fault": name,
            "text": fault.text,
            "failed": heard.failed,
            "verdict": "MISS: the nodes did not start",
        }
    looks = looks_at(heard, scene, fault.seconds)
    begin, end = fault.begin, max(fault.end, fault.begin + LEAST)
    inside = (looks.t >= (begin or SETTLED)) & (looks.t < end) & ~np.isnan(looks.error)
    judged_from = begin or SETTLED
    arrivals = np.array([at for at, _ in heard.odometry])
    inner = arrivals[(arrivals > judged_from) & (arrivals < fault.seconds)]
    edges = np.concatenate(([judged_from], inner, [fault.seconds]))
    error, std = looks.error[inside], looks.std[inside]
    worst = int(np.argmax(error)) if len(error) else -1
    row = {
        "fault": name,
        "text": fault.text,
        "rmse": float(np.sqrt(np.mean(error**2))) if len(error) else math.nan,
        "largest": float(error[worst]) if len(error) else math.nan,
        "stated": float(std.max()) if len(std) else math.nan,
        "stated at largest": float(std[worst]) if len(std) else math.nan,
        "gap": float(np.diff(edges).max()),
        "clean": STEP * int((looks.clean & inside).sum()),
        "wrong": STEP * int((looks.wrong & (looks.t >= begin)).sum()),
        "yaw wrong": STEP * int((looks.yaw_wrong & (looks.t >= begin)).sum()),
        "recovered": _recovered(looks, fault) if fault.ends else None,
        "status": _said(
            [(at, "" if is_clean(of) else f"{of.status}: {of.why}") for at, of in heard.status],
            begin,
        ),
        "diagnostics": _said(_warnings(heard, "ekf_node"), begin),
        "diagnostics of bias_node": _said(_warnings(heard, "bias_node"), begin),
        "stop": heard.stop,
        "late": heard.late,
        "latency": _latency(heard),
    }
    return row | {"verdict": verdict(row)}


def verdict(row: dict[str, Any]) -> str:
    """Return "ok", or MISS and the failed criteria."""
    missed = [
        text
        for text, is_missed in {
            "wrong and certain": row["wrong"] > WRONG_LIMIT,
            "yaw wrong and certain": row["yaw wrong"] > YAW_LIMIT,
            "not recovered": row["recovered"] is not None and row["recovered"] > RECOVERED_LIMIT,
            "a sensor disturbs": (row["gap"] > FRESH or row["status"])
            and row["fault"].partition(":")[0] in SENSOR_NAMES,  # it can do without
            "does not end": max(row["stop"].values(), default=0.0) > STOP_LIMIT,
        }.items()
        if is_missed
    ]
    late = f" (sent up to {row['late']:.1f} s late)" if row["late"] > LATE else ""
    return (f"MISS: {', '.join(missed)}" if missed else "ok") + late


def line(row: dict[str, Any]) -> str:
    """A row of the table."""
    if "failed" in row:
        return table.line([row["fault"], *[""] * (len(HEAD) - 2), row["verdict"]])
    recovered = row["recovered"]
    cells = [
        row["fault"],
        *(f"{row[key]:.2f}" for key in ("rmse", "largest", "stated", "gap")),
        _words(row["status"]),
        _words(row["diagnostics"] or row["diagnostics of bias_node"]),
        *(f"{row[key]:.1f}" for key in ("wrong", "yaw wrong")),
        "" if recovered is None else f"{recovered:.1f}",
        row["verdict"],
    ]
    return table.line(cells)


def _warnings(heard: Heard, name: str) -> list[tuple[float, str]]:
    """[(s, text)] of the diagnostics of a node, "" where it has nothing to warn of."""
    return [
        (at, f"{node}: {text}" if level else "")
        for at, node, level, text in heard.diagnostics
        if node == name
    ]


def _words(said: list[tuple[float, str]]) -> str:
    """The first status message, with its time."""
    if not said:
        return "nothing"
    at, text = said[0]
    return f"{at:.1f} s: {text[:CUT].replace('|', '/')}"


def _said(sentences: list[tuple[float, str]], begin: float) -> list[tuple[float, str]]:
    """[(s since the begin of the fault, text)] of sentences, (s, text), that are not empty and
    differ from the one before.
    """
    out: list[tuple[float, str]] = []
    last = next((text for at, text in reversed(sentences) if at < begin), "")
    for at, text in sentences:
        if at >= (begin or SETTLED) and text != last:
            if text:
                out.append((round(at - begin, 2), text))
            last = text
    return out


def _recovered(looks: Looks, fault: Fault) -> float:
    """s from the end of the fault until the filter has recovered for good; inf if it never does.

    It has recovered if odometry flows and is right, and the status is clean. After a requested
    reset, the status may report an unknown yaw.
    """
    well = looks.fresh & (looks.running if fault.anew else looks.clean) & (looks.error < WRONG)
    after = np.flatnonzero((looks.t >= fault.end) & ~well)
    if not len(after):
        return 0.0
    if after[-1] == len(looks.t) - 1:
        return math.inf
    return float(looks.t[after[-1] + 1] - fault.end)


def _latency(heard: Heard) -> dict[str, float]:
    """{"p50", "p99"} s from the stamp of an odometry to its arrival."""
    if not heard.odometry:
        return {}
    stamps = (
        np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in heard.odometry])
        - heard.begin
    )
    late = np.array([at for at, _ in heard.odometry]) - stamps
    return {"p50": float(np.percentile(late, 50)), "p99": float(np.percentile(late, 99))}
