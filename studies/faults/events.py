# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The messages that the nodes get during a flight: one Event for each."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Truth
from uwb_tdoa_bias.common.sensors import Height, Pressure, Ranges, Velocity
from uwb_tdoa_bias.common.sensors.pressure import SITE, pressure_at
from uwb_tdoa_tools.scoring.metrics import position_at, scored_phase

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.flight import Flight

BEFORE = 1.5  # s on the floor before take-off
IMU_EVERY = 4  # send each fourth inertial sample, to keep the computer idle enough
RATES = {"height": 50.0, "pressure": 25.0, "velocity": 100.0, "range": 100.0}  # Hz
PLAYED = tuple(RATES)  # sensors that the study plays, in the order of SENSORS
HEIGHT_STD, PRESSURE_STD, RANGE_STD, VELOCITY_STD = 0.02, 0.1, 0.1, 0.1  # m, m, m, m/s
# {stream: the fields of its values that are numbers}
NUMBERS = {
    "imu": ("gyro", "accel"),
    "tdoa": ("d",),
    "height": ("range",),
    "velocity": ("v",),
    "pressure": ("pressure",),
    "range": ("d",),
}


class Event(NamedTuple):
    """A message, or something that is done. at : s, when it is sent; stream : name; t : s, its
    stamp; values : by field; frame : of the sensor; sender : number of the publisher. `at` and `t`
    count from the first message of the flight.
    """

    at: float
    stream: str
    t: float
    values: dict[str, Any]
    frame: str = "base_link"
    sender: int = 0


@dataclass(frozen=True)
class Scene:
    """When a fault lasts, [begin, end) s, and where the tag is: truth, on the same clock."""

    begin: float
    end: float
    truth: Truth

    def pose(self, t: float) -> tuple[np.ndarray, float]:
        """True position (3,) m, and yaw, rad, at t, s."""
        return position_at(np.array([t]), self.truth)[0], float(
            yaws_at(np.array([t]), self.truth)[0]
        )


def part_of(flight: Flight, seconds: float) -> Flight:
    """The first `seconds` of a flight from shortly before take-off on, on a clock that begins with
    them, with all sensors.
    """
    begin = scored_phase(flight.truth)[1] - BEFORE
    flight = with_sensors(flight)

    def cut(stream: Any, every: int = 1) -> Any:
        rows = np.flatnonzero((stream.t >= begin) & (stream.t < begin + seconds))[::every]
        columns = {name: column[rows] for name, column in vars(stream).items()}
        return replace(stream, **columns | {"t": columns["t"] - begin})

    parts = {name: cut(getattr(flight, name)) for name in ("tdoa", "truth", *PLAYED)}
    return flight.replaced(**parts, imu=cut(flight.imu, IMU_EVERY))


def with_sensors(flight: Flight) -> Flight:
    """The flight with a height, velocity, pressure and ranges of its ground truth and noise."""
    truth, rng = flight.truth, np.random.default_rng(0)

    def at(name: str) -> tuple[np.ndarray, np.ndarray]:
        t = np.arange(truth.t[0], truth.t[-1], 1.0 / RATES[name])
        return t, position_at(t, truth)

    t, p = at("height")
    q = truth.q[np.clip(np.searchsorted(truth.t, t), 0, len(truth) - 1)]
    heights = p[:, 2] / (
        1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2)
    ) + HEIGHT_STD * rng.standard_normal(len(t))
    height = Height(t, np.maximum(heights, 0.0))
    t, p = at("pressure")
    pressure = Pressure(t, pressure_at(SITE + p[:, 2] + PRESSURE_STD * rng.standard_normal(len(t))))
    t, p = at("range")
    row = np.arange(len(t)) % len(flight.anchors)
    d = np.linalg.norm(p - flight.anchors.positions[row], axis=1) + RANGE_STD * rng.standard_normal(
        len(t)
    )
    ranges = Ranges(t, flight.anchors.ids[row], np.maximum(d, 0.0), np.zeros(len(t)))
    return flight.replaced(
        height=height, pressure=pressure, range=ranges, velocity=velocity_of(truth)
    )


def velocity_of(truth: Truth) -> Velocity:
    """The velocity in the body frame, of the ground truth and noise."""
    t = np.arange(truth.t[0] + 0.1, truth.t[-1] - 0.1, 1.0 / RATES["velocity"])
    before, after = (
        np.stack([np.interp(t + s, truth.t, column) for column in truth.p.T], axis=1)
        for s in (-0.05, 0.05)
    )
    near = truth.q[np.clip(np.searchsorted(truth.t, t), 0, len(truth) - 1)]
    v = Rotation.from_quat(near).inv().apply((after - before) / 0.1)
    noise = VELOCITY_STD * np.random.default_rng(0).standard_normal(v.shape)
    return Velocity(t, v + noise, np.full(v.shape, VELOCITY_STD))


def events_of(flight: Flight, streams: tuple[str, ...]) -> list[Event]:
    """The anchors and the messages of the given streams, each sent at its stamp."""
    out = [Event(-1.0, "anchors", 0.0, {"anchors": flight.anchors})]
    for name in streams:
        stream = getattr(flight, name)
        fields = [field for field in vars(stream) if field != "t"]
        columns = zip(*(getattr(stream, field) for field in fields))
        out += [
            Event(t, name, t, dict(zip(fields, values)))
            for t, values in zip(stream.t.tolist(), columns)
        ]
    return in_order(out)


def in_order(events: list[Event]) -> list[Event]:
    """The events by the time at which they are sent."""
    return sorted(events, key=lambda event: event.at)


def turned(truth: Truth, degrees: float) -> Truth:
    """The truth in a world whose axes are turned about z, so that everything in it turns by
    `degrees`.
    """
    turn = Rotation.from_euler("z", degrees, degrees=True)
    return Truth(truth.t, turn.apply(truth.p), (turn * Rotation.from_quat(truth.q)).as_quat())


def yaws_at(t: np.ndarray, truth: Truth) -> np.ndarray:
    """(n,) true yaws, rad, at (n,) s."""
    x, y, z, w = truth.q.T
    yaw = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2)))
    return (np.interp(t, truth.t, yaw) + math.pi) % (2.0 * math.pi) - math.pi
