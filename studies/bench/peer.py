# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the compiled core and another filter in one run.

The other filter is a shared library that the user has built. docs/notebook/speed.md says what it
exports.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
import time
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig

from .core import BEFORE, MEASURED, RARELY, Core, sample_before
from .figures import Figure
from .flights import make_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import ArrayLike

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.flight import Flight

REPEATS = 41
VERSION = 1  # of the interface
EVENT = np.dtype(
    [
        ("t", float),
        ("gyro", float, 3),
        ("accel", float, 3),
        ("d", float),
        ("a", np.int32),
        ("b", np.int32),
    ]
)
SYMBOLS = ("version", "start", "run", "position")


class Peer:
    """Call the filter in a shared library; raise InputError if it has another interface."""

    def __init__(self, path: str | Path) -> None:
        self.name = Path(path).name
        try:
            library = ctypes.CDLL(str(Path(path).absolute()))
        except OSError as error:
            raise InputError(
                f"--peer: {path} cannot be loaded as a shared library ({error}); build it anew on "
                "this machine."
            ) from error
        missing = [name for name in SYMBOLS if not hasattr(library, f"tdoa_peer_{name}")]
        if missing:
            raise InputError(
                f"--peer: {path} does not export tdoa_peer_{missing[0]}; add it as "
                "docs/notebook/speed.md shows."
            )
        self._library = library
        version = library.tdoa_peer_version()
        if version != VERSION:
            raise InputError(
                f"--peer: {path} is of version {version} of the interface, this is {VERSION}; build "
                "it for that."
            )

    def start(self, anchors: Anchors, p: ArrayLike, q: ArrayLike) -> None:
        """Restart at p (3,) m with attitude q (4,) x y z w."""
        # kept: the library may read them later
        self._anchors = np.ascontiguousarray(anchors.positions, dtype=float)
        arrays = (self._anchors, np.array(p, float), np.array(q, float))
        where, at, attitude = (ctypes.c_void_p(one.ctypes.data) for one in arrays)
        self._library.tdoa_peer_start(where, ctypes.c_int32(len(anchors)), at, attitude)

    def run(self, events: np.ndarray) -> float:
        """Process events (n,) of EVENT and return the duration, s."""
        data, count = ctypes.c_void_p(events.ctypes.data), ctypes.c_int32(len(events))
        began = time.perf_counter()
        self._library.tdoa_peer_run(data, count)
        return time.perf_counter() - began

    def position(self) -> np.ndarray:
        """(3,) m."""
        out = np.full(3, np.nan)
        self._library.tdoa_peer_position(ctypes.c_void_p(out.ctypes.data))
        return out


def events_of(flight: Flight, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(inertial samples, the same and TDOAs) of a Flight from begin to end, s: two arrays of EVENT.

    Events are in order of their stamps. Each TDOA gets the stamp of the inertial sample before it,
    as in the measurement of our filter in `Core`.
    """
    assert flight.imu is not None
    imu, tdoa = flight.imu, flight.tdoa
    samples, ranges = np.zeros(len(imu), EVENT), np.zeros(len(tdoa), EVENT)
    samples["t"], samples["gyro"], samples["accel"], samples["a"] = imu.t, imu.gyro, imu.accel, -1
    ranges["t"], ranges["d"] = sample_before(imu.t, tdoa.t), tdoa.d
    ranges["a"], ranges["b"] = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
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
