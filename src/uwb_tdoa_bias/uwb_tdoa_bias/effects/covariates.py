# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Covariates: quantities by name that a systematic error may depend on, and their domains."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any

import numpy as np

from ..common.compiled import compiled
from ..common.errors import InputError
from ..common.radio import into_frame
from ..common.vibration import VIBRATION_CORNER, low_pass, track_vibration
from .samples import ImuSamples, Samples, SensorSamples, tile

FADE = 0.5  # share of the width of a domain; this far beyond it, exp(-1/2) of an effect is left
CATEGORIES = ("previous_anchor",)  # values are names, not sizes
UPWARDS = ("height", "elevation")  # change at take-off
# of a history of poses
OF_MOTION = (
    "speed",
    "climb_rate",
    "acceleration",
    "turning_rate",
    "interval",
    "previous_anchor",
    "range_rate",
)
ONLY_TDOA = (*OF_MOTION, "range_difference")  # ranges do not have these


def _norm(v: np.ndarray) -> np.ndarray:
    return np.linalg.norm(v, axis=1)


# One value per TDOA of Samples, (n,); None if the samples lack it
OF_TDOA: dict[str, Callable[[Any], np.ndarray | None]] = {
    "time": lambda s: s.t - s.start,
    "x": lambda s: s.p[:, 0],
    "y": lambda s: s.p[:, 1],
    "height": lambda s: s.p[:, 2],
    "speed": lambda s: None if s.motion is None else _norm(s.motion.velocity),
    "climb_rate": lambda s: None if s.motion is None else s.motion.velocity[:, 2],
    "acceleration": lambda s: None if s.motion is None else _norm(s.motion.acceleration),
    "turning_rate": lambda s: None if s.motion is None else _norm(s.motion.rate),
    "tilt": lambda s: 2.0 * np.arcsin(np.minimum(np.hypot(s.q[:, 0], s.q[:, 1]), 1.0)),
    "yaw": lambda s: _yaw(*s.q.T),
    "interval": lambda s: s.interval,
    "previous_anchor": lambda s: s.previous,
    "vibration": lambda s: s.vibration,
}


def _yaw(x: Any, y: Any, z: Any, w: Any) -> Any:
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _to_anchor(samples: Samples, rows: np.ndarray) -> np.ndarray:
    return samples.anchors.positions[rows] - tile(samples, samples.p)


def _bearing(v: np.ndarray) -> np.ndarray:
    return np.arctan2(v[:, 1], v[:, 0])


def _range_difference(samples: Samples, rows: np.ndarray) -> np.ndarray:
    """Return how much farther each arrival is than the other one, (2 * n,) m."""
    of_a, of_b = _norm(_to_anchor(samples, rows)).reshape(2, -1)
    return np.concatenate([of_a - of_b, of_b - of_a])


def _range_rate(samples: Samples, rows: np.ndarray) -> np.ndarray:
    if samples.motion is None:
        return np.full(len(rows), np.nan)
    away, velocity = -_to_anchor(samples, rows), tile(samples, samples.motion.velocity)
    return np.sum(away * velocity, axis=1) / _norm(away)


def _elevation(v: np.ndarray) -> np.ndarray:
    return np.arctan2(v[:, 2], np.hypot(v[:, 0], v[:, 1]))


# One value per arrival at anchors in rows (ends * n,), with the samples repeated
OF_ARRIVAL: dict[str, Callable[[Samples, np.ndarray], np.ndarray]] = {
    "range": lambda s, rows: np.linalg.norm(_to_anchor(s, rows), axis=1),
    "range_difference": _range_difference,
    "range_rate": _range_rate,
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

# Columns of ImuFeatures, one value per inertial sample
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

# Names of OF_TDOA that SensorSamples have too
OF_SENSORS = (
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

# States by which the filter differentiates a function of a covariate: position (0, 1, 2) and
# velocity (3, 4, 5). Not the speed: the direction of a slow motion is unknown, and its Jacobian
# made estimates worse.
STATES = {
    **dict.fromkeys(("x", "y", "height", *OF_ARRIVAL), (0, 1, 2)),
    "climb_rate": (5,),
    "range_rate": (0, 1, 2, 3, 4, 5),
}

# Covariates of inertial sensors that are states of the filter
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
    "yaw": "rad",
    "interval": "s",
    "previous_anchor": "id",
    "vibration": "m/s^2",
    **dict.fromkeys(OF_ARRIVAL, "rad"),
    "range": "m",
    "range_difference": "m",
    "range_rate": "m/s",
    **dict.fromkeys((name for name in OF_IMU if name.startswith("rate_")), "rad/s"),
    **dict.fromkeys((name for name in OF_IMU if name.startswith("accel")), "m/s^2"),
}
DEGREES = math.degrees(1.0)  # degrees per radian
EXTRA = "extra."  # prefix of further columns of a log: "extra.STREAM.COLUMN"
OF_ACCEL = ("accel", "accel_x", "accel_y", "accel_z")  # specific force, m/s^2


def shown_in(covariate: str, unknown: str = "") -> tuple[str, float]:
    """Return (unit, factor from its unit) in which people read a covariate: angles in degrees.

    unknown : unit of columns of logs
    """
    unit = UNITS.get(covariate, unknown)
    return ("degrees", DEGREES) if unit == "rad" else (unit, 1.0)


def sensor_covariate(name: str, samples: ImuSamples | SensorSamples) -> np.ndarray | None:
    """Return a covariate of ImuSamples or SensorSamples, (n,); None if the samples lack it.

    name : of OF_SENSORS; for ImuSamples also of OF_IMU, or "extra.NAME"
    """
    if name.startswith(EXTRA):
        if not isinstance(samples, ImuSamples):
            return None
        return (samples.extra or {}).get(name.removeprefix(EXTRA))
    if samples.channel == "accel" and name in OF_ACCEL:
        # The true force: the measured one shares its noise with the residual.
        reading = samples.reading
        return _norm(reading) if name == "accel" else reading[:, "xyz".index(name[-1])]
    if name in OF_IMU and isinstance(samples, ImuSamples):
        return samples.features[:, OF_IMU.index(name)]
    return OF_TDOA[name](samples)


def covariate_of(samples: Samples, name: str) -> Any:
    """Return a covariate of OF_TDOA, (n,) or None, or of OF_ARRIVAL, (ends * n,).

    Effects on the same samples share it; it is computed once, and must not be changed.
    """
    of_arrival = OF_ARRIVAL.get(name)
    if of_arrival is None:
        return samples.kept(name, lambda: OF_TDOA[name](samples))
    return samples.kept(name, lambda: of_arrival(samples, samples.rows))


def has_domain(name: str) -> bool:
    """Return whether a covariate has a domain: a number that nodes can compute."""
    return name not in CATEGORIES and not name.startswith(EXTRA)


def checked_domain(effect: str, domain: Any) -> dict[str, tuple[float, float]]:
    """Return a domain of effects.yaml as {covariate: (low, high)}; raise InputError.

    effect : its name, for messages
    """
    out = {}
    known = (*OF_TDOA, *OF_ARRIVAL, *OF_IMU)
    for covariate, limits in (domain or {}).items():
        name = str(covariate)
        try:
            low, high = map(float, limits)
        except (TypeError, ValueError):
            low = high = np.nan
        if name not in known or not has_domain(name) or not -np.inf < low <= high < np.inf:
            raise InputError(
                f"effects: {effect}: domain: {covariate}: {limits!r}; expected a covariate "
                "with the least and the largest value seen, as time: [0, 60]."
            )
        out[name] = low, high
    return out


def fade_weight(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Return the weight of an effect at values (n,) of a covariate with a domain, (n,).

    It is 1 within the limits, and 1 for an unknown value.
    """
    low, high = limits
    beyond = np.maximum(np.maximum(low - values, values - high), 0.0)
    if isinstance(beyond, np.ndarray) and not beyond.any():
        return np.ones(beyond.shape)  # the usual case
    return np.exp(-0.5 * (np.nan_to_num(beyond) / (FADE * max(high - low, 1e-6))) ** 2)


class ImuFeatures:
    """The covariates OF_IMU along a stream of inertial samples, from its past alone."""

    def __init__(self) -> None:
        # Rows: last and first stamp; low-passed rate; low-passed force; power of the vibration.
        self._state = np.zeros((4, 3))
        self._state[0, :2] = np.nan

    def __call__(self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
        """Return features (n, len(OF_IMU)) of t (n,) s, gyro (n, 3) rad/s, accel (n, 3) m/s^2."""
        out = np.empty((len(t), len(OF_IMU)))
        t, gyro, accel = (np.ascontiguousarray(column) for column in (t, gyro, accel))
        _features(self._state, t, gyro, accel, out)
        return out


@compiled
def _features(
    state: np.ndarray, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray, out: np.ndarray
) -> None:
    rate, force, power = state[1], state[2], state[3]
    for i in range(len(t)):
        dt = t[i] - state[0, 0]
        if not 0.0 <= dt < 1.0:  # first sample, or after a gap
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
