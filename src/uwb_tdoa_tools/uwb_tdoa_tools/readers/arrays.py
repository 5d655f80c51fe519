# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A Flight from arrays, lists or data frames, with units by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import Entry, name_of, refuse_faulty

from .names import NamedAnchors, named_anchors, read_named_anchors
from .profile import (
    ANCHORS,
    STREAMS,
    Columns,
    check_columns,
    parse_column,
    time_column,
)
from .streams import Streams, make_flight

VECTORS = {"gyro": "xyz", "accel": "xyz", "pose": "xyz", "pose_q": "xyzw"}  # a column for each axis


def flight_of_arrays(
    anchors: Anchors | str | Path | Mapping[Any, Any],
    tables: Mapping[str, Any],
    units: Mapping[str, str] | None = None,
    name: str = "flight",
) -> Flight:
    """Return the Flight of some tables, each with the columns of some sensors.

    Parameters
    ----------
    anchors : Anchors, path of a survey, or {id or name: (x, y, z) in m}
    tables : {title: {column: (n,) values}}
        A column has the name that `--columns` gives it (docs/csv.md). "gyro", "accel" and "pose" may
        be (n, 3), "pose_q" (n, 4).
    units : {column: unit}, or {title: {column: unit}}
        Default: the first unit in docs/csv.md.
    name : str

    Raises
    ------
    InputError
        If a column or a unit is unknown or missing, or values are no numbers or of other lengths.
    """
    named = _anchors_of(anchors)
    streams: Streams = {}
    for title, table in tables.items():
        values = _separate(title, table)
        columns = {column: _meaning(title, column, units or {}) for column in values}
        check_columns(title, columns, time=False)
        streams |= _streams(title, values, columns, named)
    return make_flight(name, named.anchors, streams, {}, {"source": name, "format": "arrays"})


def _anchors_of(anchors: Any) -> NamedAnchors:
    if isinstance(anchors, Anchors):
        return NamedAnchors(anchors)
    if isinstance(anchors, (str, Path)):
        return read_named_anchors(anchors)
    if not isinstance(anchors, Mapping):
        raise InputError(
            f"anchors: is {type(anchors).__name__}; give Anchors, the path of a survey, or "
            "{id: (x, y, z)} in m."
        )
    entries = []
    for key, place in anchors.items():
        position = _numbers("anchors", str(key), place)
        if position.shape != (3,):
            raise InputError(
                f"anchors: {key} has {position.size} coordinates; give x, y and z in m."
            )
        entries.append(Entry(name_of(key), position.tolist(), [np.nan] * 4, f"anchor {key}"))
    named = named_anchors("anchors", entries, "map")
    refuse_faulty(named.anchors, "anchors")
    return named


def _separate(title: str, table: Any) -> dict[str, Any]:
    """Return {column: (n,) values} of a table; a vector becomes a column for each axis."""
    names = getattr(getattr(table, "dtype", None), "names", None) or getattr(table, "keys", list)()
    out: dict[str, Any] = {}
    for name in map(str, names):
        values = table[name]
        axes = VECTORS.get(name)
        if axes is None:
            out[name] = np.asarray(values)
            continue
        rows = _numbers(title, name, values)
        if rows.ndim != 2 or rows.shape[1] != len(axes):
            raise InputError(
                f"{title}: {name} has the shape {rows.shape}; give (n, {len(axes)}): {axes}."
            )
        joint = name if name.endswith("q") else f"{name}_"
        out.update({f"{joint}{axis}": rows[:, k] for k, axis in enumerate(axes)})
    lengths = {name: len(np.atleast_1d(values)) for name, values in out.items()}
    if not lengths:
        raise InputError(f"{title}: has no columns; give {{column: values}} (docs/python.md).")
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in lengths.items())
        raise InputError(f"{title}: the columns have different lengths ({listed}).")
    return out


def _meaning(title: str, column: str, units: Mapping[str, Any]) -> tuple[str, float]:
    """Return (column, factor) of a column by its unit, or by that of its vector."""
    own = units.get(title)
    known = own if isinstance(own, Mapping) else units
    vector = column.removesuffix(column[-1:]).removesuffix("_")
    unit = known.get(column, known.get(vector))
    return parse_column(title, column, column if unit is None else f"{column}:{unit}")


def _streams(
    title: str, values: Mapping[str, Any], columns: Columns, named: NamedAnchors
) -> Streams:
    """Return the streams of a table, as `make_flight` takes them."""
    out: Streams = {}
    for stream, known in STREAMS.items():
        mine = {theirs: ours for ours, (theirs, _) in known.items() if ours in columns}
        if not mine:
            continue
        time = time_column(stream, columns)
        if time is None:
            raise InputError(f"{title}: has no column time; give the stamps of its rows.")
        out[stream] = {"t": _numbers(title, time[0], values[time[0]]) * time[1]}
        for theirs, ours in mine.items():
            if ours in ANCHORS:
                out[stream][theirs] = _ids(title, ours, values[ours], named)
            else:
                out[stream][theirs] = _numbers(title, ours, values[ours]) * columns[ours][1]
    return out


def _numbers(title: str, name: str, values: Any) -> np.ndarray:
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{title}: {name} holds values that are no numbers ({error}).") from error


def _ids(title: str, name: str, values: Any, named: NamedAnchors) -> np.ndarray:
    """Return the ids (n,) of anchors by id or name."""
    texts, rows = np.unique([name_of(value) for value in np.asarray(values)], return_inverse=True)
    ids = [named.id_of(str(text)) for text in texts]
    if None in ids:
        unknown = str(texts[ids.index(None)])
        raise InputError(f"{title}: {name} holds {unknown!r}, which is no anchor; check the ids.")
    return np.array(ids, dtype=np.int64)[rows]
