# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check the values that the functions of a Sensor return.

A mistake is an InputError with the sensor, the function, and the remedy.
"""

from __future__ import annotations

from dataclasses import MISSING, fields
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
    for field, k in wanted.items():
        numbers, form = content.get(field, 0.0), (n, k) if k > 1 else (n,)
        try:
            fields_read[field] = np.broadcast_to(numbers, form)
        except ValueError as error:
            raise mistake(
                name, "content", f"{field} has the shape {np.shape(numbers)}, not {form}."
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
    for field, values in numbers.items():
        if np.shape(sound[field]) != values.shape:
            raise mistake(
                name,
                "sound",
                f"{field} has the shape {np.shape(sound[field])}, not {values.shape}, as its numbers.",
            )
        if not np.all(sound[field]):
            raise mistake(
                name, "simulated", f"`sound` refuses some numbers of {field}. Return finite ones."
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
    for field, numbers in rows.items():
        shape, most = np.shape(numbers), ROW_WIDTHS.get(field)
        if most is None:
            raise mistake(
                name,
                "measured",
                f"a SENSOR_ROW has no field {field!r}. Use {', '.join(ROW_WIDTHS)}.",
            )
        if (
            (shape != (n,))
            if most == 1
            else (shape[:1] != (n,) or len(shape) != 2 or shape[1] > most)
        ):
            form = "(n,)" if most == 1 else f"(n, k) with k <= {most}"
            raise mistake(
                name, "measured", f"{field} has the shape {shape}, not {form} with n = {n}."
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
