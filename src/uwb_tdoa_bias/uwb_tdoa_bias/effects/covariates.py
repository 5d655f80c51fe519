"""What a systematic error may depend on: quantities that a node can compute, by name."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ..foundation.compiled import compiled
from ..foundation.radio import into_frame
from ..foundation.vibration import VIBRATION_CORNER, low_pass, track_vibration
from .samples import ImuSamples, tile

if TYPE_CHECKING:
    from collections.abc import Callable

    from .samples import AidSamples, Samples

CATEGORIES = ("previous_anchor",)  # values are names, not sizes
UPWARDS = ("height", "elevation")  # change where a tag leaves the floor
OF_MOTION = (
    "speed",
    "climb_rate",
    "acceleration",
    "turning_rate",
    "interval",
    "previous_anchor",
)  # need a history


def _norm(v: np.ndarray) -> np.ndarray:
    return np.linalg.norm(v, axis=1)


# One value per TDOA, of Samples: (n,), or None if the samples do not hold it.
OF_TDOA: dict[str, Callable[[Any], np.ndarray | None]] = {
    "time": lambda s: s.t - s.start,
    "x": lambda s: s.p[:, 0],
    "y": lambda s: s.p[:, 1],
    "height": lambda s: s.p[:, 2],
    "speed": lambda s: None if s.motion is None else _norm(s.motion.velocity),
    "climb_rate": lambda s: None if s.motion is None else s.motion.velocity[:, 2],
    "acceleration": lambda s: None if s.motion is None else _norm(s.motion.acceleration),
    "turning_rate": lambda s: None if s.motion is None else _norm(s.motion.rate),
    "tilt": lambda s: np.arccos(np.clip(1.0 - 2.0 * (s.q[:, 0] ** 2 + s.q[:, 1] ** 2), -1.0, 1.0)),
    "interval": lambda s: s.interval,
    "previous_anchor": lambda s: s.previous,
    "vibration": lambda s: s.vibration,
}


def _to_anchor(samples: Samples, rows: np.ndarray) -> np.ndarray:
    return samples.anchors.positions[rows] - tile(samples, samples.p)


def _bearing(v: np.ndarray) -> np.ndarray:
    return np.arctan2(v[:, 1], v[:, 0])


def _elevation(v: np.ndarray) -> np.ndarray:
    return np.arctan2(v[:, 2], np.hypot(v[:, 0], v[:, 1]))


# One value per arrival: of the anchors in rows (2n,), the samples repeated twice.
OF_ARRIVAL: dict[str, Callable[[Samples, np.ndarray], np.ndarray]] = {
    "range": lambda s, rows: np.linalg.norm(_to_anchor(s, rows), axis=1),
    "bearing": lambda s, rows: _bearing(_to_anchor(s, rows)),
    "elevation": lambda s, rows: _elevation(_to_anchor(s, rows)),
    "bearing_in_tag": lambda s, rows: _bearing(into_frame(tile(s, s.q), _to_anchor(s, rows))),
    "elevation_in_tag": lambda s, rows: _elevation(into_frame(tile(s, s.q), _to_anchor(s, rows))),
    "bearing_in_anchor": lambda s, rows: _bearing(
        into_frame(s.anchors.orientations[rows], -_to_anchor(s, rows))
    ),
    "elevation_in_anchor": lambda s, rows: _elevation(
        into_frame(s.anchors.orientations[rows], -_to_anchor(s, rows))
    ),
}

# One value per inertial sample: columns of what ImuFeatures gives.
OF_IMU = (
    "time",
    "vibration",
    "turning_rate",
    "rate_x",
    "rate_y",
    "rate_z",
    "accel",
    "accel_x",
    "accel_y",
    "accel_z",
)

# Those of OF_TDOA that samples of the other sensors of a vehicle hold too.
OF_AIDS = (
    "time",
    "x",
    "y",
    "height",
    "speed",
    "climb_rate",
    "acceleration",
    "turning_rate",
    "vibration",
)

# Which of position (0, 1, 2) and velocity (3, 4, 5) of the tag, as the filter estimates them,
# change a covariate of TDOAs at once. Not
# that of the speed: its direction is anybody's guess where a tag is slow, and following it did
# harm.
STATES = {**dict.fromkeys(("x", "y", "height", *OF_ARRIVAL), (0, 1, 2)), "climb_rate": (5,)}

# What an inertial sensor may depend on that the filter knows when it takes a sample.
OF_STATE = ("x", "y", "height", "speed", "climb_rate")

UNITS = {
    "time": "s",
    "x": "m",
    "y": "m",
    "height": "m",
    "speed": "m/s",
    "climb_rate": "m/s",
    "acceleration": "m/s^2",
    "turning_rate": "rad/s",
    "tilt": "rad",
    "interval": "s",
    "previous_anchor": "id",
    "vibration": "m/s^2",
    "range": "m",
    **dict.fromkeys((name for name in OF_ARRIVAL if name != "range"), "rad"),
    **dict.fromkeys((name for name in OF_IMU if name.startswith("rate_")), "rad/s"),
    **dict.fromkeys((name for name in OF_IMU if name.startswith("accel")), "m/s^2"),
}
EXTRA = "extra."  # before the name of what else a log holds: "extra.STREAM.COLUMN"
OF_ACCEL = ("accel", "accel_x", "accel_y", "accel_z")  # specific force, m/s^2


def sensor_covariate(name: str, samples: ImuSamples | AidSamples) -> np.ndarray | None:
    """Covariate `name`, one of OF_AIDS, of ImuSamples also one of OF_IMU or "extra.NAME": (n,);
    None if the samples do not hold it.
    """
    if name.startswith(EXTRA):
        return (
            (samples.extra or {}).get(name.removeprefix(EXTRA))
            if isinstance(samples, ImuSamples)
            else None
        )
    if (
        samples.channel == "accel" and name in OF_ACCEL
    ):  # the measured one shares its noise with the residual
        return (
            _norm(samples.reading) if name == "accel" else samples.reading[:, "xyz".index(name[-1])]
        )
    if name in OF_IMU and isinstance(samples, ImuSamples):
        return samples.features[:, OF_IMU.index(name)]
    return OF_TDOA[name](samples)


class ImuFeatures:
    """The covariates OF_IMU along a stream of inertial samples; they depend on the past of the
    stream alone.
    """

    def __init__(self) -> None:
        self._state = np.zeros(
            (4, 3)
        )  # last stamp and first stamp, slow rate, slow force, vibration power
        self._state[0, :2] = np.nan

    def __call__(self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
        """t (n,) s; gyro (n, 3) rad/s; accel (n, 3) m/s^2. Returns (n, len(OF_IMU))."""
        out = np.empty((len(t), len(OF_IMU)))
        _features(
            self._state,
            np.ascontiguousarray(t),
            np.ascontiguousarray(gyro),
            np.ascontiguousarray(accel),
            out,
        )
        return out


@compiled
def _features(
    state: np.ndarray, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray, out: np.ndarray
) -> None:
    rate, force, power = state[1], state[2], state[3]
    for i in range(len(t)):
        dt = t[i] - state[0, 0]
        if not 0.0 <= dt < 1.0:  # the first sample, or one after a gap
            if not (state[0, 1] <= t[i]):
                state[0, 1] = t[i]
            rate[:], force[:], power[:] = gyro[i], accel[i], 0.0
            dt = 0.0
        state[0, 0] = t[i]
        track_vibration(force, power, accel[i], dt)
        for k in range(3):
            rate[k] = low_pass(rate[k], gyro[i, k], dt, VIBRATION_CORNER)
            out[i, 3 + k] = rate[k]
            out[i, 7 + k] = force[k]
        out[i, 0] = t[i] - state[0, 1]
        out[i, 1] = math.sqrt(power[0] + power[1] + power[2])
        out[i, 2] = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
        out[i, 6] = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
