# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A velocity in the body frame: wheels, optical flow, visual odometry."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import rotations
from .sensor import UNKNOWN_STD, UNKNOWN_VARIANCE, Compared, Sensor, Stream, finite, parameter

FASTEST = 100.0  # m/s, and rad/s
LEAST_STD = 0.01  # m/s, smallest stated deviation of a simulated velocity
TURN_TIME = 0.1  # s, interval of the difference that gives the yaw rate


@dataclass(frozen=True)
class YawRate(Stream):
    """Yaw rates of the messages of a Velocity.

    Attributes
    ----------
    t : (n,) s
    rate : (n, 1) rad/s, about the body's z
    std : (n, 1) rad/s, inf where not measured, 0 where the driver states none
    """

    t: np.ndarray
    rate: np.ndarray
    std: np.ndarray

    @property
    def values(self) -> np.ndarray:
        return self.rate

    def with_values(self, values: np.ndarray) -> YawRate:
        return replace(self, rate=values)


@dataclass(frozen=True)
class Velocity(Stream):
    """Velocities in the body frame.

    Attributes
    ----------
    t : (n,) s
    v : (n, 3) m/s, body
    std : (n, 3) m/s, inf for a component that is not measured, 0 where the driver states none
    yaw_rate : (n,) rad/s about the body's z, as of wheels, NaN where not measured (default: NaN)
    yaw_rate_std : (n,) rad/s, inf and 0 as in std
    """

    t: np.ndarray
    v: np.ndarray
    std: np.ndarray
    yaw_rate: np.ndarray = None  # type: ignore[assignment]  # __post_init__ sets NaN
    yaw_rate_std: np.ndarray = None  # type: ignore[assignment]  # __post_init__ sets inf or 0

    def __post_init__(self) -> None:
        if self.yaw_rate is None:
            object.__setattr__(self, "yaw_rate", np.full(len(self.t), np.nan))
        if self.yaw_rate_std is None:
            object.__setattr__(self, "yaw_rate_std", np.where(np.isnan(self.yaw_rate), np.inf, 0.0))

    @property
    def values(self) -> np.ndarray:
        return self.v

    def with_values(self, values: np.ndarray) -> Velocity:
        return replace(self, v=values)

    @property
    def parts(self) -> dict[str, Stream]:
        rate, std = self.yaw_rate[:, None], self.yaw_rate_std[:, None]
        return {"yaw_rate": YawRate(self.t, rate, std)} if np.isfinite(std).any() else {}

    def with_part(self, channel: str, part: Any) -> Velocity:
        return replace(self, yaw_rate=part.rate[:, 0], yaw_rate_std=part.std[:, 0])


def _columns(fields: dict) -> tuple:
    """Return v (n, 3) m/s, its std, the yaw rate (n,) rad/s, and its std.

    A variance of 0 means that the driver states none. A yaw rate counts as not measured if its value
    and variance are 0 while the velocity has a variance.
    """
    variance = fields["twist.covariance"][:, [0, 7, 14, 35]]
    rate = fields["twist.twist.angular"][:, 2]
    std = np.sqrt(np.where((variance >= 0.0) & (variance < UNKNOWN_VARIANCE), variance, np.inf))
    linear = std[:, :3]
    silent = (
        (variance[:, 3] == 0.0) & (rate == 0.0) & (np.isfinite(linear) & (linear > 0.0)).any(axis=1)
    )
    rate_std = np.where(silent, np.inf, std[:, 3])
    return (
        fields["twist.twist.linear"],
        linear,
        np.where(np.isinf(rate_std), np.nan, rate),
        rate_std,
    )


def _in_body(fields: dict, turn: Any, arm: np.ndarray) -> dict:
    """Return the fields in the body: v = R v - (R w) x arm, and both blocks of the covariance turned."""
    matrix = turn.as_matrix()
    rates = fields["twist.twist.angular"] @ matrix.T
    covariance = fields["twist.covariance"].reshape(-1, 6, 6).copy()
    diagonal = np.einsum("nii->ni", covariance)
    diagonal[diagonal < 0.0] = UNKNOWN_VARIANCE
    both = np.kron(np.eye(2), matrix)
    return {
        "twist.twist.linear": fields["twist.twist.linear"] @ matrix.T - np.cross(rates, arm),
        "twist.twist.angular": rates,
        "twist.covariance": (both @ covariance @ both.T).reshape(-1, 36),
    }


def _content(velocity: Velocity) -> dict:
    variance = np.full((len(velocity), 6), UNKNOWN_VARIANCE)  # rates about x and y are not measured
    variance[:, :3] = np.minimum(velocity.std**2, UNKNOWN_VARIANCE)
    variance[:, 5] = np.minimum(velocity.yaw_rate_std**2, UNKNOWN_VARIANCE)
    angular = np.zeros((len(velocity), 3))
    angular[:, 2] = np.where(variance[:, 5] < UNKNOWN_VARIANCE, velocity.yaw_rate, 0.0)
    return {
        "twist.twist.linear": velocity.v,
        "twist.twist.angular": angular,
        "twist.covariance": (variance[:, :, None] * np.eye(6)).reshape(-1, 36),
    }


def _sound(fields: dict) -> dict:
    _, std, _, rate_std = _columns(fields)
    linear, angular, covariance = sound = finite(fields)
    of_rates = np.ones(sound[angular].shape, dtype=bool)  # rates about x and y are not read
    of_rates[:, 2] = sound[angular][:, 2] | np.isinf(rate_std)
    return {
        linear: sound[linear] | np.isinf(std),
        angular: of_rates,
        covariance: np.ones(sound[covariance].shape, dtype=bool),
    }


def _measured(velocity: Velocity) -> tuple[dict, np.ndarray]:
    v = np.column_stack([velocity.v, velocity.yaw_rate])
    std = np.column_stack([velocity.std, velocity.yaw_rate_std])
    known = np.isfinite(std)
    sane = np.where(known, (np.abs(v) < FASTEST) & (std >= 0.0), True).all(axis=1)
    rows = {"value": np.where(known, v, 0.0), "std": np.where(known, std, UNKNOWN_STD)}
    return rows, sane & known.any(axis=1) & ~np.isnan(std).any(axis=1)


def _assumed(velocity: Velocity) -> tuple[str, ...]:
    of_parameters = {"velocity_std": velocity.std, "yaw_rate_std": velocity.yaw_rate_std}
    return tuple(name for name, std in of_parameters.items() if (std == 0.0).any())


def _simulated(config: Any, room: Any, motion: Any, turn: Any, noise: Any) -> tuple:
    v = turn.inv().apply(motion.v) + config.velocity_noise * noise(3)
    return v, np.full(v.shape, max(config.velocity_noise, LEAST_STD))


def _turning(track: Any, t: np.ndarray) -> np.ndarray:
    """Return rates about the body's z, (n, 1) rad/s, of a Track at stamps t (n,) s."""
    before, after = (
        rotations.Rotation.from_quat(track.attitudes(t + late))
        for late in (-0.5 * TURN_TIME, 0.5 * TURN_TIME)
    )
    turns: np.ndarray = (before.inv() * after).as_rotvec()
    return turns[:, 2:] / TURN_TIME


SENSOR = Sensor(
    name="velocity",
    plural="velocities",
    stream=Velocity,
    message="geometry_msgs/msg/TwistWithCovarianceStamped",
    fields={"twist.twist.linear": 3, "twist.twist.angular": 3, "twist.covariance": 36},
    columns=_columns,
    content=_content,
    sound=_sound,
    measured=_measured,
    simulated=_simulated,
    noise=("M/S", "write velocities in the body frame", 0.05),
    parameters={
        "use_velocity": parameter(
            True, "use velocities in the body frame, if there are any", fixed=True
        ),
        "velocity_std": parameter(
            0.03,
            (
                "m/s; of a component of the velocity whose variance in the message is 0: the "
                "driver states none"
            ),
            high=100.0,
        ),
        "yaw_rate_std": parameter(
            0.05,
            (
                "rad/s; the same of the yaw rate in such a message; 0.0: yaw rates without a "
                "variance are not used"
            ),
            high=100.0,
            with_low=True,
        ),
    },
    invalid="give m/s, rad/s, and a covariance that is not unknown for all components",
    remedy="its unit and how it is turned (velocity_misalignment in effects_file), and look for slip",
    compared=Compared(
        lambda track, t: (
            rotations.Rotation.from_quat(track.attitudes(t)).inv().apply(track.velocities(t))
        ),
        (
            "a velocity (wheels, optical flow, visual odometry), and ground truth of position and "
            "attitude"
        ),
        negligible=0.003,
        unit="m/s",
        axes=(".x", ".y", ".z"),
        positions=(0, 1, 2),
    ),
    parts={
        "yaw_rate": Compared(
            _turning,
            "a yaw rate (wheels), and ground truth of the attitude",
            negligible=0.002,
            unit="rad/s",
            positions=(),
        )
    },
    others=(("velocity/odometry", "nav_msgs/msg/Odometry"),),
    assumed=_assumed,
    in_body=_in_body,
)
