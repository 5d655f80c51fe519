# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The registry of all sensors except IMU and TDOAs.

A new sensor is a file in this folder, its name in MODULES, and a file of the filter, see
docs/add_sensor.md.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

from .height import Height
from .pressure import Pressure
from .ranges import Ranges
from .sensor import Sensor, Stream
from .velocity import Velocity

# One file each, in the filter's order of kinds: append new ones.
MODULES = "height", "pressure", "velocity", "ranges"

LISTED = [import_module(f"{__name__}.{module}").SENSOR for module in MODULES]
SENSORS: dict[Any, Any] = {sensor.name: sensor for sensor in LISTED}  # in the order of MODULES

LOCATING = tuple(
    name for name, sensor in SENSORS.items() if sensor.locates
)  # each alone suffices to start the filter
COMPARED = {
    channel: compared
    for name, sensor in SENSORS.items()
    for channel, compared in {name: sensor.compared, **sensor.parts}.items()
    if compared is not None
}  # {channel of the diagnosis: Compared} of sensors and their parts
STREAM_OF = {
    channel: name for name, sensor in SENSORS.items() for channel in (name, *sensor.parts)
}  # {channel of the diagnosis: stream of a Flight}
DIAGNOSED = tuple(COMPARED)  # channels of the diagnosis
BY_POSE = tuple(
    channel for channel, compared in COMPARED.items() if compared.reading
)  # channels compared with poses alone, without anchors


def in_words() -> str:
    """Return "topic (type)" of all topics of SENSORS, for the help of a node."""
    topics = [topic for sensor in SENSORS.values() for topic in sensor.topics]
    return ",\n".join(f"{topic} ({kind.replace('/msg', '')})" for topic, kind in topics)


def measured_on(flight: Any, channel: str) -> Stream | None:
    """Return the Stream of a channel of the diagnosis in a Flight; None without data."""
    name = STREAM_OF[channel]
    stream: Stream | None = getattr(flight, name)
    return stream if stream is None or channel == name else stream.parts.get(channel)


def with_measured(flight: Any, channel: str, part: Stream) -> Any:
    """Return the Flight with another Stream of a channel of the diagnosis."""
    name = STREAM_OF[channel]
    whole = part if channel == name else getattr(flight, name).with_part(channel, part)
    return replace(flight, **{name: whole})


__all__ = [
    "BY_POSE",
    "COMPARED",
    "DIAGNOSED",
    "LISTED",
    "LOCATING",
    "SENSORS",
    "STREAM_OF",
    "Height",
    "Pressure",
    "Ranges",
    "Sensor",
    "Stream",
    "Velocity",
    "in_words",
    "measured_on",
    "with_measured",
]
