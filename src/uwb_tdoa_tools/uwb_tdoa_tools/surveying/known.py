# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measurements besides flights: marks, distances between anchors, paths of another odometry."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.limits import TABLE_CELLS
from uwb_tdoa_bias.common.safe_yaml import read_yaml

from ..bags.bag import read_odometry
from ..choices import DRIFT
from ..diagnosis.constraints import Distance, Mark, OdometryPath
from ..readers.tables import number, read_rows

MARK_KEYS = ("flight", "from", "to", "position", "std")
MARK_EXAMPLE = "{flight: monday, from: 12.0, to: 14.0, position: [1.0, -2.0, 0.5], std: 0.05}"
DISTANCE_COLUMNS = "a", "b", "distance", "std"
COORDINATE_COLUMNS = "anchor", "axis", "value", "std"
AXES = ("x", "y", "z")
PATH_COLUMNS = "t", "x", "y", "z"


def read_marks(path: str | Path, flights: Sequence[Flight]) -> list[Mark]:
    """Read [Mark] of Flights from a YAML file as in MARK_EXAMPLE.

    `from` and `to` are s since the first TDOA of the flight, or its first range without TDOAs.
    `position` is the mean position of the tag between them, m. Raises InputError.
    """
    content = read_yaml(path)
    entries = content.get("marks") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: expected a list 'marks', each as {MARK_EXAMPLE}.")
    lengths = {flight.name: flight.end - flight.start for flight in flights}
    return [
        _mark(f"{path}: mark {number}", entry, lengths)
        for number, entry in enumerate(entries, start=1)
    ]


def _mark(where: str, entry: Any, lengths: Mapping[str, float]) -> Mark:
    if not isinstance(entry, dict) or set(entry) != set(MARK_KEYS):
        raise InputError(f"{where}: must be as {MARK_EXAMPLE}.")
    flight, first, last, position, std = (entry[key] for key in MARK_KEYS)
    if not isinstance(flight, str) or flight not in lengths:
        raise InputError(f"{where}: there is no flight {flight!r}; given are {', '.join(lengths)}.")
    try:
        first, last, std = float(first), float(last), float(std)
        position = tuple(map(float, position))
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}; write it as {MARK_EXAMPLE}.") from error
    if not 0.0 <= first < last <= lengths[flight]:
        raise InputError(
            f"{where}: from {first:g} to {last:g} s must lie, one after the other, in the "
            f"{lengths[flight]:.1f} s of {flight}."
        )
    if (
        len(position) != 3
        or not all(abs(value) < 1e6 for value in position)
        or not 0.0 < std < 10.0
    ):
        raise InputError(
            f"{where}: position {list(position)} +- {std:g} must be three coordinates and a "
            "std above 0, in m."
        )
    return Mark(flight, first, last, position, std)


def read_distances(path: str | Path, anchors: Anchors | None = None) -> list[Distance]:
    """Read [Distance] between Anchors from a CSV file with the columns DISTANCE_COLUMNS: ids, m, m.

    anchors : None allows any ids. Raises InputError.
    """
    out, known = [], "" if anchors is None else ", ".join(str(i) for i in anchors.ids)
    for line, row in read_rows(path, DISTANCE_COLUMNS):
        a, b, distance, std = (number(path, line, row, name) for name in DISTANCE_COLUMNS)
        if anchors is None:
            _check_id(path, line, a)
            _check_id(path, line, b)
        if a == b or (anchors is not None and (anchors.index(np.array([a, b])) < 0).any()):
            raise InputError(
                f"{path}: line {line}: {a:g} and {b:g} must be two of the anchors {known}."
                if known
                else f"{path}: line {line}: {a:g} and {b:g} must be two anchors."
            )
        if not (0.0 < distance < 1e4 and 0.0 < std < 10.0):
            raise InputError(
                f"{path}: line {line}: {distance:g} +- {std:g} m is no distance; both must be "
                "above 0, in m."
            )
        out.append(Distance(int(a), int(b), distance, std))
    if not out:
        raise InputError(
            f"{path}: holds no distance; write one in each line below {','.join(DISTANCE_COLUMNS)}."
        )
    return out


def read_coordinates(path: str | Path) -> list[tuple[int, int, float, float]]:
    """Read coordinates of anchors from a CSV file with the columns COORDINATE_COLUMNS.

    Returns (id, axis 0 to 2, value m, std m) of each line; in the file axes are x, y, z. Raises InputError.
    """
    out = []
    for line, row in read_rows(path, COORDINATE_COLUMNS):
        anchor, value, std = (number(path, line, row, n) for n in ("anchor", "value", "std"))
        _check_id(path, line, anchor)
        axis = row["axis"].strip().lower()
        if axis not in AXES or not abs(value) < 1e6 or not 0.0 < std <= 10.0:
            raise InputError(
                f"{path}: line {line}: {axis} = {value:g} +- {std:g} m is no coordinate; write x, y or "
                "z, and a std above 0, at most 10 m."
            )
        out.append((int(anchor), AXES.index(axis), value, std))
    return out


def _check_id(path: str | Path, line: int, value: float) -> None:
    if not (0.0 <= value <= 65535.0 and value == int(value)):
        raise InputError(f"{path}: line {line}: {value:g} is no id; ids are whole, 0 ... 65535.")


def read_paths(
    source: str, flights: Sequence[Flight], drift: float = DRIFT, namespace: str = ""
) -> list[OdometryPath]:
    """Read the OdometryPath of each Flight that the source contains.

    Parameters
    ----------
    source : CSV file, or the name of a nav_msgs/Odometry topic in the bags. The columns of the file
        are flight, t (s, clock of the recording), x, y, z (m).
    drift : m per square root of a second.

    Raises InputError.
    """
    if not 0.0 <= drift <= 10.0:
        raise InputError(f"--drift: {drift:g} must be from 0 to 10 m per square root of a second.")
    if Path(source).is_file():
        return _of_table(source, flights, drift)
    out = []
    for flight in flights:
        if "bag" not in flight.meta:
            raise InputError(
                f"--odometry {source}: is no CSV file, and {flight.name} is no bag that could "
                "have such a topic."
            )
        found = read_odometry(flight.meta["bag"], namespace, topics={"odometry": source})
        valid = np.isfinite(found.p).all(axis=1)
        out.append(OdometryPath(flight.name, found.t[valid], found.p[valid], drift))
    return out


def _of_table(path: str, flights: Sequence[Flight], drift: float) -> list[OdometryPath]:
    rows = {flight.name: array("d") for flight in flights}
    for line, row in read_rows(path, ("flight", *PATH_COLUMNS), TABLE_CELLS):
        if row["flight"] in rows:
            rows[row["flight"]].extend(number(path, line, row, name) for name in PATH_COLUMNS)
    out = []
    for name, some in rows.items():
        if not some:
            raise InputError(
                f"{path}: holds no row of flight {name}; its first column names the flight."
            )
        table = np.array(some).reshape(-1, len(PATH_COLUMNS))
        if (np.diff(table[:, 0]) <= 0.0).any():
            raise InputError(
                f"{path}: the stamps of flight {name} do not rise; sort its rows by t."
            )
        out.append(OdometryPath(name, table[:, 0], table[:, 1:], drift))
    return out
