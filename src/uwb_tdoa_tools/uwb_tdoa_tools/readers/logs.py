# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Raw logs of the Crazyflie: event logs of the micro-SD card deck (uSD logger), versions 1 and 2, and CSV files of the UTIL dataset.

The CSV files (Zhao et al., IJRR 2024) are plain or gzip, with all 27 columns or some.
"""

from __future__ import annotations

from dataclasses import replace
from os import SEEK_END
from pathlib import Path
from typing import Any
import zlib

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.errors import USD_TYPES, USD_VARIABLES, Budget, InputError, sanitize
from uwb_tdoa_bias.common.files import read_bytes
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import NamedAnchors

from ..command_lines import SALVAGE
from .by_profile import flight_name, streams_of
from .profile import Profile, check_columns, parse_columns
from .streams import Columns, make_flight
from .tables import GZIP_MAGIC, CsvFiles

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
        _check_ids(path, streams["tdoa"])
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


def _check_ids(path: str | Path, columns: Columns) -> None:
    """Raise InputError for ids of anchors that are no whole numbers of 16 bits."""
    for name in ("a", "b"):
        values = columns[name].astype(float)
        bad = ~((values >= 0) & (values <= 65535) & (values == np.floor(values)))
        if bad.any():
            raise InputError(
                f"{path}: estTDOA, record {np.flatnonzero(bad)[0] + 1}: id{name.upper()} is "
                f"{columns[name][bad][0]}; "
                "it must be a whole number 0 ... 65535."
            )


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
    events: dict[int, tuple[str, list[tuple[str, str]]]] = {}
    budget = Budget(path)
    for _ in range(number("the number of event types")):
        budget.spend("event types", 1, USD_TYPES)
        where, event = at, number("the id of an event type")
        name = string("the name of an event type")
        fields: dict[str, str] = {}
        for _ in range(number(f"the number of variables of {name}")):
            budget.spend("variables", 1, USD_VARIABLES)
            variable = string(f"a variable of {name}")
            field, code = variable[:-3], variable[-2:-1]
            if (
                variable[-3:] != f"({code})"
                or code not in _NUMPY_OF_STRUCT
                or not field
                or field in fields
            ):
                raise InputError(
                    f"{path}: byte {at - len(variable) - 1}: {variable!r} is not a new "
                    f"variable of {name} (expected "
                    f"'name(c)', c one of {' '.join(_NUMPY_OF_STRUCT)}); the file is damaged."
                )
            fields[field] = _NUMPY_OF_STRUCT[code]
        if event in events or any(name == other for other, _ in events.values()):
            raise InputError(
                f"{path}: byte {where}: event type {event} {name!r} is defined twice; the "
                "file is damaged."
            )
        events[event] = name, [*fields.items()]
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
UTIL_COLUMNS = (
    "tdoa_time=t_tdoa,anchor_a=idA,anchor_b=idB,tdoa=tdoa_meas,"
    "accel_time=t_acc,accel_x=acc_x:g,accel_y=acc_y:g,accel_z=acc_z:g,"
    "gyro_time=t_gyro,gyro_x=gyro_x:deg/s,gyro_y=gyro_y:deg/s,gyro_z=gyro_z:deg/s,"
    "height_time=t_tof,height=tof:mm,flow_time=t_flow,flow_x=deltaX,flow_y=deltaY,"
    "altitude_time=t_baro,altitude=baro,"
    "pose_time=t_pose,pose_x=pose_x,pose_y=pose_y,pose_z=pose_z,"
    "pose_qx=pose_qx,pose_qy=pose_qy,pose_qz=pose_qz,pose_qw=pose_qw"
)

TDOA_COLUMNS = "t_tdoa", "idA", "idB", "tdoa_meas"


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
    salvage : see `read_by_profile`; a file may also be cut within a line.

    Raises InputError, see `read_by_profile`.
    """
    tables, every = CsvFiles([Path(path)], salvage), parse_columns(UTIL_COLUMNS)
    names = tables.fields(str(path))
    if missing := [name for name in TDOA_COLUMNS if name not in names]:
        raise InputError(
            f"{path}: has no column {missing[0]}; a UTIL CSV file has at least {', '.join(TDOA_COLUMNS)}."
        )
    columns = {ours: theirs for ours, theirs in every.items() if theirs[0] in names}
    check_columns(f"{path}: the header", columns)
    with open(path, "rb") as file:
        is_gzip = file.read(2) == GZIP_MAGIC
        file.seek(-1, SEEK_END)
        is_cut = not is_gzip and file.read(1) not in b"\r\n"
    if is_cut and not salvage:
        raise InputError(
            f"{path}: the last line has no line end: the file is cut; copy it again, end it with a "
            f"new line if it is whole, or {SALVAGE}."
        )
    profile = replace(Profile.of_columns(columns), name="UTIL CSV")
    _, streams, meta = streams_of(tables, path, profile, NamedAnchors(anchors), salvage=salvage)
    meta = {"source": str(path), **meta}
    del meta["read"]
    return make_flight(flight_name(Path(path)), anchors, streams, {}, meta, salvage, truth)


def is_util_csv(line: str) -> bool:
    """Return whether a first line is a header that `read_util_csv` can use or explain."""
    return "t_tdoa" in line or "tdoa_meas" in line
