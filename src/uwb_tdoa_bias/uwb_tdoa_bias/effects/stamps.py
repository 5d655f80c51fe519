# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of late stamps: stream by stream, stamp = instant of the measurement + `offset`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from ..common.flight import Flight
from ..common.sensors import DIAGNOSED
from .base import Effect, Row, require
from .samples import Samples, SensorSamples

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
