# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Description of a sensor other than IMU and TDOAs: all its properties outside of the filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ..arrays import Stamped
from ..errors import InputError

PAGE = "docs/add_sensor.md"


def mistake(name: str, attribute: str, text: str) -> InputError:
    """Return the error of an attribute of a sensor; `text` is the mistake and its remedy."""
    return InputError(f"sensor {name}, `{attribute}`: {text} See {PAGE}.")


# Variance in a message, in its unit squared; components at or above it were not measured. Messages
# need finite covariances.
UNKNOWN_VARIANCE = 1e6
UNKNOWN_STD = 1e6  # replaces an infinite deviation in computations
RATE = 25.0  # Hz, of simulated sensors
# Limit of all numbers of a recording, in their unit; results computed from them stay finite.
LARGEST_NUMBER = 1e30


@dataclass(frozen=True)
class Stream(Stamped):
    """Measurements of one sensor: a frozen dataclass of arrays of one length.

    The first array is t (n,), s.
    """

    t: np.ndarray

    @property
    def columns(self) -> list:
        """All arrays, stamps first."""
        return [getattr(self, each.name) for each in fields(self)]

    @property
    def values(self) -> np.ndarray:
        """Measured values as effects see them, (n, k)."""
        raise NotImplementedError

    def with_values(self, values: np.ndarray) -> Stream:
        """Return the Stream with other values (n, k)."""
        raise NotImplementedError

    def sensed(self, values: np.ndarray) -> Stream:
        """Return the Stream with other values (n, k), limited to the range of the sensor."""
        return self.with_values(values)

    @property
    def parts(self) -> dict[str, Stream]:
        """{channel of the diagnosis: Stream} of further quantities in the same messages."""
        return {}

    def with_part(self, channel: str, part: Stream) -> Stream:
        """Return the Stream with another one of its `parts`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Compared:
    """How the diagnosis compares a sensor with poses.

    `diagnosis/channels/sensor.py` and `radio.py` of uwb_tdoa_tools use it.

    Attributes
    ----------
    reading : callable of (Track, t (n,)) -> (n, k), the reading expected at the poses; None for
        distances to anchors
    needs : the data that a flight must have, in words
    negligible : a smaller constant error is ignored, unit of the stream
    floating : whether a constant error carries no information
    of_attitude : whether the attitude must be known
    axes : suffixes of its name in labels
    positions : coordinates that the reference must contain
    """

    reading: Callable | None
    needs: str
    negligible: float
    unit: str = "m"
    floating: bool = False
    of_attitude: bool = True
    axes: tuple = ("",)
    positions: tuple = (2,)


# Of a Finding of `check`: rule, severity ("error" or "warning"), cause, evidence (the numbers that show
# it), remedy (a line to copy), and the number that decided.
Mistake = tuple[str, str, str, str, str, float]


@dataclass(frozen=True)
class Sensor:
    """A kind of measurement.

    `name` names its stream in a Flight, its counters on /diagnostics, its parameter use_<name>, and
    its value of `--without`. core/ of uwb_tdoa_ekf has its update of the filter.

    Attributes
    ----------
    plural : words for several measurements
    stream : class of its Stream
    message, fields : type of its messages, and {field: count of numbers} of the fields that are
        read: numbers, arrays of a fixed length, or messages of numbers (Vector3, Quaternion), with a
        dot before a field of a field
    columns : callable of {field: (n,) or (n, k)} -> columns of the Stream, without stamps
    content : callable of a Stream -> {field: value, (n,) or (n, k)} of its messages; missing fields
        are 0
    sound : callable of {field: (n,) or (n, k)} -> the same of bool: the numbers that a recording may
        hold
    measured : callable of a Stream -> ({field of a SENSOR_ROW: (n,) or (n, k)}, usable (n,) bool); SENSOR_ROW:
        core/memory.py of uwb_tdoa_ekf
    simulated : callable of (SimulationConfig, Room, motion, turn, noise) -> columns, without stamps:
        true values and white noise. The motion is of the body, turn holds its Rotations, and
        noise(...) gives standard normal numbers (n, ...).
    noise : (unit, words, size) of the standard deviation of that noise: unit and words for the
        options of `simulate`, and its size on the vehicle of `fly`
    parameters : {name: `parameter`} of the filter; use_<name> is the first
    invalid : the content that messages need
    remedy : what to check if the measurements contradict all other data
    compared : Compared; None: the sensor is not diagnosed
    parts : {channel of the diagnosis: Compared} of the `parts` of its Stream
    topic : "" for its name
    rate : Hz, of the simulation
    locates : whether the filter can start from it alone
    rules : of `check`: callables of (Stream, Anchors) -> Mistake or None
    others : ((topic, message), ...) of other topics with the same fields
    assumed : callable of a Stream -> names of the parameters used for messages that state no standard
        deviation; None: all messages state one
    in_body : callable of ({field: (n,) or (n, k)}, Rotation, arm (3,) m) -> the same in the body, of a
        sensor that is turned and off center; None: its frame does not matter
    """

    name: str
    plural: str
    stream: type
    message: str
    fields: dict
    columns: Callable
    content: Callable
    sound: Callable
    measured: Callable
    simulated: Callable
    noise: tuple
    parameters: dict
    invalid: str
    remedy: str
    compared: Compared | None = None
    parts: dict[str, Compared] = field(default_factory=dict)
    topic: str = ""
    rate: float = RATE
    locates: bool = False
    rules: tuple = ()
    others: tuple = ()
    assumed: Callable | None = None
    in_body: Callable | None = None

    @property
    def topics(self) -> tuple:
        """((topic, type of its messages), ...), its own first."""
        return ((self.topic or self.name, self.message), *self.others)

    def split(self, rows: np.ndarray) -> dict:
        """Return {field: (n,) or (n, k)} of an array (n, m) with all fields side by side."""
        ends, parts = np.cumsum(list(self.fields.values())), {}
        for (name, width), end in zip(self.fields.items(), ends):
            parts[name] = rows[:, end - width : end] if width > 1 else rows[:, end - 1]
        return parts

    def read(self, t: np.ndarray, fields: dict) -> Stream:
        """Return the Stream of messages; t : (n,) stamps, s; fields : {field: (n,) or (n, k)}."""
        stream: Stream = self.stream(t, *self.columns(fields))
        return stream

    def rows(self, stream: Stream) -> tuple[dict, np.ndarray]:
        """Return `measured` of a Stream."""
        rows, usable = self.measured(stream)
        return rows, usable


def parameter(
    default: float | str,
    text: str,
    high: float | None = None,
    low: float = 0.0,
    with_low: bool = False,
    fixed: bool = False,
) -> Any:
    """Return a field of FilterConfig.

    Parameters
    ----------
    text : unit and meaning, as in ekf_node.yaml
    low, high : a number must be above `low` and at most `high`
    with_low : whether `low` itself is permitted
    fixed : whether it is constant while the filter runs
    """
    limits = {"low": low, "high": high, "with_low": with_low}
    return field(default=default, metadata={"text": text, "fixed": fixed, **limits})


def finite(fields: dict) -> dict:
    """Return {field: bool}: which numbers are finite, at most LARGEST_NUMBER."""
    return {
        name: np.abs(values) <= LARGEST_NUMBER for name, values in fields.items()
    }  # False for NaN
