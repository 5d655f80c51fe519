# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""us per prediction, per robust update, and per height, pressure or velocity in the compiled core."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_ekf.core.config import ROBUST, FilterConfig
from uwb_tdoa_ekf.core.engine import feed
from uwb_tdoa_ekf.core.memory import (
    IMU_SAMPLE,
    N_YAWS,
    TDOA,
    Measurements,
    new_state,
    structured,
    usable_tdoas,
)
from uwb_tdoa_ekf.offline import loaded

from .figures import Figure
from .flights import make_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_ekf.core.memory import FilterState

ANCHORS = (4, 8, 16, 32, 64)
BEFORE, MEASURED = 3.0, 4.0  # s of a flight: until it is measured, and measured
RARELY = 1e-3  # Hz of odometry: the core alone is measured
TARGET = 1.5  # us of one prediction and one robust update
OF_SENSOR = 2.0  # us, of one height, pressure or velocity
NOISES = {"height": 0.01, "pressure": 0.1, "velocity": 0.05}  # m, m, m/s
SECTION = "compiled core, one core"


def measure(progress: Callable[[str], object], quick: bool = False) -> Iterator[Figure]:
    """Generator of Figures. progress(text) : called with the name of the next measurement.

    Each pair of figures comes from the same stretch of a flight, run from the same state: once with
    its inertial samples alone, once with TDOAs at the stamps of inertial samples. The difference is
    the cost of the TDOA updates.
    """
    repeats = 9 if quick else 41
    for anchors in ANCHORS[1:2] if quick else ANCHORS:
        progress(f"core, {anchors} anchors")
        target = TARGET if anchors == 8 else None
        yield from _pair(f"{anchors} anchors, {ROBUST[0]}", anchors, ROBUST[0], 1, repeats, target)
    for robust in ROBUST[1:]:
        progress(f"core, {robust}")
        yield from _pair(f"8 anchors, {robust}", 8, robust, 1, repeats)
    progress("core, yaw unknown")
    yield from _pair(
        f"8 anchors, {ROBUST[0]}, while {N_YAWS} yaws are followed", 8, ROBUST[0], N_YAWS, repeats
    )
    for sensor in NOISES:
        progress(f"core, {sensor}")
        yield Figure.of(SECTION, f"one {sensor}", "us", per_sensor(sensor, repeats), OF_SENSOR)


def _pair(
    name: str, anchors: int, robust: str, hypotheses: int, repeats: int, target: float | None = None
) -> Iterator[Figure]:
    prediction, update = per_event(anchors, robust, hypotheses, repeats)
    yield Figure.of(SECTION, f"prediction, {name}", "us", prediction)
    yield Figure.of(SECTION, f"robust update, {name}", "us", update)
    yield Figure.of(SECTION, f"both, {name}", "us", prediction + update, target)


def per_event(
    anchors: int, robust: str, hypotheses: int, repeats: int
) -> tuple[np.ndarray, np.ndarray]:
    """us per prediction and per update, two (repeats,) arrays, while 1 or YAWS yaws are followed."""
    # While a tag hovers, its yaw is unobservable.
    trajectory = "hover" if hypotheses > 1 else "sines"
    path: dict[str, Any] = {"trajectory": trajectory, "start_in_air": True, "multipath": False}
    flight = make_flight(BEFORE + MEASURED, anchors, **path)
    config = FilterConfig(
        robust=robust,
        initial_yaw_std=FilterConfig.initial_yaw_std if hypotheses > 1 else 0.5,
        odometry_rate=RARELY,
    )
    core = Core(flight, config)
    core.start()
    seconds = np.array([[core.timed(False), core.timed(True)] for _ in range(repeats + 1)])
    seconds = seconds[1:]  # the first fills caches
    alive = np.count_nonzero(np.isfinite(core.last.record.hypotheses["log_weight"]))
    if alive != hypotheses:
        raise RuntimeError(f"{alive} yaws were followed instead of {hypotheses}")
    return 1e6 * seconds[:, 0] / core.samples, 1e6 * (seconds[:, 1] - seconds[:, 0]) / core.tdoas


def per_sensor(sensor: str, repeats: int) -> np.ndarray:
    """us per height, pressure or velocity, with 1 kHz IMU and 400 Hz TDOA: (repeats,)."""
    noise: dict[str, Any] = {f"{sensor}_noise": NOISES[sensor]}
    flight = make_flight(BEFORE + MEASURED, start_in_air=True, multipath=False, **noise)
    core = Core(flight, FilterConfig(initial_yaw_std=0.5, odometry_rate=RARELY))
    core.start()
    seconds = np.array([[core.timed(True), core.timed(True, True)] for _ in range(repeats + 1)])[1:]
    return 1e6 * (seconds[:, 1] - seconds[:, 0]) / core.sensors


def sample_before(stamps: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The last of some stamps (m,), rising, that is no later than each of t (n,), or the first of
    all: (n,).
    """
    return stamps[np.maximum(np.searchsorted(stamps, t, side="right") - 1, 0)]


class Core:
    """engine.feed on a stretch of a flight, again and again from the same FilterState."""

    def __init__(self, flight: Flight, config: FilterConfig) -> None:
        assert flight.imu is not None
        self.state = self.last = new_state(flight.anchors.positions)
        self._parameters = config.parameters()
        imu, tdoa = flight.imu, flight.tdoa
        self._imu = structured(IMU_SAMPLE, imu.t, imu.gyro, imu.accel)
        # no prediction of their own: at the stamp of the inertial sample before
        stamps = sample_before(imu.t, tdoa.t)
        rows = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
        received = structured(TDOA, stamps, *rows, tdoa.d)
        self._tdoa = received[usable_tdoas(received, flight.anchors.positions)]
        self._sensors = loaded(flight, config)[0].take(math.inf).sensors
        self._sensors["t"] = sample_before(imu.t, self._sensors["t"])
        self._begin = imu.t[0]

    def start(self) -> None:
        """Feed the events of the first BEFORE seconds. Only later events are measured.

        Raises RuntimeError if the filter does not run by then.
        """
        streams = self._imu, self._tdoa, self._sensors
        ends = [int(np.searchsorted(stream["t"], self._begin + BEFORE)) for stream in streams]
        self._feed(self.state, *(stream[:end] for stream, end in zip(streams, ends)))
        if not self.state.record.running:
            raise RuntimeError("the filter has not started, so that there is nothing to measure")
        self._imu, self._tdoa, self._sensors = (stream[end:] for stream, end in zip(streams, ends))
        self.samples, self.tdoas, self.sensors = len(self._imu), len(self._tdoa), len(self._sensors)

    def timed(self, tdoa: bool, sensors: bool = False) -> float:
        """Time to process the remaining events, s, with or without TDOAs, and with or without
        heights, pressures and velocities.
        """
        self.last = self.state.copy()
        return self._feed(
            self.last,
            self._imu,
            self._tdoa if tdoa else self._tdoa[:0],
            self._sensors if sensors else self._sensors[:0],
        )

    def _feed(self, state: FilterState, *measured: np.ndarray) -> float:
        began = time.perf_counter()
        feed(state, self._parameters, Measurements(*measured))
        return time.perf_counter() - began
