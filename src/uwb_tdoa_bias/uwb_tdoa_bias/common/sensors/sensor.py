# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Description of a sensor other than IMU and TDOAs: all its properties outside of the filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np

from ..errors import InputError

PAGE = "docs/add_sensor.md"
# Fields of a SENSOR_ROW that `measured` may return, and the most numbers of each.
ROW_WIDTHS = {"value": 4, "std": 4, "anchor": 1}


def mistake(name: str, attribute: str, text: str) -> InputError:
    """Return the error of an attribute of a sensor; `text` is the mistake and its remedy."""
    return InputError(f"sensor {name}, `{attribute}`: {text} See {PAGE}.")


def stream_of(name: str, kind: Any, source: str, t: np.ndarray, columns: Any) -> Any:
    """Return the Stream of the columns that a function of a Sensor returned.

    Parameters
    ----------
    name : str
        Name of the sensor, for errors.
    kind : class
        Class of the Stream.
    source : str
        Name of the function, for errors.
    t : (n,) array
        Stamps, s.
    columns : tuple
        All arrays of the Stream but t.

    Raises
    ------
    InputError
        If number or lengths of the columns are wrong.
    """
    _, *arrays = fields(kind)
    names = ", ".join(each.name for each in arrays)
    least = sum(each.default is MISSING and each.default_factory is MISSING for each in arrays)
    if not isinstance(columns, tuple) or not least <= len(columns) <= len(arrays):
        got = f"{len(columns)} columns" if isinstance(columns, tuple) else "no tuple"
        raise mistake(
            name,
            source,
            f"it returns {got}. Return a tuple with the arrays of {kind.__name__} without t: "
            f"{names}.",
        )
    for array, column in zip(arrays, columns):
        if np.shape(column)[:1] != (len(t),):
            raise mistake(
                name,
                source,
                f"{array.name} has the shape {np.shape(column)}, not one entry for each of "
                f"{len(t)} stamps.",
            )
    return kind(t, *columns)


def check_values(name: str, stream: Any) -> None:
    """Raise an InputError if effects cannot change the `values` of a Stream.

    They must be (n, 1) or (n, 3), and `with_values` must return a Stream.
    """
    shape = np.shape(stream.values)
    if len(shape) != 2 or shape[0] != len(stream):
        raise mistake(
            name,
            "stream",
            f"`values` has the shape {shape}, not (n, k) with n = {len(stream)}.",
        )
    if shape[1] not in (1, 3):
        raise mistake(
            name,
            "stream",
            f"`values` has {shape[1]} columns. Effects change 1 value, or 3 along the body's axes: "
            "give a vector, or make a sensor of each value.",
        )
    changed = stream.with_values(stream.values)
    if not isinstance(changed, type(stream)):
        raise mistake(
            name,
            "stream",
            f"`with_values` returns {type(changed).__name__}. Return `replace(self, ...)`.",
        )


def written(name: str, wanted: dict, content: Any, n: int) -> dict:
    """Return {field: numbers} of the `fields` of a Sensor in n messages, as a reader gets them.

    Parameters
    ----------
    name : str
        Name of the sensor, for errors.
    wanted : dict
        {field: count of numbers} that are read.
    content : dict
        Returned by `content` of the Sensor. Fields without an entry are 0.
    n : int
        Number of messages.

    Raises
    ------
    InputError
        If `content` is no dict, or an entry has another shape.
    """
    if not isinstance(content, dict):
        raise mistake(
            name,
            "content",
            f"it returns {type(content).__name__}. Return {{field of the message: numbers}}.",
        )
    fields_read = {}
    for key, k in wanted.items():
        numbers, form = content.get(key, 0.0), (n, k) if k > 1 else (n,)
        try:
            fields_read[key] = np.broadcast_to(numbers, form)
        except ValueError as error:
            raise mistake(
                name, "content", f"{key} has the shape {np.shape(numbers)}, not {form}."
            ) from error
    return fields_read


def check_sound(name: str, numbers: dict, sound: Any) -> None:
    """Raise an InputError if `sound` of a Sensor refuses simulated numbers, or gave another form.

    Parameters
    ----------
    name : str
        Name of the sensor, for errors.
    numbers : dict
        {field: (n,) or (n, k) array} of simulated messages.
    sound : dict
        Returned by `sound` of the Sensor.
    """
    if not isinstance(sound, dict) or sound.keys() != numbers.keys():
        raise mistake(name, "sound", f"return {{field: bool}} for {', '.join(numbers)}.")
    for key, values in numbers.items():
        if np.shape(sound[key]) != values.shape:
            raise mistake(
                name,
                "sound",
                f"{key} has the shape {np.shape(sound[key])}, not {values.shape}, as its numbers.",
            )
        if not np.all(sound[key]):
            raise mistake(
                name, "simulated", f"`sound` refuses some numbers of {key}. Return finite ones."
            )


def check_read_back(name: str, content: dict, wanted: dict, stream: Any, back: Any) -> None:
    """Raise an InputError if the messages of a Stream are read as another Stream.

    Parameters
    ----------
    name : str
        Name of the sensor, for errors.
    content, wanted : dict
        Fields that are written, and `fields` of the Sensor.
    stream, back : Stream
        What was written, and what was read.
    """
    for array, one, other in zip(fields(stream), stream.columns, back.columns):
        if np.shape(one) != np.shape(other) or not np.allclose(one, other, equal_nan=True):
            raise mistake(
                name,
                "content",
                f"it writes {', '.join(content) or 'nothing'}. From {', '.join(wanted)}, `columns` "
                f"then reads another `{array.name}`. Check the names in `fields`, and write these "
                "fields in the unit that is read.",
            )


def check_rows(name: str, returned: Any, n: int) -> tuple[dict, np.ndarray]:
    """Return the rows and their validity that `measured` of a Sensor gave for n measurements.

    Raises InputError if the rows or their validity have another form.
    """
    if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[0], dict)):
        raise mistake(
            name, "measured", "return two things: {field: numbers}, and usable (n,) bool."
        )
    rows, usable = returned
    for key, numbers in rows.items():
        shape, most = np.shape(numbers), ROW_WIDTHS.get(key)
        if most is None:
            raise mistake(
                name,
                "measured",
                f"a SENSOR_ROW has no field {key!r}. Use {', '.join(ROW_WIDTHS)}.",
            )
        if (
            (shape != (n,))
            if most == 1
            else (shape[:1] != (n,) or len(shape) != 2 or shape[1] > most)
        ):
            form = "(n,)" if most == 1 else f"(n, k) with k <= {most}"
            raise mistake(
                name, "measured", f"{key} has the shape {shape}, not {form} with n = {n}."
            )
    if np.shape(usable) != (n,):
        raise mistake(
            name,
            "measured",
            f"usable has the shape {np.shape(usable)}, not (n,) with n = {n}.",
        )
    if np.asarray(usable).dtype != bool or "value" not in rows:
        raise mistake(name, "measured", "return {'value': numbers, ...}, and usable (n,) bool.")
    return rows, usable


# Variance in a message, in its unit squared; components at or above it were not measured. Messages
# need finite covariances.
UNKNOWN_VARIANCE = 1e6
UNKNOWN_STD = 1e6  # replaces an infinite deviation in computations
RATE = 25.0  # Hz, of simulated sensors
# Limit of all numbers of a recording, in their unit; results computed from them stay finite.
LARGEST_NUMBER = 1e30


@dataclass(frozen=True)
class Stream:
    """Measurements of one sensor: a frozen dataclass of arrays of one length.

    The first array is t (n,), s.
    """

    t: np.ndarray

    def __len__(self) -> int:
        return len(self.t)

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


@dataclass(frozen=True)
class Mistake:
    """A finding of a rule of `check`.

    Attributes
    ----------
    rule : its name
    cause : what is wrong
    evidence : the numbers that show it
    remedy : a line to copy
    value : the number that decided
    """

    rule: str
    cause: str
    evidence: str
    remedy: str
    value: float
    severe: bool = True  # False: a warning


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
        try:
            columns = self.columns(fields)
        except KeyError as error:
            raise mistake(
                self.name, "columns", f"{error} is none of `fields`: {', '.join(self.fields)}."
            ) from error
        return self.stream_of("columns", t, columns)

    def stream_of(self, source: str, t: np.ndarray, columns: tuple) -> Stream:
        """Return the Stream of columns that a function of this Sensor returned, `source`.

        Raises InputError if their number or lengths are wrong.
        """
        stream: Stream = stream_of(self.name, self.stream, source, t, columns)
        return stream

    def rows(self, stream: Stream) -> tuple[dict, np.ndarray]:
        """Return `measured` of a Stream; an InputError if its form is wrong."""
        return check_rows(self.name, self.measured(stream), len(stream))

    def check_simulated(self, stream: Stream) -> None:
        """Raise an InputError if a simulated Stream cannot be written, read and measured."""
        check_values(self.name, stream)
        content = self.content(stream)
        numbers = written(self.name, self.fields, content, len(stream))
        check_sound(self.name, numbers, self.sound(numbers))
        back = self.read(stream.t, numbers)
        check_read_back(self.name, content, self.fields, stream, back)
        rows, usable = self.rows(stream)
        if not np.isfinite(np.asarray(rows["value"])[usable]).all():
            raise mistake(
                self.name, "measured", "a usable `value` is not finite. Refuse it in usable."
            )
        if len(stream) and not usable.any():
            raise mistake(
                self.name,
                "measured",
                "it takes none of the simulated measurements. Compare units and limits of "
                "`measured` with `simulated`, and use less noise.",
            )


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
