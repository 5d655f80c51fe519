# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the compiled core and another filter in one run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.flying.estimates import Peer, events
from uwb_tdoa_tools.scoring.alignment import require_truth
from uwb_tdoa_tools.scoring.metrics import position_at, rms, scored_phase

from .core import BEFORE, MEASURED, RARELY, Core, sample_before
from .figures import Figure
from .flights import make_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_tools.flying.estimates import CompiledCorrection

REPEATS = 41
SAMPLED = 0.01  # s, from one position of a peer to the next
START = 4.0  # s in the air: until then, errors from the floor persist


def events_of(flight: Flight, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(inertial samples, the same and TDOAs) of a Flight from begin to end, s: two arrays of EVENT.

    Events are in order of their stamps. Each TDOA gets the stamp of the inertial sample before it,
    as in the measurement of our filter in `Core`.
    """
    assert flight.imu is not None
    samples, ranges = events(flight.imu, flight.tdoa, flight.anchors)
    ranges["t"] = sample_before(flight.imu.t, ranges["t"])
    samples, ranges = (part[(part["t"] >= begin) & (part["t"] < end)] for part in (samples, ranges))
    both = np.concatenate([samples, ranges])
    return samples, both[np.argsort(both["t"], kind="stable")]


def measure(progress: Callable[[str], object], peer: Peer, quick: bool = False) -> Iterator[Figure]:
    """Generator of Figures of our core and of a Peer, run in turn. progress(text)."""
    repeats = 9 if quick else REPEATS
    progress("peer")
    flight = make_flight(BEFORE + MEASURED, start_in_air=True, multipath=False)
    assert flight.imu is not None and flight.truth is not None
    core = Core(flight, FilterConfig(initial_yaw_std=0.5, odometry_rate=RARELY))
    core.start()
    begin, end, truth = flight.imu.t[0] + BEFORE, flight.imu.t[-1], flight.truth
    samples, both = events_of(flight, begin, np.inf)
    first = int(np.searchsorted(truth.t, begin))

    def timed(events: np.ndarray) -> float:
        peer.start(flight.anchors, truth.p[first], truth.q[first])
        return peer.run(events)

    seconds = np.array(
        [
            [core.timed(False), core.timed(True), timed(samples), timed(both)]
            for _ in range(repeats + 1)
        ]
    )[1:]
    off = float(
        np.linalg.norm(peer.position() - [np.interp(end, truth.t, truth.p[:, k]) for k in range(3)])
    )
    section = f"compiled core beside {peer.name}, 8 anchors"
    ours, theirs = (
        _per_event(some, len(samples), len(both) - len(samples))
        for some in (seconds[:, :2], seconds[:, 2:])
    )
    for name, one, other in zip(("prediction", "robust update", "both"), ours, theirs):
        yield Figure.of(section, f"{name}, ours", "us", one)
        yield Figure.of(section, f"{name}, the other's", "us", other)
        yield Figure.of(section, f"{name}, ours over the other's", "ratio", one / other)
    yield Figure.of(section, "the other's position at the end, off by", "m", off)


def errors(
    flights: Iterable[Flight], library: str, correction: CompiledCorrection | None
) -> Iterator[Figure]:
    """Generator of Figures: the 3D RMSE of a peer on Flights with ground truth, m.

    The means are over whole flights, and over the part after START.
    correction : if given, the figures are the errors without it, with it, and their ratio
    """
    ways = {"as it is": None} | ({"corrected": correction} if correction is not None else {})
    section = f"3D RMSE of {Path(library).name} on measured flights"
    found: dict[str, list[list[float]]] = {way: [] for way in ways}
    for flight in flights:
        for way, known in ways.items():
            t, off = error_of(flight, Peer(library, own=True, correction=known))
            found[way].append([float(rms(off)), float(rms(off[t >= START]))])
            yield Figure.of(section, f"{flight.name}, {way}", "m", found[way][-1][0])
    if not found["as it is"]:
        return
    for way, some in found.items():
        for part, mean in zip(("", f" after {START:g} s"), np.mean(some, axis=0)):
            yield Figure.of(section, f"mean{part}, {way}", "m", mean)
    if correction is not None:
        ratios = np.array(found["corrected"])[:, 0] / np.array(found["as it is"])[:, 0]
        yield Figure.of(section, "corrected, over as it is: the flights", "ratio", ratios)
        yield Figure.of(section, "corrected, over as it is: the worst", "ratio", ratios.max())


def error_of(flight: Flight, peer: Peer) -> tuple[np.ndarray, np.ndarray]:
    """Error of a peer that starts at the true pose of a Flight, where the flight is scored.

    Returns the time since the begin of that part (n,) s, and the distance to the truth (n,) m.
    """
    require_truth(flight)
    assert flight.imu is not None and flight.truth is not None
    truth = flight.truth
    _, first, last = scored_phase(truth)
    parts = events(flight.imu, flight.tdoa, flight.anchors)
    both = np.concatenate(parts)
    both = both[np.isfinite(both["d"]) & (both["t"] >= truth.t[0])]
    both = both[np.argsort(both["t"], kind="stable")]
    peer.start(flight.anchors, truth.p[0], _level(truth.q[0]))
    t = np.arange(both["t"][0], both["t"][-1], SAMPLED)
    p = np.empty((len(t), 3))
    for k, some in enumerate(np.split(both, np.searchsorted(both["t"], t[1:]))):
        peer.run(some)
        p[k] = peer.position()
    t = t + SAMPLED  # when the events of a slice are over
    inside = (t >= first) & (t <= last)
    off = np.linalg.norm(p[inside] - position_at(t[inside], truth), axis=1)
    return t[inside] - first, off


def _level(q: np.ndarray) -> np.ndarray:
    """The attitude (4,) with the yaw of q, level; yaw 0 if it is unknown."""
    yaw = math.atan2(2.0 * (q[0] * q[1] + q[2] * q[3]), 1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2))
    yaw = yaw if math.isfinite(yaw) else 0.0
    return np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])


def _per_event(
    seconds: np.ndarray, samples: int, tdoas: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """us per prediction, update, and both, (repeats,) each. seconds : (repeats, 2), without TDOAs
    and with.
    """
    prediction, update = (
        1e6 * seconds[:, 0] / samples,
        1e6 * (seconds[:, 1] - seconds[:, 0]) / tdoas,
    )
    return prediction, update, prediction + update
