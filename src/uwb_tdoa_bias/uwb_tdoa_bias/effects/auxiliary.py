# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of auxiliary sensors (height, pressure, velocity), and the corrector of their streams."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from dataclasses import replace
import math
from typing import Any, ClassVar

import numpy as np

from ..common.flight import SENSOR_NAMES, Flight
from ..common.sensors import STREAM_OF, with_measured
from ..common.sensors.sensor import UNKNOWN_STD, UNKNOWN_VARIANCE, Stream
from .base import (
    IDENTITY,
    UNLIMITED,
    Affine,
    Effect,
    Row,
    SensorEffect,
    finite,
    interval_words,
    is_within,
    require,
    undoing,
)
from .samples import SensorSamples, Track, sensor_samples

LIMITS = ("start", "end")  # s after the first TDOA


class AuxiliaryEffect(SensorEffect):
    """An effect with an affine sensor model on one channel, its only one."""

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        (channel,) = self.channels
        part = require(self, flight, channel)
        changed: Flight = with_measured(flight, channel, part.sensed(self.model()(part.values)))
        return changed


class ScaleEffect(AuxiliaryEffect):
    """Measured = (1 + `scale`) true."""

    dimensions: ClassVar[int] = 1  # numbers of a measurement

    def model(self) -> Affine:
        scale = 1.0 + self.values.get("scale", 0.0)
        return Affine(scale * np.eye(self.dimensions), np.zeros(self.dimensions))


class HeightOffset(AuxiliaryEffect):
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

    def model(self) -> Affine:
        return Affine(np.eye(1), np.array([self.values.get("offset", 0.0)]))


class HeightScale(ScaleEffect):
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


class VelocityScale(ScaleEffect):
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
    dimensions = 3


class YawRateScale(ScaleEffect):
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


class VelocityMisalignment(AuxiliaryEffect):
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

    def model(self) -> Affine:
        yaw = self.values.get("yaw", 0.0)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return Affine(np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


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


class IntervalEffect(Effect):
    """An effect of the size "N.<part>" from "N.start" to "N.end", s after the first TDOA.

    N counts from 1. A limit that is not given does not apply. It acts on one stream, its only
    channel. Nodes do not correct it: another flight has other intervals.
    """

    part: ClassVar[str]
    conditions = LIMITS
    other_units = dict.fromkeys(LIMITS, "s")
    parameters = ()
    portable = False
    fitted = False
    usable = False

    def per_unit(self, samples: SensorSamples) -> np.ndarray:
        """Return the error of the readings per unit of its size, (n, k)."""
        raise NotImplementedError

    @classmethod
    def bound_of(cls, key: str) -> float:
        return UNLIMITED if key.endswith(LIMITS) else cls.bound

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
            self.remedy.format(found=self.size(key), way=self.way(key), when=self._when(key))
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


class SensorCorrector:
    """Corrector of the streams of auxiliary sensors, whole or one measurement after the other."""

    def __init__(self, effects: Collection[Effect]) -> None:
        """Select the effects on these streams among `effects`; they are undone in their order."""
        self._late = {
            stream: sum(effect.stamp_offset(stream) for effect in effects)
            for stream in SENSOR_NAMES
        }
        self._undo = {channel: undoing(effects, channel) for channel in STREAM_OF}
        undone = any(undo is not IDENTITY for undo in self._undo.values())
        self.idle = not undone and not any(self._late.values())

    def correct(self, name: str, stream: Stream) -> Stream:
        """Return the corrected Stream of the sensor `name`."""
        if self._late[name]:
            stream = replace(stream, t=stream.t - self._late[name])
        for channel, part in stream.parts.items():
            stream = stream.with_part(channel, self._undone(channel, part))
        return self._undone(name, stream)

    def _undone(self, channel: str, stream: Stream) -> Stream:
        undo = self._undo[channel]
        if undo is IDENTITY:
            return stream
        std = getattr(stream, "std", None)
        if std is None:
            return stream.with_values(undo(stream.values))
        known = np.isfinite(std)  # an axis that was not measured may hold any value
        variance = np.where(known, std, UNKNOWN_STD) ** 2 @ undo.matrix.T**2
        std = np.where(variance < UNKNOWN_VARIANCE, np.sqrt(variance), np.inf)
        values = undo(np.where(known, stream.values, 0.0))
        corrected: Any = stream.with_values(values)  # has a std, as `stream` has
        return replace(corrected, std=std)
