# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tuning parameters of the filter, with unit and reason."""

from dataclasses import Field, dataclass, fields, make_dataclass
from difflib import get_close_matches
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.robust_loss import LOSSES
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.common.sensors.sensor import mistake, parameter

ROBUST = ("innovation", "gate", "m_estimation")
SIDES = "unknown", "below", "above", "-x", "+x", "-y", "+y"
# parameters with a fixed set of names
CHOICES = {"robust": ROBUST, "loss": LOSSES, "tag_side": SIDES}
NEAR = 0.8  # similarity of two names, above which one is taken for a mistyped other
PLANAR_HEIGHT_STD = 0.02  # m


@dataclass(frozen=True)
class _FilterParameters:
    # The measurement
    tdoa_std: float = parameter(
        0.25,
        "m; deviation of a TDOA from its prediction, uncorrected systematic part included",
        high=100.0,
    )
    tdoa_correlation_time: float = parameter(
        5.0, "s; longest time for which errors of TDOAs stay alike while the tag moves", high=1000.0
    )
    tdoa_correlation_distance: float = parameter(
        5.0, "m; longest way over which errors of TDOAs stay alike", high=1000.0
    )
    adapt_noise: bool = parameter(
        True,
        (
            "learn from the innovations how large the errors of TDOAs are, and how alike; false: "
            "white noise of tdoa_std"
        ),
    )
    noise_memory: float = parameter(0.5, "s over which it is learned", high=1000.0)
    robust: str = parameter(
        "innovation",
        "against outliers: innovation (weight from the whitened innovation), gate, m_estimation",
    )
    loss: str = parameter(
        "geman_mcclure",
        "weight function of innovation and m_estimation: geman_mcclure, huber, cauchy",
    )
    measurement_scale: float = parameter(
        2.5, "standard deviations of a measurement at which the loss bends", high=1e8
    )
    state_scale: float = parameter(2.5, "the same for the prior's share in m_estimation", high=1e8)
    iterations: int = parameter(2, "re-weightings per update of m_estimation", high=100)
    gate: float = parameter(3.0, "standard deviations beyond which gate rejects", high=1e8)

    # The motion
    use_imu: bool = parameter(
        True,
        "false: a tag without an IMU goes on as wheels turn, or at constant velocity",
        fixed=True,
    )
    motion_noise: float = parameter(
        1.5,
        (
            "m/s^2/sqrt(Hz); random acceleration of the tag while no IMU says better; learned from "
            "the innovations, from here on"
        ),
        high=1000.0,
    )
    turn_noise: float = parameter(
        0.5,
        "rad/s/sqrt(Hz); random turn of the tag while neither an IMU nor wheels measure how it turns",
        high=100.0,
    )
    imu_timeout: float = parameter(
        0.1, "s without an IMU sample after which motion_noise takes over", high=10.0
    )
    accel_noise: float = parameter(0.1, "m/s^2/sqrt(Hz); accelerometer, motors running", high=100.0)
    gyro_noise: float = parameter(0.005, "rad/s/sqrt(Hz); gyroscope", high=10.0)
    accel_bias_walk: float = parameter(
        0.01, "m/s^3/sqrt(Hz); how fast the accelerometer's bias wanders", high=100.0
    )
    gyro_bias_walk: float = parameter(
        1e-4, "rad/s^2/sqrt(Hz); how fast the gyroscope's bias wanders", high=10.0
    )
    accel_prior_std: float = parameter(
        1.5,
        (
            "m/s^2; deviation of the specific force from hovering, per axis, known before it is "
            "measured"
        ),
        high=1000.0,
    )
    vibration_gain: float = parameter(
        4.0,
        (
            "variance of a vibrating accelerometer's error over that of its vibration; 0.0: it "
            "has none"
        ),
        high=1000.0,
        with_low=True,
    )
    workspace_margin: float = parameter(
        1.0,
        (
            "m beyond the anchors' extent; a tag further out is drawn back while less is known of "
            "its place"
        ),
        high=10000.0,
        fixed=True,
    )
    radio_reach: float = parameter(
        30.0,
        (
            "m; a tag is looked for within that of each anchor it hears, or as far as these are "
            "apart, if that is more"
        ),
        high=10000.0,
    )
    tag_side: str = parameter(
        "unknown",
        (
            "of anchors that lie in a plane: on which side of it the tag is, below, above, or "
            "along an axis of the world, -x, +x, -y, +y"
        ),
    )
    zero_velocity: bool = parameter(
        True,
        (
            "a tag whose TDOAs stay what they are, or whose inertial sensors neither shake nor "
            "turn, stands still"
        ),
    )
    recover: bool = parameter(
        True,
        (
            "find the tag anew, untold where it is, when the TDOAs agree on another place that it "
            "can have come to"
        ),
    )
    compensate_changes: bool = parameter(
        False, "take out the delay of an anchor that is found to have changed in flight"
    )

    # The start
    initial_yaw: float = parameter(0.0, "rad; yaw of the body at the start", high=7.0, low=-7.0)
    initial_yaw_std: float = parameter(
        6.3,
        "rad; its deviation; above 0.6 it is unknown: four yaws are followed until motion tells",
        high=100.0,
    )
    initial_accel_bias_std: float = parameter(
        0.1, "m/s^2; of the accelerometer's bias about 0", high=100.0
    )
    initial_gyro_bias_std: float = parameter(
        0.01, "rad/s; of the gyroscope's bias about 0", high=10.0
    )
    start_window: float = parameter(
        0.5, "s of TDOAs from which the start position is found", high=10.0
    )
    start_timeout: float = parameter(
        1.0, "s after which a start from contradicting TDOAs is better than none", high=1000.0
    )


# Parameters of the sensors other than IMU and TDOA.
for _sensor in SENSORS.values():
    if _taken := set(_sensor.parameters) & {each.name for each in fields(_FilterParameters)}:
        raise mistake(
            _sensor.name,
            "parameters",
            f"the filter has {', '.join(sorted(_taken))} already. Choose another name.",
        )
_PARAMETERS = [
    (name, type(each.default), each)
    for sensor in SENSORS.values()
    for name, each in sensor.parameters.items()
]
if TYPE_CHECKING:
    _SensorParameters = _FilterParameters
else:
    _SensorParameters = make_dataclass(
        "_SensorParameters", _PARAMETERS, bases=(_FilterParameters,), frozen=True
    )


@dataclass(frozen=True)
class FilterConfig(_SensorParameters):
    """Tuning of the filter; the parameters of the node have the same names."""

    # The floor
    fixed_height: float = parameter(
        0.0,
        "m; height of body_frame in the world, of what stays on its floor",
        high=10000.0,
        low=-10000.0,
    )
    fixed_height_std: float = parameter(
        0.0,
        "m; its standard deviation; 0.0: the tag does not stay there, or, if it is planar, 0.02",
        high=10.0,
        with_low=True,
    )
    planar: bool = parameter(
        False,
        (
            "a vehicle on a level floor: height, roll and pitch of the odometry are fixed_height, "
            "0 and 0"
        ),
        fixed=True,
    )
    tilt_std: float = parameter(
        0.02, "rad; of roll and pitch of a planar vehicle about 0", high=1.0
    )
    non_holonomic_std: float = parameter(
        0.0,
        (
            "m/s; of velocities across the body's x, of a vehicle that cannot move sideways; 0.0: "
            "it can"
        ),
        high=100.0,
        with_low=True,
    )

    # The output
    odometry_rate: float = parameter(200.0, "Hz of stamps; at most this often", high=1e6)

    def __post_init__(self) -> None:
        for each in fields(self):
            name, value = each.name, getattr(self, each.name)
            if name in CHOICES:
                if value not in CHOICES[name]:
                    raise InputError(f"{name}: {value!r} is not one of {', '.join(CHOICES[name])}.")
            elif each.type is bool:
                if not isinstance(value, bool):
                    raise InputError(f"{name}: {value!r} must be true or false.")
            else:
                object.__setattr__(self, name, _number(each, value))

    @property
    def known_height_std(self) -> float:
        """Return the standard deviation of fixed_height, m; 0.0 for a tag that does not stay there."""
        return self.fixed_height_std or (PLANAR_HEIGHT_STD if self.planar else 0.0)

    @classmethod
    def from_yaml(cls, path: str | Path) -> "FilterConfig":
        """Read the parameters of ekf_node in a parameter file of ROS.

        In a file of several nodes those of `/**` and of ekf_node count. Parameters that do not tune the
        filter are ignored. Raises InputError, also for a name that nearly is one of the filter.
        """
        content, names = read_yaml(path), {each.name for each in fields(cls)}
        try:
            own = [key for key in map(str, content) if key.rpartition("/")[2] in ("**", "ekf_node")]
            if not own or sum(key.endswith("ekf_node") for key in own) > 1:
                own = [*content]
                (_,) = own  # the parameters of one node
            given: dict[str, Any] = {}
            for key in sorted(own, key=len):  # /** is the shortest; the others override it
                given |= content[key]["ros__parameters"]
            for name in sorted(map(str, given.keys() - names)):
                if near := get_close_matches(name, names, n=1, cutoff=NEAR):
                    raise InputError(f"{name}: is no parameter of the filter; write {near[0]}.")
            return cls(**{name: given[name] for name in given.keys() & names})
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}: expected the 'ros__parameters' of one ekf_node, as in ekf_node.yaml."
            ) from error

    def parameters(self) -> np.ndarray:
        """Return the configuration as the compiled core takes it: (1,) PARAMETERS.

        A choice becomes its index in CHOICES.
        """
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        values["fixed_height_std"] = self.known_height_std
        places = (
            CHOICES[name].index(value) if name in CHOICES else value
            for name, value in values.items()
        )
        return np.array([tuple(places)], PARAMETERS)


PARAMETERS = np.dtype(
    [(f.name, np.int64 if f.name in CHOICES else f.type) for f in fields(FilterConfig)], align=True
)


def _number(parameter: Field[Any], value: Any) -> float:
    """Return `value` in the type of a field of FilterConfig.

    Raises InputError if it is not a number or out of bounds.
    """
    kind: Any = parameter.type
    low, high, with_low = (parameter.metadata[name] for name in ("low", "high", "with_low"))
    try:
        number = kind(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not (low < number <= high or (with_low and number == low)) or number != value:
        what = "whole number" if kind is int else "number"
        raise InputError(
            f"{parameter.name}: {value!r} must be a {what} above {low:g}, at most {high:g}."
        )
    return number
