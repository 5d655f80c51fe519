"""The compiled core beside another filter, in one run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.flying.estimates import Peer, events

from .core import BEFORE, MEASURED, RARELY, Core, sample_before
from .figures import Figure
from .flights import make_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from uwb_tdoa_bias.common.flight import Flight

REPEATS = 41


def events_of(flight: Flight, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(inertial samples, the same and TDOAs) of a Flight from begin to end, s: two arrays of EVENT
    in order of their stamps, each TDOA at that of the sample before, as `Core` measures ours.
    """
    assert flight.imu is not None
    samples, ranges = events(flight.imu, flight.tdoa, flight.anchors)
    ranges["t"] = sample_before(flight.imu.t, ranges["t"])
    samples, ranges = (part[(part["t"] >= begin) & (part["t"] < end)] for part in (samples, ranges))
    both = np.concatenate([samples, ranges])
    return samples, both[np.argsort(both["t"], kind="stable")]


def measure(progress: Callable[[str], object], peer: Peer, quick: bool = False) -> Iterator[Figure]:
    """Generator of Figures: ours and those of a Peer, run in turn. progress(text)."""
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
