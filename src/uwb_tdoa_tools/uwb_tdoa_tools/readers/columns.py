"""CSV tables of other tools, with any column names and units.

columns = parse_columns("time=t_ms:ms,anchor_a=from,anchor_b=to,tdoa=diff_mm:mm")
flight = read_columns(["ranging.csv", "imu.csv"], columns, anchors)
"""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.limits import TABLE_CELLS

from .streams import GRAVITY, make_flight
from .tables import read_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.flight import Flight

    from .names import NamedAnchors
    from .streams import Streams
    from .tables import CsvTable

TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "ticks": 299792458.0 / (128 * 499.2e6),
    "ns": 0.299792458,
}
# As `make_flight` takes them, from a Crazyflie: deg/s and g.
RATE = {"rad/s": 180.0 / np.pi, "deg/s": 1.0}
FORCE = {"m/s^2": 1.0 / GRAVITY, "g": 1.0}
NUMBER = {"": 1.0}
# stream: {our column: (column of the stream, {unit: factor}, the first is the default)}
STREAMS = {
    "tdoa": {
        "anchor_a": ("a", NUMBER),
        "anchor_b": ("b", NUMBER),
        "tdoa": ("d", LENGTH),
        "tdoa_std": ("std", LENGTH),
    },
    "range": {"anchor": ("anchor", NUMBER), "range": ("d", LENGTH), "range_std": ("std", LENGTH)},
    "gyro": {f"gyro_{axis}": (axis, RATE) for axis in "xyz"},
    "acc": {f"accel_{axis}": (axis, FORCE) for axis in "xyz"},
    "pose": {f"pose_{axis}": (axis, LENGTH) for axis in "xyz"}
    | {f"pose_q{k}": (f"q{k}", NUMBER) for k in "xyzw"},
}
TIMES = {  # of each stream: the first that is given, else "time"
    "tdoa": ("tdoa_time",),
    "range": ("range_time",),
    "gyro": ("gyro_time", "imu_time"),
    "acc": ("accel_time", "imu_time"),
    "pose": ("pose_time",),
}
RADIO = "tdoa", "range"  # one of them is required
ANCHORS = "anchor_a", "anchor_b", "anchor"  # columns that name anchors
# cells of tools without a value
EMPTY = {"", "-", "--", "n/a", "na", "nan", "none", "null"}
MOST_SKIPPED = 0.25  # largest share of invalid records in a stream
ATTITUDE = {f"pose_q{k}" for k in "xyzw"}
OPTIONAL = {*ATTITUDE, "tdoa_std", "range_std"}
UNITS = {name: units for columns in STREAMS.values() for name, (_, units) in columns.items()}
UNITS |= {
    name: TIME for name in ("time", *sorted({name for names in TIMES.values() for name in names}))
}


def parse_columns(text: str) -> dict[str, tuple[str, float]]:
    """Return {our column: (their column, factor)} of "OURS=THEIRS[:UNIT],...".

    A value times its factor is in m, s, degrees/s or g, as `make_flight` takes them. Without UNIT it
    is in the first of UNITS. A name that holds a colon needs its unit. Raises InputError.
    """
    columns = {}
    for entry in text.split(","):
        ours, equals, theirs = (part.strip() for part in entry.partition("="))
        name, colon, unit = (part.strip() for part in theirs.rpartition(":"))
        if not colon:
            name, unit = theirs, ""
        if not equals or ours not in UNITS or not name or ours in columns:
            raise InputError(
                f"--columns: {entry!r} is not OURS=THEIRS, where OURS, once, is one of "
                f"{', '.join(UNITS)}."
            )
        units = UNITS[ours]
        if not colon:
            unit = next(iter(units))
        if unit not in units:
            usual = " or ".join(filter(None, units)) or "none"
            raise InputError(f"--columns: {entry!r}: {unit!r} is no unit of {ours}; use {usual}.")
        columns[ours] = name, units[unit]
    used = [stream for stream, names in STREAMS.items() if names.keys() & columns.keys()]
    # without a column of a radio, the error names those of TDOAs
    for stream in used if {*RADIO} & {*used} else ["tdoa", *used]:
        needed = [*(name for name in STREAMS[stream] if name not in OPTIONAL)]
        if missing := [name for name in needed if name not in columns]:
            raise InputError(
                f"--columns: {missing[0]} is missing; {', '.join(needed)} belong together."
            )
        if not {*TIMES[stream], "time"} & columns.keys():
            raise InputError(
                f"--columns: {TIMES[stream][-1]}, or time, is missing; name the column with "
                "the time."
            )
    if len(ATTITUDE & columns.keys()) not in (0, 4):
        raise InputError(f"--columns: {', '.join(sorted(ATTITUDE))} belong together.")
    return columns


def read_columns(
    paths: Sequence[str | Path],
    columns: dict[str, tuple[str, float]],
    named: NamedAnchors,
    salvage: bool = False,
) -> Flight:
    """Read a Flight from CSV files with header lines; each stream comes from a single file.

    A row counts for a stream if any cell of the stream is filled. So a file may mix rows of several
    sensors, each with a time column. Records with empty or invalid cells are skipped and counted in
    `meta["remarks"]`.

    Parameters
    ----------
    columns : see `parse_columns`.
    named : the anchors.
    salvage : skip invalid records even if they exceed MOST_SKIPPED.

    Raises InputError with the line of the first invalid record, if they exceed MOST_SKIPPED.
    """
    tables = {path: read_table(path, most=TABLE_CELLS, complete=False) for path in paths}
    wanted: dict[str | Path, dict[str, dict[str, tuple[str, float]]]] = {path: {} for path in paths}
    streams: Streams = {}
    remarks: list[str] = []
    for stream, known in STREAMS.items():
        mine = {name: columns[name] for name in known if name in columns}
        if mine:
            mine["t"] = next(columns[name] for name in (*TIMES[stream], "time") if name in columns)
            wanted[_having(tables, mine)][stream] = mine
    for path, of_file in wanted.items():
        for stream, values in _values(path, tables[path], of_file, named, remarks, salvage).items():
            streams[stream] = {
                "t" if name == "t" else STREAMS[stream][name][0]: column
                for name, column in values.items()
            }
    for ids in (streams.get("tdoa", {}), streams.get("range", {})):
        ids.update({name: ids[name].astype(np.int64) for name in ids.keys() & {"a", "b", "anchor"}})
    meta = {
        "source": ", ".join(map(str, paths)),
        "format": "CSV, columns as given",
        "remarks": remarks,
    }
    return make_flight(Path(paths[0]).stem, named.anchors, streams, {}, meta, salvage)


def _having(tables: dict[str | Path, CsvTable], mine: dict[str, tuple[str, float]]) -> str | Path:
    """Return the path of the single table that has all columns."""
    names = {theirs for theirs, _ in mine.values()}
    having = [path for path, table in tables.items() if names <= {*table.names}]
    if len(having) == 1:
        return having[0]
    if having:
        raise InputError(
            f"{having[1]}: has column {min(names)!r} as {having[0]} has; give one of them."
        )
    path, table = next(iter(tables.items()))
    raise InputError(
        f"{path}: has no column {min(names - {*table.names})!r}; its columns are "
        f"{', '.join(table.names)}."
    )


def _values(
    path: str | Path,
    table: CsvTable,
    streams: dict[str, dict[str, tuple[str, float]]],
    named: NamedAnchors,
    remarks: list[str],
    salvage: bool,
) -> dict[str, dict[str, np.ndarray]]:
    """Return {stream: {our name: (n,) array}} in our units.

    A row counts if one cell of the stream is filled and all cells are valid. `streams` maps the
    streams of this table to their columns.
    """
    values, rows = (
        {stream: {name: array("d") for name in mine} for stream, mine in streams.items()},
        0,
    )
    skipped = dict.fromkeys(streams, 0)
    first: dict[str, str] = {}
    for rows, (line, cells) in enumerate(table, start=1):
        for stream, mine in streams.items():
            texts = {name: cells[theirs].strip() for name, (theirs, _) in mine.items()}
            if all(text.lower() in EMPTY for name, text in texts.items() if name != "t"):
                continue
            record = {
                name: named.id_of(text) if name in ANCHORS else _number(text)
                for name, text in texts.items()
            }
            numbers = {name: value for name, value in record.items() if value is not None}
            if len(numbers) == len(record):
                for name, number in numbers.items():
                    values[stream][name].append(number)
            else:
                wrong = next(name for name in record if name not in numbers)
                skipped[stream] += 1
                what = (
                    "an anchor of the survey, by its name, or an id 0 ... 65535"
                    if wrong in ANCHORS
                    else "a finite number"
                )
                first.setdefault(
                    stream,
                    f"line {line}: {mine[wrong][0]} is {texts[wrong][:40]!r}; it must be {what}",
                )
    if streams and not rows:
        raise InputError(f"{path}: has no row below its header; record the flight again.")
    for stream, count in ((stream, count) for stream, count in skipped.items() if count):
        n, names = (
            count + len(values[stream]["t"]),
            ", ".join(name for name in streams[stream] if name != "t"),
        )
        if count > MOST_SKIPPED * n and not salvage:
            raise InputError(
                f"{path}: {first[stream]} ({count} of {n} records of {names} are like that: "
                "more than a gap)."
            )
        remarks.append(f"{path}: {count} of {n} records left out, {first[stream]}.")
    return {
        stream: {name: np.array(column) * streams[stream][name][1] for name, column in of.items()}
        for stream, of in values.items()
    }


def _number(text: str) -> float | None:
    """Return a finite number, with a point or a comma; None if it is not one."""
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return None
    return value if np.isfinite(value) else None
