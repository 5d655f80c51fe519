"""A velocity in the body frame: wheels, optical flow, visual odometry."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..later import rotations
from .sensor import UNKNOWN_STD, UNKNOWN_VARIANCE, Compared, Sensor, Stream, finite, parameter

FASTEST = 100.0  # m/s
LEAST_STD = 0.01  # m/s, that a simulated velocity says of itself


@dataclass(frozen=True)
class Velocity(Stream):
    """Velocities in the body frame. t : (n,) s; v : (n, 3) m/s; std : (n, 3) m/s, inf for a component that is not
    measured."""

    t: np.ndarray
    v: np.ndarray
    std: np.ndarray

    @property
    def values(self) -> np.ndarray:
        return self.v

    def with_values(self, values: np.ndarray) -> "Velocity":
        return replace(self, v=values)


def _columns(fields: dict) -> tuple:
    variance = fields["twist.covariance"][:, [0, 7, 14]]
    known = (variance >= 0.0) & (variance < UNKNOWN_VARIANCE)
    return fields["twist.twist.linear"], np.sqrt(np.where(known, variance, np.inf))


def _content(velocity: Velocity) -> dict:
    variance = np.full((len(velocity), 6), UNKNOWN_VARIANCE)  # rates are not measured
    variance[:, :3] = np.minimum(velocity.std**2, UNKNOWN_VARIANCE)
    return {"twist.twist.linear": velocity.v, "twist.covariance": (variance[:, :, None] * np.eye(6)).reshape(-1, 36)}


def _sound(fields: dict) -> dict:
    _, std = _columns(fields)
    sound = finite(fields)
    linear, covariance = sound
    return {linear: sound[linear] | np.isinf(std), covariance: np.ones(sound[covariance].shape, dtype=bool)}


def _measured(velocity: Velocity) -> tuple[dict, np.ndarray]:
    v, std = velocity.v, velocity.std
    known = np.isfinite(std)
    sane = np.where(known, (np.abs(v) < FASTEST) & (std > 0.0), True).all(axis=1)
    rows = {"value": np.where(known, v, 0.0), "std": np.where(known, std, UNKNOWN_STD)}
    return rows, sane & known.any(axis=1) & ~np.isnan(std).any(axis=1)


def _simulated(config: Any, room: Any, motion: Any, turn: Any, noise: Any) -> tuple:
    v = turn.inv().apply(motion.v) + config.velocity_noise * noise(3)
    return v, np.full(v.shape, max(config.velocity_noise, LEAST_STD))


SENSOR = Sensor(
    name="velocity",
    plural="velocities",
    stream=Velocity,
    message="geometry_msgs/msg/TwistWithCovarianceStamped",
    fields={"twist.twist.linear": 3, "twist.covariance": 36},
    columns=_columns,
    content=_content,
    sound=_sound,
    measured=_measured,
    simulated=_simulated,
    noise=("M/S", "write velocities in the body frame"),
    parameters={"use_velocity": parameter(True, "use velocities in the body frame, if there are any", fixed=True)},
    invalid="give m/s and a covariance that is neither 0 nor unknown for all components",
    remedy="its unit and how it is turned (velocity_misalignment in effects_file), and look for slip",
    compared=Compared(
        lambda track, t: rotations.Rotation.from_quat(track.attitudes(t)).inv().apply(track.velocities(t)),
        "a velocity (wheels, optical flow, visual odometry), and ground truth of position and attitude",
        negligible=0.003, unit="m/s", axes=(".x", ".y", ".z"), positions=(0, 1, 2),
    ),
    others=(("velocity/odometry", "nav_msgs/msg/Odometry"),),
)  # fmt: skip
