# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of sensors on the tag: inertial ones, a range finder, a barometer, a velocity sensor.

Effects of late stamps, stream by stream: stamp = instant of the measurement + `offset`.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
import math
from typing import Any, ClassVar

import numpy as np

from ..common.arrays import rotations
from ..common.flight import Flight
from ..common.sensors import DIAGNOSED, with_measured
from .base import (
    IDENTITY,
    UNLIMITED,
    Affine,
    DetectedEffect,
    Effect,
    Row,
    central_differences,
    finite,
    interval_words,
    is_within,
    require,
)
from .samples import ImuSamples, Samples, SensorSamples, Track, sensor_samples

INERTIAL = ("gyro", "accel")  # channels of an IMU
# `penalty` of effects that look like a bias of the accelerometer without tilt and manoeuvres
BESIDE_BIAS = 2.0
AXES = ("x", "y", "z")
LIMITS = ("start", "end")  # s after the first TDOA


class SensorEffect(Effect):
    """An effect with an affine sensor model, measured = matrix true + offset, on its channels."""

    def vector(self) -> np.ndarray:
        """Return the values of its parameters, (k,)."""
        return np.array(
            [self.values.get(key, 0.0) for key in self.parameters or (self.row.example,)]
        )

    def model(self) -> Affine:
        """Return the Affine from true to measured values."""
        raise NotImplementedError

    def sensor_model(self, channel: str) -> Affine:
        return self.model() if channel in self.channels else IDENTITY

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        def measured_at(values: dict[str, float]) -> np.ndarray:
            return type(self)(values).sensor_model(samples.channel)(samples.reading)

        return central_differences(measured_at, self.values, keys, 1e-6)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        for channel in self.channels:
            if channel in INERTIAL:
                imu = require(self, flight, "imu")
                sensed = {channel: self.model()(getattr(imu, channel))}
                flight = replace(flight, imu=replace(imu, **sensed))
            else:
                part = require(self, flight, channel)
                flight = with_measured(flight, channel, part.sensed(self.model()(part.values)))
        return flight


class SensorOffset(SensorEffect):
    """Measured = true + values."""

    def model(self) -> Affine:
        return Affine(np.eye(len(self.vector())), self.vector())


class SensorScale(SensorEffect):
    """Measured = (1 + values) true, axis by axis."""

    def model(self) -> Affine:
        return Affine(np.diag(1.0 + self.vector()), np.zeros(len(self.vector())))


class SensorTurn(SensorEffect):
    """Measured = R^T true, with R of a rotation vector from body to sensor axes."""

    def model(self) -> Affine:
        return Affine(rotations.Rotation.from_rotvec(self.vector()).as_matrix().T, np.zeros(3))


class GyroBias(SensorOffset):
    """Measured rate = true rate + (x, y, z), body."""

    row = Row(
        name="gyro_bias",
        unit="rad/s",
        bound=1.0,
        negligible=0.002,
        prior_std=0.05,
        example="z",
        physics="zero-rate offset of a MEMS gyroscope, with temperature and age",
        reference="BMI088 data sheet: zero-rate offset 1 degree/s",
        remedy="Let the gyroscope find its zero at rest before take-off: it reads {found}.",
        phrase="{size} {way} about {key}",
        ways=("too much", "too little"),
    )
    channels = ("gyro",)
    parameters = AXES


class GyroScale(SensorScale):
    """Measured rate = (1 + (x, y, z)) true rate, axis by axis."""

    row = Row(
        name="gyro_scale",
        unit="1",
        bound=0.5,
        negligible=0.01,
        prior_std=0.05,
        example="z",
        physics="sensitivity error of a MEMS gyroscope",
        reference="BMI088 data sheet: sensitivity tolerance 1 %",
        confounded_with=("truth_time_offset", "imu_misalignment"),
        remedy="Calibrate the gyroscope on a turntable: it reads {found}.",
        phrase="{size} {way} about {key}",
        ways=("too much", "too little"),
        shown=("%", 100.0),
    )
    channels = ("gyro",)
    parameters = AXES


class AccelBias(SensorOffset):
    """Measured force = true specific force + (x, y, z), body."""

    row = Row(
        name="accel_bias",
        unit="m/s^2",
        bound=10.0,
        negligible=0.03,
        prior_std=0.5,
        example="x",
        physics="zero-g offset of a MEMS accelerometer, and vibration that it rectifies",
        reference="BMI088 data sheet: zero-g offset 20 mg",
        confounded_with=("imu_misalignment", "imu_gravity", "accel_scale"),
        remedy=(
            "Calibrate the accelerometer at rest and damp the vibration of its mount: it "
            "reads {found}."
        ),
        phrase="{size} {way} along {key}",
        ways=("too much", "too little"),
    )
    channels = ("accel",)
    parameters = AXES
    sizable_share = 0.3  # one axis suffices, else a scale replaces the bias of the others


class AccelScale(SensorScale):
    """Measured force = (1 + (x, y, z)) true specific force, axis by axis."""

    row = Row(
        name="accel_scale",
        unit="1",
        bound=0.5,
        negligible=0.004,
        prior_std=0.05,
        example="z",
        physics="sensitivity error of a MEMS accelerometer",
        reference="BMI088 data sheet: sensitivity tolerance 0.7 %",
        confounded_with=("accel_bias", "imu_gravity"),
        distinguished_by={
            "accel_bias": "hard manoeuvres: a scale grows with them, a bias does not"
        },
        remedy="Calibrate the accelerometer, each axis up and down: it reads {found}.",
        phrase="{size} {way} along {key}",
        ways=("too much", "too little"),
        shown=("%", 100.0),
    )
    channels = ("accel",)
    parameters = AXES
    penalty = BESIDE_BIAS


class ImuMisalignment(SensorTurn):
    """Measured = R^T true, with R of the rotation vector (x, y, z) from body to IMU axes."""

    row = Row(
        name="imu_misalignment",
        unit="rad",
        bound=0.6,
        negligible=0.004,
        prior_std=0.05,
        example="x",
        physics="the sensor, or the frame of the ground truth, is turned against the body's axes",
        reference="strapdown navigation: mounting misalignment",
        confounded_with=("accel_bias", "gyro_scale"),
        distinguished_by={
            "accel_bias": "quick turns: a misalignment also shows on the gyroscope",
        },
        remedy=(
            "Turn the IMU by {found}: its axes are not those of the body as the ground truth "
            "has it."
        ),
        phrase="{value} about {key}",
        shown=("degrees", float(-np.degrees(1.0))),  # the turn back
    )
    channels = INERTIAL
    parameters = AXES


class ImuGravity(SensorEffect):
    """Gravity is 9.81 m/s^2 + `excess`, along the vertical of the world.

    It is corrected along the z axis of the body, without an attitude. At the tilt of a flight a few
    percent of the excess remain.
    """

    row = Row(
        name="imu_gravity",
        unit="m/s^2",
        bound=1.0,
        negligible=0.03,
        prior_std=0.1,
        example="excess",
        physics=(
            "local gravity, or the factor from g to m/s^2, differs from the 9.81 m/s^2 of the "
            "filter"
        ),
        reference="gravity is 9.780 to 9.832 m/s^2 between equator and pole",
        confounded_with=("accel_bias", "accel_scale"),
        distinguished_by={
            "accel_bias": "a flight that tilts, or the vehicle at rest on its sides",
            "accel_scale": "hard manoeuvres up and down: a scale grows with them, gravity does not",
        },
        remedy=(
            "Check the accelerometer's factor from g to m/s^2, and local gravity: it reads "
            "{found} upwards."
        ),
        ways=("too much", "too little"),
    )
    channels = ("accel",)
    penalty = BESIDE_BIAS

    def model(self) -> Affine:
        return Affine(np.eye(3), np.array([0.0, 0.0, self.values.get("excess", 0.0)]))

    def regressors(self, samples: ImuSamples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat(samples.up[:, :, None], len(keys), axis=2)  # the true vertical

    def uncorrected(self, samples: ImuSamples) -> np.ndarray:
        return self.values.get("excess", 0.0) * (samples.up - [0.0, 0.0, 1.0])

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        truth, imu = require(self, flight, "truth"), require(self, flight, "imu")
        error, q = self.model().offset, Track(truth).attitudes(imu.t)
        if np.isfinite(q).all():
            error = rotations.Rotation.from_quat(q).inv().apply(error)
        return replace(flight, imu=replace(imu, accel=imu.accel + error))


class HeightOffset(SensorOffset):
    """Measured range = true range from the origin of the body frame + `offset`.

    The parameter `height_arm` of the filter is -offset: set one of the two.
    """

    row = Row(
        name="height_offset",
        unit="m",
        bound=2.0,
        negligible=0.005,
        prior_std=0.1,
        example="offset",
        physics=(
            "the range finder reads too long, or is mounted above the origin of the body frame "
            "along its z"
        ),
        reference="VL53L1X data sheet: offset calibration, up to some centimetres",
        confounded_with=("height_scale",),
        distinguished_by={
            "height_scale": "a flight at several heights: an offset is the same at all of them"
        },
        remedy="Check where the range finder is mounted, and its offset: it reads {found}.",
        ways=("too long", "too short"),
    )
    channels = ("height",)


class HeightScale(SensorScale):
    """Measured range = (1 + `scale`) true range."""

    row = Row(
        name="height_scale",
        unit="1",
        bound=0.5,
        negligible=0.005,
        prior_std=0.05,
        example="scale",
        physics=(
            "a wrong unit or speed of propagation: of ultrasound, with the temperature of the air"
        ),
        reference="speed of sound: 0.18 % per degree",
        confounded_with=("height_offset",),
        distinguished_by={
            "height_offset": "a flight at several heights: a scale grows with height"
        },
        remedy="Check the unit and the calibration of the range finder: it reads {found}.",
        ways=("too long", "too short"),
        shown=("%", 100.0),
    )
    channels = ("height",)


class VelocityScale(SensorScale):
    """Measured velocity = (1 + `scale`) true velocity."""

    row = Row(
        name="velocity_scale",
        unit="1",
        bound=0.9,
        negligible=0.005,
        prior_std=0.1,
        example="scale",
        physics="a wheel of another radius, a wrong focal length or height of optical flow",
        reference=(
            "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: systematic errors "
            "of odometry"
        ),
        confounded_with=("velocity_slip",),
        distinguished_by={"velocity_slip": "a longer flight: a scale stays, slip ends"},
        remedy=(
            "Calibrate the velocity over a known distance (radius of the wheels, focal length): "
            "it is {found}."
        ),
        ways=("too fast", "too slow"),
        shown=("%", 100.0),
    )
    channels = ("velocity",)

    def vector(self) -> np.ndarray:
        return np.repeat(self.values.get("scale", 0.0), 3)


class YawRateScale(SensorScale):
    """Measured yaw rate = (1 + `scale`) true yaw rate."""

    row = Row(
        name="yaw_rate_scale",
        unit="1",
        bound=0.9,
        negligible=0.005,
        prior_std=0.1,
        example="scale",
        physics="the driver of the wheels assumes a wrong track width, or a wrong radius",
        reference=(
            "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: systematic errors "
            "of odometry"
        ),
        remedy=(
            "Calibrate the yaw rate over known turns (track width, radius of the wheels): it is "
            "{found}."
        ),
        ways=("too fast", "too slow"),
        shown=("%", 100.0),
    )
    channels = ("yaw_rate",)


class VelocityMisalignment(SensorTurn):
    """Measured velocity = R_z(yaw)^T true velocity, with `yaw` from body to sensor axes."""

    row = Row(
        name="velocity_misalignment",
        unit="rad",
        bound=math.pi,
        negligible=0.005,
        prior_std=0.1,
        example="yaw",
        physics=(
            "the camera, the flow sensor or the axes of the wheels are turned against the body's "
            "axes"
        ),
        reference=(
            "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: misalignment of "
            "wheels"
        ),
        remedy="Turn the velocity sensor, or its frame: seen from above it is turned {found}.",
        phrase="{way} by {size}",
        ways=("counterclockwise", "clockwise"),
        shown=("degrees", math.degrees(1.0)),
    )
    channels = ("velocity",)

    def vector(self) -> np.ndarray:
        return np.array([0.0, 0.0, self.values.get("yaw", 0.0)])


class BarometerDrift(Effect):
    """The altitude of the barometer grows by `rate` metres per second from the first TDOA on.

    The filter estimates offset and drift of a barometer.
    """

    row = Row(
        name="barometer_drift",
        unit="m/s",
        bound=10.0,
        negligible=0.002,
        prior_std=0.02,
        example="rate",
        physics="the sensor warms up, the weather or the pressure in the hall changes",
        reference=(
            "BMP388 data sheet: 0.75 Pa/K, that is 6 cm per degree; 10 Pa, 0.8 m, a quarter of an "
            "hour of weather"
        ),
        remedy="Let the barometer warm up, and shield it from wind and light: it drifts {found}.",
        phrase="{way} by {size}",
        ways=("upwards", "downwards"),
        shown=("m a minute", 60.0),
    )
    portable = False
    usable = False
    channels = ("pressure",)

    def uncorrected(self, samples: SensorSamples) -> np.ndarray:
        return self.values.get("rate", 0.0) * (samples.t - samples.start)[:, None]

    def regressors(self, samples: SensorSamples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat((samples.t - samples.start)[:, None, None], len(keys), axis=2)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        stream = require(self, flight, "pressure")
        error = self.values.get("rate", 0.0) * (stream.t - float(flight.tdoa.t[0]))
        return flight.replaced(pressure=stream.sensed(stream.values + error[:, None]))


class IntervalEffect(DetectedEffect):
    """An effect of the size "N.<part>" from "N.start" to "N.end", s after the first TDOA.

    N counts from 1. A limit that is not given does not apply. It acts on one stream, its only
    channel. Nodes do not correct it: another flight has other intervals.
    """

    part: ClassVar[str]
    conditions = LIMITS
    other_units = dict.fromkeys(LIMITS, "s")
    usable = False

    def per_unit(self, samples: SensorSamples) -> np.ndarray:
        """Return the error of the readings per unit of its size, (n, k)."""
        raise NotImplementedError

    @classmethod
    def bound_of(cls, key: str) -> float:
        return UNLIMITED if key.endswith(LIMITS) else cls.row.bound

    @property
    def merge_key(self) -> tuple[Hashable, ...]:
        return (
            self.name,
            *sorted(item for item in self.values.items() if item[0].endswith(LIMITS)),
        )

    def regressors(self, samples: SensorSamples, keys: Sequence[str]) -> np.ndarray:
        since, unit = samples.t - samples.start, self.per_unit(samples)
        out = np.zeros((*unit.shape, len(keys)))
        for column, key in enumerate(keys):
            inside = is_within(self, key.partition(".")[0], since)
            out[inside, :, column] = unit[inside]
        return out

    def uncorrected(self, samples: SensorSamples) -> np.ndarray:
        keys = [key for key in self.values if not key.endswith(LIMITS)]
        return self.regressors(samples, keys) @ np.array([self.values[key] for key in keys])

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        (name,) = self.channels
        stream, truth = require(self, flight, name), require(self, flight, "truth")
        samples = sensor_samples(name, stream.t, Track(truth), float(flight.tdoa.t[0]))
        error = finite(self, flight, self.uncorrected(samples))
        return flight.replaced(**{name: stream.sensed(stream.values + error)})

    def advice(self) -> tuple[str, ...]:
        keys = [key for key in self.significant() if not key.endswith(LIMITS)]
        return tuple(
            self.row.remedy.format(found=self.size(key), way=self.way(key), when=self._when(key))
            for key in keys
        )

    def _when(self, key: str) -> str:
        when = interval_words(self, key.partition(".")[0])
        return f" {when}" if when else ""


class FloorStep(IntervalEffect):
    """The ground below the tag is "N.height" metres above z = 0 during an interval."""

    row = Row(
        name="floor_step",
        unit="m, s",
        bound=20.0,
        negligible=0.02,
        prior_std=0.3,
        example="1.height",
        physics="a step, a box, a table or a person below: the range finder measures down to that",
        reference="geometry",
        confounded_with=("height_offset",),
        distinguished_by={
            "height_offset": "a flight over other places: an offset is the same everywhere"
        },
        remedy="Look what lay below the tag{when}: the ground was {found} {way}.",
        ways=("higher", "lower"),
        shown=("m", 1.0),
    )
    part = "height"
    key_form = r"[0-9]+\.(height|start|end)", "a number and height, start or end, as 1.height"
    channels = ("height",)

    def per_unit(self, samples: SensorSamples) -> np.ndarray:
        return -1.0 / samples.up[:, None]


class VelocitySlip(IntervalEffect):
    """A share "N.share" of the velocity is lost during an interval."""

    row = Row(
        name="velocity_slip",
        unit="1, s",
        bound=10.0,
        negligible=0.05,
        prior_std=0.5,
        example="1.share",
        physics="wheels slip or spin, a camera loses its features and says that it stands still",
        reference=(
            "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: non-systematic "
            "errors of odometry"
        ),
        confounded_with=("velocity_scale",),
        distinguished_by={"velocity_scale": "a longer flight: slip ends, a scale stays"},
        remedy=(
            "Look for slip of the wheels or lost features{when}: the velocity was {found} too {way}."
        ),
        ways=("small", "large"),
        shown=("%", 100.0),
    )
    part = "share"
    key_form = r"[0-9]+\.(share|start|end)", "a number and share, start or end, as 1.share"
    channels = ("velocity",)

    def per_unit(self, samples: SensorSamples) -> np.ndarray:
        return -samples.reading


# The part of a row that all effects on stamps share
STAMP = Row(
    name="",
    unit="s",
    bound=1.0,
    negligible=0.002,
    prior_std=0.05,
    example="offset",
    physics="",
    reference="",
    ways=("late", "early"),
    shown=("ms", 1e3),
)


class StampEffect(Effect):
    """The stamps of one stream are `offset` seconds late; the stamps are corrected."""

    stream: ClassVar[str]  # field of a Flight

    def stamp_offset(self, stream: str) -> float:
        return self.values.get("offset", 0.0) if stream == self.stream else 0.0

    def regressors(self, samples: Samples | SensorSamples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat(-samples.time_derivative[..., None], len(keys), axis=-1)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        require(self, flight, self.stream)
        return shifted(flight, self.stream, self.stamp_offset(self.stream))


class TdoaTimeOffset(StampEffect):
    """TDOAs are stamped `offset` seconds after the instant of the measurement."""

    row = replace(
        STAMP,
        name="tdoa_time_offset",
        physics=(
            "the radio's stamps lag behind the IMU's: by buffers, or because they are taken on "
            "arrival at the host"
        ),
        reference="UTIL web page: about 10 ms of radio latency",
        confounded_with=("truth_time_offset",),
        distinguished_by={"truth_time_offset": "a flight with IMU: its stamps belong to neither"},
        remedy="Stamp TDOAs at the instant they are taken: their stamps are {found}.",
    )
    stream = "tdoa"
    corroborating_channels = ("gyro", "accel")  # else the ground truth may be late
    needs_reference = True


class RangeDelay(StampEffect):
    """Ranges are stamped `offset` seconds after the instant of the measurement."""

    row = replace(
        STAMP,
        name="range_delay",
        physics=(
            "a two-way exchange takes milliseconds, one anchor after the other, and the host "
            "stamps what it receives"
        ),
        reference="DW1000 user manual: a two-way exchange takes two or three messages and a report",
        confounded_with=("truth_time_offset",),
        distinguished_by={"truth_time_offset": "a flight with IMU: its stamps belong to neither"},
        remedy="Stamp ranges at the instant they are taken: their stamps are {found}.",
    )
    stream = "range"
    channels = ("range",)
    corroborating_channels = ("tdoa", "gyro", "accel")  # else the ground truth may be late
    needs_reference = True


class VelocityDelay(StampEffect):
    """Velocities are stamped `offset` seconds after the instant of the measurement."""

    row = replace(
        STAMP,
        name="velocity_delay",
        physics=(
            "images take time to be exposed, read and compared; odometry is stamped when it is "
            "computed"
        ),
        reference=(
            "Li and Mourikis, Int. J. Robotics Research 33, 2014: online temporal calibration of "
            "camera and IMU"
        ),
        confounded_with=("truth_time_offset",),
        distinguished_by={
            "truth_time_offset": "a late truth shows in the gyroscope and the TDOAs too"
        },
        remedy="Stamp the velocity when it is measured: it is stamped {found}.",
    )
    stream = "velocity"
    channels = ("velocity", "yaw_rate")


class TruthTimeOffset(StampEffect):
    """Poses of the ground truth are stamped `offset` seconds after their instant.

    Its correction changes the reference, not the estimate.
    """

    row = replace(
        STAMP,
        name="truth_time_offset",
        physics="motion-capture poses reach the log late, over a radio link",
        reference=(
            "UTIL web page: motion-capture poses logged on board have about 10 ms of radio latency"
        ),
        confounded_with=("tdoa_time_offset", "range_delay"),
        remedy=(
            "Correct the stamps of the ground truth, which are {found}: that changes what the "
            "estimate is compared with, not the estimate."
        ),
    )
    stream = "truth"
    needs_reference = True
    portable = False
    channels = ("tdoa", "gyro", *DIAGNOSED)  # vibration hides it on the accelerometer

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        return -super().regressors(samples, keys)  # at its stamp the tag is farther than the truth


def shifted(flight: Flight, stream: str, seconds: float) -> Flight:
    """Return the Flight with `seconds` added to the stamps of a stream, which may be missing."""
    part = getattr(flight, stream)
    if part is None or not seconds:
        return flight
    return replace(flight, **{stream: replace(part, t=part.t + seconds)})
