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
    """Raise an InputError if the `values` of a Stream are not (n, k)."""
    shape = np.shape(stream.values)
    if len(shape) != 2 or shape[0] != len(stream):
        raise mistake(
            name,
            "stream",
            f"`values` has the shape {shape}, not (n, k) with n = {len(stream)}.",
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
    return rows, usable
