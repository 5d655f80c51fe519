# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A Flight from arrays, lists or data frames, with units by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import Entry, NamedAnchors, as_named, name_of, named_anchors

from .by_profile import streams_of
from .profile import Profile, Source, check_columns, parse_column
from .streams import make_flight
from .tables import Block, Foreign, Wanted

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
    named, read, sources = _anchors_of(anchors), {}, []
    for title, table in tables.items():
        read[title] = _separate(title, table)
        columns = {column: _meaning(title, column, units or {}) for column in read[title]}
        check_columns(title, columns, time=False)
        sources.append(Source(columns, topic=title))
    profile = Profile("arrays", tuple(sources))
    _, streams, meta = streams_of(_Arrays(read), name, profile, named)
    meta |= {"source": name, "read": [], "unread": []}
    return make_flight(name, named.anchors, streams, {}, meta)


class _Arrays(Foreign):
    """Tables of arrays: {title: "arrays"}."""

    place = "row"

    def __init__(self, columns: dict[str, dict[str, np.ndarray]]) -> None:
        super().__init__()
        self._columns, self.types = columns, dict.fromkeys(columns, "arrays")

    def fields(self, table: str) -> list[str]:
        """Return the columns of a table."""
        return [*self._columns[table]]

    def blocks(self, wanted: Sequence[Wanted]) -> Iterator[Block]:
        """Yield the rows of tables."""
        for number, (table, _, paths) in enumerate(wanted):
            columns = {path: self._columns[table][path].tolist() for path in paths}
            yield Block(number, [*range(1, 1 + len(columns[paths[0]]))], columns)


def _anchors_of(anchors: Any) -> NamedAnchors:
    if isinstance(anchors, (Anchors, str, Path)):
        named = as_named(anchors)
        assert named is not None
        return named
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
        entries.append(Entry(name_of(key), position.tolist()))
    return named_anchors("anchors", entries)


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


def _numbers(title: str, name: str, values: Any) -> np.ndarray:
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{title}: {name} holds values that are no numbers ({error}).") from error
