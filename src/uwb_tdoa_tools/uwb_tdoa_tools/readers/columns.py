"""CSV tables of other tools, whatever their columns are called and whatever they are measured in.

    columns = parse_columns("time=t_ms:ms,anchor_a=from,anchor_b=to,tdoa=diff_mm:mm")
    flight = read_columns(["ranging.csv", "imu.csv"], columns, anchors)
"""

from array import array
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.limits import TABLE_CELLS

from .streams import GRAVITY, make_flight
from .tables import read_table

TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ticks": 299792458.0 / (128 * 499.2e6), "ns": 0.299792458}
# As `make_flight` takes them, from a Crazyflie: deg/s and g.
RATE = {"rad/s": 180.0 / np.pi, "deg/s": 1.0}
FORCE = {"m/s^2": 1.0 / GRAVITY, "g": 1.0}
NUMBER = {"": 1.0}
STREAMS = {  # stream: {our column: (column of the stream, {unit: factor}, the first is the default)}
    "tdoa": {"anchor_a": ("a", NUMBER), "anchor_b": ("b", NUMBER), "tdoa": ("d", LENGTH), "tdoa_std": ("std", LENGTH)},
    "gyro": {f"gyro_{axis}": (axis, RATE) for axis in "xyz"},
    "acc": {f"accel_{axis}": (axis, FORCE) for axis in "xyz"},
    "pose": {f"pose_{axis}": (axis, LENGTH) for axis in "xyz"} | {f"pose_q{k}": (f"q{k}", NUMBER) for k in "xyzw"},
}
TIMES = {"tdoa": "tdoa_time", "gyro": "imu_time", "acc": "imu_time", "pose": "pose_time"}  # else "time"
ATTITUDE = {f"pose_q{k}" for k in "xyzw"}
OPTIONAL = {*ATTITUDE, "tdoa_std"}
UNITS = {name: units for columns in STREAMS.values() for name, (_, units) in columns.items()}
UNITS |= {name: TIME for name in ("time", *TIMES.values())}
HELP = (
    "for CSV files of other tools: their columns, OURS=THEIRS[:UNIT],... (anchor_a, anchor_b, tdoa; gyro_x ...; "
    "accel_x ...; pose_x ...; time, or tdoa_time, imu_time, pose_time)"
)


def parse_columns(text):
    """{our column: (their column, factor)} of "OURS=THEIRS[:UNIT],...". Raises InputError."""
    columns = {}
    for entry in text.split(","):
        ours, given, theirs = (part.strip() for part in entry.partition("="))
        if not given or ours not in UNITS or not theirs or ours in columns:
            raise InputError(
                f"--columns: {entry!r} is not OURS=THEIRS, where OURS, once, is one of {', '.join(UNITS)}."
            )
        units = UNITS[ours]
        name, colon, unit = theirs.rpartition(":")
        if not colon:
            name, unit = theirs, next(iter(units))
        if unit not in units:
            usual = " or ".join(filter(None, units)) or "none"
            raise InputError(f"--columns: {entry!r}: {unit!r} is no unit of {ours}; use {usual}.")
        columns[ours] = name, units[unit]
    for stream in (stream for stream, mine in STREAMS.items() if stream == "tdoa" or mine.keys() & columns.keys()):
        needed = [*(name for name in STREAMS[stream] if name not in OPTIONAL)]
        if missing := [name for name in needed if name not in columns]:
            raise InputError(f"--columns: {missing[0]} is missing; {', '.join(needed)} belong together.")
        if not {TIMES[stream], "time"} & columns.keys():
            raise InputError(f"--columns: {TIMES[stream]}, or time, is missing; name the column with the time.")
    if len(ATTITUDE & columns.keys()) not in (0, 4):
        raise InputError(f"--columns: {', '.join(sorted(ATTITUDE))} belong together.")
    return columns


def read_columns(paths, columns, anchors, salvage=False):
    """Flight of CSV files with a header line each; each stream is taken from the one file that has its columns.

    A row counts for a stream if its cells are filled: rows of several sensors may be mixed in one file. Anchor ids are
    whole numbers, or hexadecimal as 0x1A2B. columns : see `parse_columns`; anchors : Anchors; salvage : leave out
    records that are not finite. Raises InputError, with the line for a cell that is no number.
    """
    tables = {path: read_table(path, most=TABLE_CELLS) for path in paths}
    wanted, streams = {path: {} for path in paths}, {}
    for stream, known in STREAMS.items():
        mine = {name: columns[name] for name in known if name in columns}
        if mine:
            mine["t"] = columns.get(TIMES[stream]) or columns["time"]
            wanted[_having(tables, mine)][stream] = mine
    for path, of_file in wanted.items():
        for stream, values in _values(path, tables[path], of_file).items():
            streams[stream] = {"t" if name == "t" else STREAMS[stream][name][0]: column for name, column in values.items()}
    for row, (a, b) in enumerate(zip(streams["tdoa"]["a"], streams["tdoa"]["b"])):
        if not all(value == np.floor(value) and 0 <= value <= 65535 for value in (a, b)):
            raise InputError(f"{paths[0]}: TDOA {row + 1}: anchors {a:g} and {b:g}; ids are whole numbers 0 ... 65535.")
    streams["tdoa"].update({name: streams["tdoa"][name].astype(np.int64) for name in "ab"})
    if "pose" in streams and "qx" not in streams["pose"]:
        streams["pose"].update({f"q{k}": np.full(len(streams["pose"]["t"]), np.nan) for k in "xyzw"})
    meta = {"source": ", ".join(map(str, paths)), "format": "CSV, columns as given"}
    return make_flight(Path(paths[0]).stem, anchors, streams, {}, meta, salvage)


def _having(tables, mine):
    """The path of the one table that has all columns."""
    names = {theirs for theirs, _ in mine.values()}
    having = [path for path, table in tables.items() if names <= {*table.names}]
    if len(having) == 1:
        return having[0]
    if having:
        raise InputError(f"{having[1]}: has column {min(names)!r} as {having[0]} has; give one of them.")
    path, table = next(iter(tables.items()))
    raise InputError(f"{path}: has no column {min(names - {*table.names})!r}; its columns are {', '.join(table.names)}.")


def _values(path, table, streams):
    """{stream: {our name: (n,) array}}, in our units, of the rows in which a cell of the stream is filled. streams : {stream: columns}
    that the table has."""
    values, rows = {stream: {name: array("d") for name in mine} for stream, mine in streams.items()}, 0
    for rows, (line, cells) in enumerate(table, start=1):
        for stream, mine in streams.items():
            texts = {name: cells[theirs].strip() for name, (theirs, _) in mine.items()}
            if any(text for name, text in texts.items() if name != "t"):
                for name, text in texts.items():
                    values[stream][name].append(_number(path, line, mine[name][0], text))
    if streams and not rows:
        raise InputError(f"{path}: has no row below its header; record the flight again.")
    return {stream: {name: np.array(column) * streams[stream][name][1] for name, column in of.items()} for stream, of in values.items()}


def _number(path, line, name, text):
    try:
        return float(int(text, 16)) if text[:2] in ("0x", "0X") else float(text)
    except (ValueError, OverflowError):
        raise InputError(f"{path}: line {line}: {name} is {text[:40]!r}; it must be a number.") from None
