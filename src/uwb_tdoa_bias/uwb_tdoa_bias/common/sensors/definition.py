# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Load the definitions of all sensors, and check them.

A mistake is an InputError with the sensor, the attribute, and the remedy.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import Field
from importlib import import_module
import re
from typing import Any

from ..errors import InputError
from .sensor import PAGE, Sensor, Stream, mistake

NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
MESSAGE = re.compile(r"\w+/msg/\w+")
# Other fields of a Flight; a test compares them.
TAKEN = "name", "anchors", "tdoa", "imu", "truth", "extra", "meta", "restarts"
# Topics that the nodes use for other data.
TAKEN_TOPICS = (
    "imu/data",
    "initialpose",
    "odometry",
    "status",
    "uwb/anchors",
    "uwb/residual",
    "uwb/tdoa",
    "uwb/tdoa_corrected",
)
FUNCTIONS = "columns", "content", "sound", "measured", "simulated"


def load(package: str, modules: Sequence[str]) -> dict[str, Sensor]:
    """Return {name: Sensor} of modules of a package, in their order, each checked."""
    sensors = [_sensor_of(package, module) for module in modules]
    _check_distinct("name", [(each, (each.name,)) for each in sensors])
    for sensor in sensors:
        check(sensor)
    _check_distinct("parameters", [(each, tuple(each.parameters)) for each in sensors])
    _check_distinct("topic", [(each, tuple(topic for topic, _ in each.topics)) for each in sensors])
    return {sensor.name: sensor for sensor in sensors}


def _sensor_of(package: str, module: str) -> Sensor:
    place = f"{package}.{module}"
    try:
        found = import_module(place)
    except ModuleNotFoundError as error:
        if error.name != place:  # another module is missing
            raise
        raise InputError(
            f"MODULES has {module!r}, but there is no file {module}.py in common/sensors. Check the "
            f"name, and the commas of MODULES. See {PAGE}."
        ) from error
    if not hasattr(found, "SENSOR"):
        raise InputError(f"{place} has no SENSOR. Assign its Sensor to this name. See {PAGE}.")
    sensor: Sensor = found.SENSOR
    return sensor


def _check_distinct(attribute: str, names: list[tuple[Sensor, tuple[str, ...]]]) -> None:
    """Raise an InputError if two sensors share a name of an attribute."""
    counts = Counter(name for _, every in names for name in every)
    for sensor, every in reversed(names):  # new sensors are last
        for name in every:
            if counts[name] > 1:
                raise mistake(
                    sensor.name, attribute, f"{name} exists already. Choose another name."
                )


def check(sensor: Sensor) -> None:
    """Raise an InputError for a definition that cannot work."""
    name = sensor.name
    if not (isinstance(name, str) and NAME.fullmatch(name)):
        raise mistake(name, "name", "use small letters, digits, and _ between two words.")
    if name in TAKEN:
        raise mistake(name, "name", f"a Flight has another field {name}. Choose another name.")
    for topic, message in sensor.topics:
        if topic in TAKEN_TOPICS:
            raise mistake(name, "topic", f"{topic} is in use. Choose another topic.")
        if not MESSAGE.fullmatch(message):
            raise mistake(name, "message", f"{message!r} has not the form package/msg/Type.")
    if not (
        isinstance(sensor.fields, dict)
        and sensor.fields
        and all(isinstance(k, int) and k > 0 for k in sensor.fields.values())
    ):
        raise mistake(name, "fields", "give {field of the message: count of its numbers}.")
    for attribute in FUNCTIONS:
        if not callable(getattr(sensor, attribute)):
            raise mistake(name, attribute, "this is no function.")
    if [*map(type, sensor.noise if isinstance(sensor.noise, tuple) else ())] != [str, str, float]:
        raise mistake(name, "noise", "give (unit, words, standard deviation), text, text, float.")
    if not (isinstance(sensor.rate, int | float) and sensor.rate > 0.0):
        raise mistake(name, "rate", f"{sensor.rate!r} is no rate. Give Hz, above 0.")
    _check_stream(sensor)
    _check_parameters(name, sensor.parameters)


def _check_stream(sensor: Sensor) -> None:
    """Raise an InputError for a Stream that lacks arrays or properties."""
    stream = sensor.stream
    if not (isinstance(stream, type) and issubclass(stream, Stream)):
        raise mistake(sensor.name, "stream", "give a class that inherits from Stream.")
    if "__dataclass_fields__" not in vars(stream):
        raise mistake(
            sensor.name, "stream", f"put @dataclass(frozen=True) before {stream.__name__}."
        )
    if next(iter(stream.__annotations__)) != "t":
        raise mistake(sensor.name, "stream", f"the first array of {stream.__name__} must be t.")
    for part in ("values", "with_values"):
        if getattr(stream, part) is getattr(Stream, part):
            raise mistake(sensor.name, "stream", f"{stream.__name__} has no `{part}`. Write it.")


def _check_parameters(name: str, parameters: dict[str, Any]) -> None:
    """Raise an InputError for parameters that FilterConfig cannot include."""
    if next(iter(parameters), None) != f"use_{name}":
        raise mistake(name, "parameters", f"the first parameter must be use_{name}.")
    for key, made in parameters.items():
        if not (isinstance(made, Field) and "text" in made.metadata):
            raise mistake(name, "parameters", f"make {key} with `parameter`.")
        if isinstance(made.default, bool | str):
            continue
        low, high = made.metadata["low"], made.metadata["high"]
        above = made.default >= low if made.metadata["with_low"] else made.default > low
        if not (above and (high is None or made.default <= high)):
            raise mistake(name, "parameters", f"the default of {key} is outside of its limits.")
