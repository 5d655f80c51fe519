# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Raw logs of the Crazyflie: event logs of the micro-SD card deck (uSD logger), versions 1 and 2, and CSV files of the UTIL dataset.

The CSV files (Zhao et al., IJRR 2024) are plain or gzip, with all 27 columns or some.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
import csv
from itertools import islice
import math
from pathlib import Path
from typing import Any
import zlib

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_bytes
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.limits import (
    CSV_BYTES,
    CSV_CELLS,
    USD_TYPES,
    USD_VARIABLES,
    Budget,
    most_unpacked,
)
from uwb_tdoa_bias.common.text import sanitize

from ..command_lines import SALVAGE
from .streams import Columns, make_flight
from .tables import GZIP_MAGIC, CsvRows, check_text, unpacked

MAGIC = 0xBC
_CRC_SIZE = 4
_BLOCK = 100_000  # records that are taken out of the file at once
_STAMP = {1: ("<u4", 1e3), 2: ("<u8", 1e6)}  # version: type of the time stamp, its ticks per second
_NUMPY_OF_STRUCT = {  # codes of Python's struct module, little endian and packed
    "b": "i1",
    "B": "u1",
    "?": "u1",
    "h": "<i2",
    "H": "<u2",
    "i": "<i4",
    "I": "<u4",
    "l": "<i4",
    "L": "<u4",
    "q": "<i8",
    "Q": "<u8",
    "f": "<f4",
    "d": "<f8",
}
# TDOAs of a packet with every anchor that it can be paired with; the estimator of the firmware takes the selected one
_CANDIDATES, _PACKET, _SELECTED = "estTdoaCand", "group", "isSelected"
_STREAMS = {  # event name: our stream, {column in the log: column of the stream}
    "estTDOA": ("tdoa", {"idA": "a", "idB": "b", "distanceDiff": "d"}),
    # its sign is the other one
    _CANDIDATES: ("tdoa", {"idA": "b", "idB": "a", "distanceDiff": "d"}),
    "estGyroscope": ("gyro", {"gyro.x": "x", "gyro.y": "y", "gyro.z": "z"}),
    "estAcceleration": ("acc", {"acc.x": "x", "acc.y": "y", "acc.z": "z"}),
    "estPose": (
        "pose",
        {f"locSrv.{axis}": axis for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")},
    ),
    "estTOF": ("tof", {"range.zrange": "tof"}),
    "estBarometer": ("baro", {"baro.asl": "baro"}),
    "estFlow": ("flow", {"motion.deltaX": "x", "motion.deltaY": "y"}),
}


def read_usd_log(
    path: str | Path, anchors: Anchors, salvage: bool = False, truth: bool = True
) -> Flight:
    """Read a micro-SD event log ("uSD logger" of the Crazyflie firmware).

    TDOAs come from estTdoaCand (d_A - d_B, all candidates of each packet), else from estTDOA (d_B - d_A).
    The IMU comes from estGyroscope (deg/s to rad/s) and estAcceleration (g to m/s^2), the ground truth
    from estPose. The height comes from estTOF (mm to m), the pressure from estBarometer (altitude
    to Pa), the velocity from estFlow (pixel counts, with range and gyroscope). `Flight.extra` keeps
    other events, with the names and units of the log.

    Parameters
    ----------
    salvage : read a damaged log up to the damage, e.g. after a crash. `meta["remarks"]` lists what
        is missing. Single values may be wrong, because only the checksum could detect it.

    Raises InputError for a file that is empty, foreign, cut or damaged (the checksum is always
    verified), and for records that are not finite.
    """
    data = read_bytes(path)
    version, events, start = _read_header(path, data)
    stamp, ticks = _STAMP[version]
    size_of_id = np.full(65536, -1, dtype=np.int64)
    dtypes = {}
    for number, (name, fields) in events.items():
        dtypes[name] = np.dtype([("id", "<u2"), ("t", stamp), ("values", np.dtype(fields))])
        size_of_id[number] = dtypes[name].itemsize
    raw = np.frombuffer(data, dtype=np.uint8)
    meta: dict[str, Any] = {
        "source": str(path),
        "format": f"uSD log version {version}",
        "remarks": [],
    }
    whole = int.from_bytes(data[-_CRC_SIZE:], "little") == zlib.crc32(memoryview(data)[:-_CRC_SIZE])
    end = len(data) - _CRC_SIZE if whole or not salvage else len(data)
    offsets, ids, stopped = scan(raw, start, end, size_of_id)
    if not (whole and stopped < 0):
        if not salvage:
            raise _damaged(path, data, whole, stopped)
        lost = "nothing is visibly missing"
        if stopped >= 0:
            lost = f"{end - stopped} bytes from byte {stopped} on left out"
        meta["remarks"].append(f"cut or damaged: {lost}; single values may be damaged too.")

    streams, extra, order = {}, {}, np.argsort(ids, kind="stable")
    occurring = {events[number][0] for number in np.unique(ids).tolist()}
    numbers = np.array(list(events), dtype=np.uint16)
    ends = [np.searchsorted(ids[order], numbers, side) for side in ("left", "right")]
    for (name, fields), first, last in zip(events.values(), *ends):
        rows = _gather(raw, offsets[order[first:last]], dtypes[name])
        columns = {field: np.ascontiguousarray(rows["values"][field]) for field, _ in fields}
        columns["t"] = rows["t"] / ticks
        if name not in _STREAMS or (name == "estTDOA" and _CANDIDATES in occurring):
            extra[name] = columns
            continue
        stream, rename = _STREAMS[name]
        if name == _CANDIDATES:
            columns["t"] = _packet_times(columns)
            meta["remarks"] += _about_candidates(columns)
        missing = [field for field in rename if field not in columns]
        if missing:
            known = ", ".join(field for field, _ in fields)
            raise InputError(f"{path}: event {name} has no variable {missing[0]} (it has {known}).")
        streams[stream] = {"t": columns["t"], **{rename[field]: columns[field] for field in rename}}
    if "tdoa" in streams:
        streams["tdoa"] = _tdoa(path, streams["tdoa"])
    return make_flight(Path(path).name, anchors, streams, extra, meta, salvage, truth)


def _packet_times(candidates: Columns) -> np.ndarray:
    """Return the stamps of candidates: of their packet, (n,) s.

    The log stamps an event when it is written, so the first candidate of a packet has the stamp that
    is nearest to the reception.
    """
    t = candidates["t"]
    if _PACKET not in candidates or not len(t):
        return t
    number = np.cumsum(np.diff(candidates[_PACKET].astype(np.int64), prepend=-1) != 0) - 1
    first = np.full(number[-1] + 1, np.inf)
    np.minimum.at(first, number, t)
    return first[number]


def _about_candidates(candidates: Columns) -> list[str]:
    """Return a sentence on how many candidates the firmware used."""
    n = len(candidates["t"])
    if _SELECTED not in candidates or not n:
        return []
    used = np.count_nonzero(candidates[_SELECTED])
    return [f"estTdoaCand: all {n} candidates are TDOAs; the firmware used {used} of them."]


def _gather(raw: np.ndarray, at: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Return the records of one kind at the offsets: (n,) structured array."""
    rows = np.empty(len(at), dtype=dtype)
    inside = np.arange(dtype.itemsize)
    for first in range(0, len(at), _BLOCK):
        block = raw[at[first : first + _BLOCK, None] + inside]
        rows[first : first + _BLOCK] = block.view(dtype)[:, 0]
    return rows


def _tdoa(path: str | Path, columns: Columns) -> Columns:
    """Return the columns as the integers and doubles of `Tdoas`; the log has bytes and floats."""
    for name in ("a", "b"):
        values = columns[name].astype(float)
        bad = ~((values >= 0) & (values <= 65535) & (values == np.floor(values)))
        if bad.any():
            raise InputError(
                f"{path}: estTDOA, record {np.flatnonzero(bad)[0] + 1}: id{name.upper()} is "
                f"{columns[name][bad][0]}; "
                "it must be a whole number 0 ... 65535."
            )
    types = {"t": float, "a": np.int64, "b": np.int64, "d": float}
    return {column: np.asarray(values, dtype=types[column]) for column, values in columns.items()}


def _read_header(
    path: str | Path, data: bytes
) -> tuple[int, dict[int, tuple[str, list[tuple[str, str]]]], int]:
    """Return version, {id: (name, [(variable, numpy type), ...])} and the offset of the events."""
    if data[0] != MAGIC:
        raise InputError(
            f"{path}: byte 0 is 0x{data[0]:02X}, a micro-SD event log starts with 0xBC; give "
            "the file as it is on "
            "the card."
        )
    at = 1

    def take(size: int, what: str) -> bytes:
        nonlocal at
        if at + size > len(data) - _CRC_SIZE:
            raise InputError(
                f"{path}: ends after {len(data)} bytes, inside the header ({what} expected at "
                f"byte {at}); the file is "
                "cut: copy it from the card again."
            )
        at += size
        return data[at - size : at]

    def number(what: str) -> int:
        return int.from_bytes(take(2, what), "little")

    def string(what: str) -> str:
        end = data.find(0, at)
        content = take((end if end >= 0 else len(data)) + 1 - at, what)[:-1]
        if not content or not content.isascii() or sanitize(content.decode()) != content.decode():
            raise InputError(
                f"{path}: byte {at - len(content) - 1}: expected {what}, found "
                f"{content[:40]!r}; the file is damaged."
            )
        return content.decode("ascii")

    version = number("the version")
    if version not in _STAMP:
        raise InputError(
            f"{path}: is an event log of version {version}; versions 1 and 2 can be read."
        )
    events, names, budget = {}, set(), Budget(path)
    for _ in range(number("the number of event types")):
        budget.spend("event types", 1, USD_TYPES)
        where, event = at, number("the id of an event type")
        name = string("the name of an event type")
        fields, known = [], set()
        for _ in range(number(f"the number of variables of {name}")):
            budget.spend("variables", 1, USD_VARIABLES)
            variable = string(f"a variable of {name}")
            field, code = variable[:-3], variable[-2:-1]
            if (
                variable[-3:] != f"({code})"
                or code not in _NUMPY_OF_STRUCT
                or not field
                or field in known
            ):
                raise InputError(
                    f"{path}: byte {at - len(variable) - 1}: {variable!r} is not a new "
                    f"variable of {name} (expected "
                    f"'name(c)', c one of {' '.join(_NUMPY_OF_STRUCT)}); the file is damaged."
                )
            fields.append((field, _NUMPY_OF_STRUCT[code]))
            known.add(field)
        if event in events or name in names:
            raise InputError(
                f"{path}: byte {where}: event type {event} {name!r} is defined twice; the "
                "file is damaged."
            )
        events[event] = (name, fields)
        names.add(name)
    return version, events, at


def _damaged(path: str | Path, data: bytes, whole: bool, stopped: int) -> InputError:
    """Return the InputError of a log with a wrong checksum or a gap; `stopped` is its offset or -1."""
    if whole:
        return InputError(
            f"{path}: byte {stopped}: no event of a type that the header defines fits here, "
            "although the checksum is "
            f"right; the log was written by a faulty logger: {SALVAGE}."
        )
    stored, computed = (
        int.from_bytes(data[-_CRC_SIZE:], "little"),
        zlib.crc32(memoryview(data)[:-_CRC_SIZE]),
    )
    first = (
        f"first event that cannot be read: byte {stopped}"
        if stopped >= 0
        else "no event is visibly broken"
    )
    return InputError(
        f"{path}: the checksum in the last 4 bytes is 0x{stored:08X} but 0x{computed:08X} was "
        "expected for the "
        f"{len(data) - _CRC_SIZE} bytes before it ({first}); the file is cut or damaged: copy "
        "it from the card again, "
        f"or {SALVAGE}."
    )


@compiled
def scan(
    raw: np.ndarray, start: int, end: int, size_of_id: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the events in raw[start:end]: offsets, ids, and the offset of an invalid event or -1.

    Parameters
    ----------
    size_of_id : (65536,) bytes of a whole event (id, stamp, payload), -1 for unknown ids.
    """
    smallest = 6  # id and version 1 stamp, no payload
    room = max((end - start) // smallest, 0)
    offsets = np.empty(room, dtype=np.int64)
    ids = np.empty(room, dtype=np.uint16)
    count = 0
    at = start
    while at < end:
        if at + 2 > end:
            return offsets[:count], ids[:count], at
        number = raw[at] | (np.int64(raw[at + 1]) << 8)
        size = size_of_id[number]
        if size < 0 or at + size > end:
            return offsets[:count], ids[:count], at
        offsets[count] = at
        ids[count] = number
        count += 1
        at += size
    return offsets[:count], ids[:count], -1


# Each sensor has its own time column and its own length: they are only set side by side, a row is
# not one instant.
# Units: the authors' converter writes the columns as the micro-SD log has them, so acc is in g and
# gyro in deg/s
# (utiasDSL/util-uwb-dataset, scripts/flight-dataset/sdcard_scripts/log_to_csv.py); stamps are in s
# from the start.
_UTIL_STREAMS = {  # our stream: {column of the file: column of the stream}, the time column first
    "tdoa": {"t_tdoa": "t", "idA": "a", "idB": "b", "tdoa_meas": "d"},
    "acc": {"t_acc": "t", "acc_x": "x", "acc_y": "y", "acc_z": "z"},
    "gyro": {"t_gyro": "t", "gyro_x": "x", "gyro_y": "y", "gyro_z": "z"},
    "tof": {"t_tof": "t", "tof": "tof"},
    "flow": {"t_flow": "t", "deltaX": "x", "deltaY": "y"},
    "baro": {"t_baro": "t", "baro": "baro"},
    "pose": {"t_pose": "t", "pose_x": "x", "pose_y": "y", "pose_z": "z"},
}
_QUATERNION = {"pose_qx": "qx", "pose_qy": "qy", "pose_qz": "qz", "pose_qw": "qw"}
TDOA_COLUMNS = tuple(_UTIL_STREAMS["tdoa"])
_KNOWN = {name for rename in _UTIL_STREAMS.values() for name in rename} | {*_QUATERNION}


def read_util_csv(
    path: str | Path, anchors: Anchors, salvage: bool = False, truth: bool = True
) -> Flight:
    """Read a CSV file in the UTIL schema; it needs at least t_tdoa, idA, idB and tdoa_meas.

    Units change from g to m/s^2, deg/s to rad/s, tof from mm to m, baro from m of altitude to Pa,
    flow from pixel counts to velocity. Ground truth without quaternion columns has NaN for q.
    `meta["unread"]` names columns outside of the schema.

    A plain file that was cut exactly between two lines looks like a shorter one; a gzip file does
    not.

    Parameters
    ----------
    salvage : read a damaged file up to the damage and skip invalid records. `meta["remarks"]` lists
        what is missing.

    Raises InputError with the line for a file that is empty, foreign or cut, and for a cell that is
    not a finite number.
    """
    remarks: list[str] = []
    content = _text(path, remarks, salvage)
    header, cells = _table(path, content, remarks, salvage)

    streams = {}
    for stream, rename in _UTIL_STREAMS.items():
        if stream == "pose" and any(name in cells for name in _QUATERNION):
            rename = rename | _QUATERNION
        if not any(name in cells for name in rename):
            continue
        missing = [name for name in rename if name not in cells]
        if missing:
            raise InputError(
                f"{path}: the header has columns of {stream} but not {missing[0]}; all or "
                "none must be there."
            )
        streams[stream] = {
            rename[name]: values
            for name, values in _numbers(path, content, rename, cells, salvage).items()
        }
    tdoa = streams["tdoa"]
    if salvage:
        valid = np.isfinite(tdoa["a"]) & np.isfinite(tdoa["b"])
        tdoa.update({name: values[valid] for name, values in tdoa.items()})
    tdoa["a"], tdoa["b"] = _ids(path, "idA", tdoa["a"]), _ids(path, "idB", tdoa["b"])

    meta: dict[str, Any] = {"source": str(path), "format": "UTIL CSV", "remarks": remarks}
    if ignored := [name for name in header if name not in _KNOWN]:
        meta["unread"] = [f"columns {', '.join(ignored)}: the UTIL schema has no such"]
    name = Path(path).name.removesuffix(".gz").removesuffix(".csv")
    return make_flight(name, anchors, streams, {}, meta, salvage, truth)


def is_util_csv(line: str) -> bool:
    """Return whether a first line is a header that `read_util_csv` can use or explain."""
    return "t_tdoa" in line or "tdoa_meas" in line


def _text(path: str | Path, remarks: list[str], salvage: bool) -> bytes:
    content, most = read_bytes(path), CSV_BYTES
    if content.startswith(GZIP_MAGIC):
        most = most_unpacked(len(content), CSV_BYTES)
        content, problem = unpacked(path, content, most)
        if problem and len(content) <= most:
            if not salvage:
                raise InputError(
                    f"{path}: the gzip data is cut or damaged ({problem}); copy the file again, "
                    f"or {SALVAGE}."
                )
            remarks.append(f"the gzip data is cut or damaged ({problem}): read up to there.")
    Budget(path).spend("bytes of text", len(content), most)
    if b"\0" in content:
        raise InputError(
            f"{path}: byte {content.index(0)} is 0, not text; a UTIL CSV file was expected: "
            "copy it again."
        )
    if content.isspace():
        raise InputError(f"{path}: holds no text; a UTIL CSV file with a header line was expected.")
    return content


def _table(
    path: str | Path, content: bytes, remarks: list[str], salvage: bool
) -> tuple[list[str], Columns]:
    """Return the header, and {name: `_value` of each row} of the known columns.

    The cells as text would exceed the memory.
    """
    if not content.endswith((b"\n", b"\r")):
        check_text(path, content)
        line = content.count(b"\n") + content.count(b"\r") - content.count(b"\r\n") + 1
        if not salvage or line < 2:
            raise InputError(
                f"{path}: line {line} has no line end: the file is cut; copy it again, end it "
                "with a new line if it is "
                f"whole, or {SALVAGE}."
            )
        remarks.append(f"line {line} is cut and left out.")
        content = content[: max(content.rfind(b"\n"), content.rfind(b"\r")) + 1]
    rows, header, budget = CsvRows(path, content), None, Budget(path, len(content))
    columns: dict[str, array] = {}
    try:
        for row in rows:
            if header is None:
                header = [name.strip() for name in row]
                _check_header(path, header)
                columns = {name: array("d") for name in header if name in _KNOWN}
            elif len(row) != len(header):
                raise csv.Error(f"has {len(row)} cells, the header has {len(header)}")
            else:
                for name, cell in zip(header, row):
                    if name in columns:
                        columns[name].append(_value(cell))
            budget.spend("cells", len(row), CSV_CELLS)
    except csv.Error as error:
        if header is None or not salvage:
            raise InputError(
                f"{path}: line {rows.line} {error}; copy the file again, or {SALVAGE}."
            ) from error
        remarks.append(f"line {rows.line} {error}: read up to there.")
    if header is None:
        raise InputError(f"{path}: holds no line that is whole; copy the file again.")
    return header, {name: np.array(values) for name, values in columns.items()}


def _value(cell: str) -> float:
    """Return the finite number in a cell, NaN for an empty cell, infinity for anything else."""
    if not cell.strip():
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        return math.inf
    return value if math.isfinite(value) else math.inf


def _check_header(path: str | Path, header: list[str]) -> None:
    missing = [name for name in TDOA_COLUMNS if name not in header]
    if missing:
        raise InputError(
            f"{path}: line 1: column {missing[0]} is missing from the header "
            f"({','.join(header)[:80]}); a UTIL CSV "
            f"file has at least {','.join(TDOA_COLUMNS)}."
        )
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise InputError(
            f"{path}: line 1: column {twice!r} is there twice; every column must be there once."
        )


def _numbers(
    path: str | Path, content: bytes, names: Iterable[str], cells: Columns, salvage: bool
) -> Columns:
    """Return {name: (n,) floats} of the columns of one sensor, up to the first empty cell.

    With salvage, invalid cells become NaN.
    """
    columns = {name: cells[name] for name in names}
    length = min(int(np.argmax(np.isnan(np.append(values, np.nan)))) for values in columns.values())
    for name, values in {} if salvage else columns.items():
        filled = np.flatnonzero(~np.isnan(values[length:]))
        if len(filled):
            raise InputError(
                f"{path}: line {length + filled[0] + 2}: {name} is filled although "
                f"{', '.join(names)} ended with an empty cell at line {length + 2}; fill the "
                "columns of one sensor from the top, without holes."
            )
        invalid = np.flatnonzero(np.isinf(values[:length]))
        if len(invalid):
            header, row = islice(CsvRows(path, content), 0, invalid[0] + 2, invalid[0] + 1)
            text = dict(zip(map(str.strip, header), row))[name].strip()
            raise InputError(
                f"{path}: line {invalid[0] + 2}: {name} is {text[:40]!r}; it must be a finite "
                "number: leave the cells after the end of a sensor empty, and delete broken "
                "measurements."
            )
    return {
        name: np.where(np.isinf(values[:length]), np.nan, values[:length])
        for name, values in columns.items()
    }


def _ids(path: str | Path, name: str, values: np.ndarray) -> np.ndarray:
    """Return whole anchor ids 0 ... 65535; the authors' converter writes 4 or 4.0."""
    bad = np.flatnonzero((values != np.round(values)) | (values < 0) | (values > 65535))
    if len(bad):
        raise InputError(
            f"{path}: line {bad[0] + 2}: {name} is {values[bad[0]]}; it must be a whole "
            "number 0 ... 65535."
        )
    return values.astype(np.int64)
