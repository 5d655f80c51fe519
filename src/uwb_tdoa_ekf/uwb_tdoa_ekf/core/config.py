"""Every number that tunes the filter, with its unit and why it is what it is."""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import yaml

from uwb_tdoa_bias.foundation.errors import InputError

ROBUST = ("innovation", "gate", "m_estimation")
LOSSES = ("geman_mcclure", "huber", "cauchy")


@dataclass(frozen=True)
class FilterConfig:
    """Tuning of the filter. The node's parameters have the same names."""

    tdoa_std: float = 0.25  # m, spread of a TDOA about its prediction, systematic part that was not corrected included
    tdoa_correlation: float = 6.0  # n successive TDOAs tell as much as n / this independent ones; 1 for white noise
    adapt_noise: bool = True  # learn the noise of each anchor beyond tdoa_std from the innovations
    noise_memory: float = 0.5  # s over which it is learned
    robust: str = "innovation"  # weight from the whitened innovation; "gate": 0 or 1; "m_estimation": Zhao et al. IV-A
    loss: str = "geman_mcclure"  # or "huber", "cauchy": for "innovation" and "m_estimation"
    measurement_scale: float = 2.5  # standard deviations at which the loss bends
    state_scale: float = 2.5  # the same for the prior's share in "m_estimation"
    iterations: int = 2  # of "m_estimation"
    gate: float = 3.0  # standard deviations, for "gate"

    use_imu: bool = True  # False: constant velocity, for tags without an IMU
    motion_noise: float = 1.5  # m/s^2/sqrt(Hz), random acceleration of the tag while no IMU says better
    imu_timeout: float = 0.1  # s without an IMU sample after which motion_noise takes over
    accel_noise: float = 0.1  # m/s^2/sqrt(Hz), motors running
    gyro_noise: float = 0.005  # rad/s/sqrt(Hz)
    accel_bias_walk: float = 0.01  # m/s^3/sqrt(Hz)
    gyro_bias_walk: float = 1e-4  # rad/s^2/sqrt(Hz)
    vibration_trust: float = 1.5  # m/s^2, acceleration that is plausible for the vehicle; stronger vibration is not believed
    vibration_gain: float = 4.0  # variance of a vibrating accelerometer's error over that of its vibration; 0: it has none

    reach: float = 1.0  # m beyond the anchors' extent, where a tag is not believed to be without strong evidence
    zero_velocity: bool = True  # a tag whose inertial sensors neither shake nor turn stands still
    recover: bool = True  # find the tag anew, without being told where it is, when the TDOAs agree on another place

    initial_yaw: float = 0.0  # rad
    initial_yaw_std: float = 6.3  # rad; above 0.6 the yaw counts as unknown: four directions are followed until one is left
    initial_accel_bias_std: float = 0.1  # m/s^2
    initial_gyro_bias_std: float = 0.01  # rad/s
    start_window: float = 0.5  # s of TDOAs from which the start position is found
    start_patience: float = 1.0  # s after which a start from contradicting TDOAs is better than none

    odometry_rate: float = 200.0  # Hz

    def __post_init__(self):
        for name, allowed in (("robust", ROBUST), ("loss", LOSSES)):
            if getattr(self, name) not in allowed:
                raise InputError(f"{name}: {getattr(self, name)!r} is not one of {', '.join(allowed)}.")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is bool and not isinstance(value, bool):
                raise InputError(f"{field.name}: {value!r} must be true or false.")
            if field.type not in (float, int):
                continue
            try:
                number = field.type(value)  # one set of types, or the core would be compiled for every mixture
            except (TypeError, ValueError, OverflowError):
                number = math.nan
            low = -1e9 if field.name == "initial_yaw" else 0.0
            zero = field.name == "vibration_gain" and number == 0.0
            if not (low < number < 1e9 or zero) or number != value:
                kind = "whole number" if field.type is int else "number"
                raise InputError(f"{field.name}: {value!r} must be a {kind} above {low:g}.")
            object.__setattr__(self, field.name, number)

    @classmethod
    def from_yaml(cls, path):
        """Read the ros__parameters of a node's parameter file; those that do not tune the filter are passed over."""
        try:
            content = yaml.safe_load(Path(path).read_text())
            (node,) = content.values()
            parameters = node["ros__parameters"]
            return cls(**{field.name: parameters[field.name] for field in fields(cls) if field.name in parameters})
        except (OSError, yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: expected one node's 'ros__parameters' mapping, as in ekf_node.yaml.") from error

    def tuning(self):
        """The numbers the compiled core reads."""
        values = {name: getattr(self, name) for name in Tuning._fields if name not in ("robust", "loss")}
        return Tuning(robust=ROBUST.index(self.robust), loss=LOSSES.index(self.loss), **values)


class Tuning(NamedTuple):
    """FilterConfig as the compiled core takes it: names replaced by their place in ROBUST and LOSSES."""

    tdoa_std: float
    tdoa_correlation: float
    adapt_noise: bool
    noise_memory: float
    robust: int
    loss: int
    measurement_scale: float
    state_scale: float
    iterations: int
    gate: float
    use_imu: bool
    motion_noise: float
    imu_timeout: float
    accel_noise: float
    gyro_noise: float
    accel_bias_walk: float
    gyro_bias_walk: float
    vibration_trust: float
    vibration_gain: float
    reach: float
    zero_velocity: bool
    recover: bool
    initial_yaw: float
    initial_yaw_std: float
    initial_accel_bias_std: float
    initial_gyro_bias_std: float
    start_window: float
    start_patience: float
    odometry_rate: float
