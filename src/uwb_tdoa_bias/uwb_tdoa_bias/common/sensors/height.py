# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A range finder that looks down along the body's -z."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .sensor import Compared, Sensor, Stream, parameter

# Fields of the messages: kind, typical angle in rad, and a range in m beyond any measurement.
INFRARED, FIELD_OF_VIEW, LONGEST_RANGE = (1, 0.47, 1000.0)


@dataclass(frozen=True)
class Height(Stream):
    """Ranges along the body's -z.

    Attributes
    ----------
    t : (n,) s
    range : (n,) m, inf or NaN where nothing was in range (REP 117)
    """

    t: np.ndarray
    range: np.ndarray

    @property
    def values(self) -> np.ndarray:
        return self.range[:, None]

    def with_values(self, values: np.ndarray) -> Height:
        return replace(self, range=values[:, 0])

    def sensed(self, values: np.ndarray) -> Height:
        return self.with_values(np.maximum(values, 0.0))


def _columns(fields: dict) -> tuple:
    distance = np.asarray(fields["range"], dtype=float)
    inside = (fields["min_range"] <= distance) & (distance <= fields["max_range"])
    return (
        np.where(np.isfinite(distance) & ~inside, np.inf, distance),
    )  # inf: out of range (REP 117)


def _content(height: Height) -> dict:
    return {
        "radiation_type": INFRARED,
        "field_of_view": FIELD_OF_VIEW,
        "max_range": LONGEST_RANGE,
        "range": height.range,
    }


def _simulated(config: Any, room: Any, motion: Any, turn: Any, noise: Any) -> tuple:
    true = (motion.p[:, 2] - room.lower[2]) / turn.apply([0.0, 0.0, 1.0])[:, 2]
    return (np.maximum(true + config.height_noise * noise(), 0.0),)


def _reading(track: Any, t: np.ndarray) -> np.ndarray:
    q = track.attitudes(t)
    return (track.positions(t)[:, 2] / (1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2)))[
        :, None
    ]  # height over the ground at z = 0


SENSOR = Sensor(
    name="height",
    plural="heights",
    stream=Height,
    message="sensor_msgs/msg/Range",
    fields={"range": 1, "min_range": 1, "max_range": 1},
    columns=_columns,
    content=_content,
    sound=lambda fields: {
        name: np.ones(values.shape, dtype=bool) for name, values in fields.items()
    },  # REP 117: inf and NaN mean that nothing was in range
    measured=lambda height: (
        {"value": height.range[:, None]},
        np.isfinite(height.range) & (height.range >= 0.0),
    ),
    simulated=_simulated,
    noise=("M", "write ranges to the floor, along the body's -z", 0.01),
    parameters={
        "use_height": parameter(
            True,
            "use ranges of a range finder that looks down along the body's -z, if there are any",
            fixed=True,
        ),
        "height_std": parameter(
            0.02,
            "m; of a range: unevenness of the ground and offset of the sensor, alike for 0.5 s",
            high=10.0,
        ),
        "height_arm": parameter(
            0.0,
            "m; from the range finder up to the origin of the body, along the body's z",
            high=10.0,
            low=-10.0,
        ),
        "ground_height": parameter(
            0.0, "m; height of the ground in the world, but for steps", high=10000.0, low=-10000.0
        ),
    },
    invalid="out of range, or less than 0 m",
    remedy="its unit, height_arm and ground_height",
    compared=Compared(
        _reading,
        "a range finder that looks down, and ground truth of height and attitude",
        negligible=0.005,
    ),
)
