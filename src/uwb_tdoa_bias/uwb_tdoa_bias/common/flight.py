# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Flight: the numpy arrays of one recording. All readers return it and all tools take it."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass, replace
from typing import Any

import numpy as np

from .anchors import Anchors
from .arrays import Stamped
from .errors import sanitize
from .sensors import LOCATING, SENSORS

SENSOR_NAMES = tuple(SENSORS)  # optional streams of a Flight
STREAMS = "tdoa", "imu", "truth", *SENSOR_NAMES  # of a Flight, each on its own clock


@dataclass(frozen=True)
class Imu(Stamped):
    """Inertial samples in the body frame (x forward, y left, z up: REP-103).

    Attributes
    ----------
    t : (n,) s
    gyro : (n, 3) rad/s
    accel : (n, 3) m/s^2, specific force (+9.81 on z at rest).
    """

    t: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray


@dataclass(frozen=True)
class Tdoas(Stamped):
    """Raw TDOA measurements.

    Attributes
    ----------
    t : (n,) s
    a, b : (n,) anchor ids
    d : (n,) m, d_ab = |p - b| - |p - a|
    variance : (n,) m^2, of the noise as the tag reports it; 0 where it reports none. Default: 0.
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    d: np.ndarray
    variance: np.ndarray = None  # type: ignore[assignment]  # __post_init__ sets zeros

    def __post_init__(self) -> None:
        if self.variance is None:
            object.__setattr__(self, "variance", np.zeros(len(self.t)))


@dataclass(frozen=True)
class Truth(Stamped):
    """Ground truth.

    Attributes
    ----------
    t : (n,) s
    p : (n, 3) m, world
    q : (n, 4) x y z w, body to world, NaN where not recorded
    """

    t: np.ndarray
    p: np.ndarray
    q: np.ndarray


_SensorStreams: Any = make_dataclass(  # attribute names: SENSORS
    "_SensorStreams",
    [(name, sensor.stream | None, None) for name, sensor in SENSORS.items()],
    frozen=True,
    kw_only=True,
)


@dataclass(frozen=True)
class Flight(_SensorStreams):
    """One recording.

    All stamps are in s, of one clock. Each stream keeps its own stamps; they never fall.

    Attributes
    ----------
    name : short and unique, e.g. "0425-traj1"; `sanitize` is applied to it
    anchors : Anchors
    tdoa : Tdoas
    imu : Imu or None
    truth : Truth or None
    extra : other streams of the log by name, each a dict of column name to (n,) array; one column is
        "t"; units of the file
    meta : origin of the recording: source file, format, protocol ("tdoa2", "tdoa3"), ...
    restarts : stamps, s, at which the clock of the recording restarted; data before a restart do not
        determine the position after it
    for each of SENSORS, by name : its Stream or None
    """

    name: str
    anchors: Anchors
    tdoa: Tdoas
    imu: Imu | None = None
    truth: Truth | None = None
    extra: dict = field(default_factory=dict)
    meta: dict = field(default_factory=dict)
    restarts: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", sanitize(self.name))

    @property
    def start(self) -> float:
        """Stamp of the first TDOA, s; the origin of slow changes.

        Without TDOAs, the first stamp of the other streams that locate the tag; 0 without any.
        """
        return float(min((part.t[0] for part in self._located), default=0.0))

    @property
    def end(self) -> float:
        """Stamp of the last TDOA, s; otherwise as `start`."""
        return float(max((part.t[-1] for part in self._located), default=0.0))

    @property
    def _located(self) -> list[Any]:
        """TDOAs; without any, the other streams that locate the tag."""
        streams = [self.tdoa] if len(self.tdoa) else [getattr(self, name) for name in LOCATING]
        return [stream for stream in streams if stream is not None and len(stream)]

    @property
    def duration(self) -> float:
        """Time from `start` to `end`, s."""
        return self.end - self.start

    @property
    def known_truth(self) -> Truth:
        """Ground truth of a flight that has one."""
        assert self.truth is not None
        return self.truth

    @property
    def streams(self) -> dict[str, Any]:
        """The streams that it has, by their names in STREAMS."""
        return {name: part for name in STREAMS if (part := getattr(self, name)) is not None}

    def replaced(self, **streams: Any) -> Flight:
        """Return the Flight with other streams, given by name; None removes a stream."""
        return replace(self, **streams)

    def without(self, *streams: str) -> Flight:
        """Return the Flight without some optional streams, given by name, e.g. SENSOR_NAMES."""
        return self.replaced(**dict.fromkeys(streams))

    def among(self, rows: np.ndarray) -> Flight:
        """Return the Flight with the anchors of some rows and the TDOAs between them."""
        anchors, tdoa = self.anchors.only(rows), self.tdoa
        kept = np.isin(tdoa.a, anchors.ids) & np.isin(tdoa.b, anchors.ids)
        return replace(
            self, anchors=anchors, tdoa=Tdoas(*(column[kept] for column in vars(tdoa).values()))
        )
