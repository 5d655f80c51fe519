# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""CSV files of the UTIL dataset (Zhao et al., IJRR 2024), plain or gzip, with all 27 columns or some."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
import csv
from itertools import islice
import math
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_bytes
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.limits import CSV_BYTES, CSV_CELLS, Budget, most_unpacked

from ..command_lines import SALVAGE
from .streams import Columns, make_flight
from .tables import GZIP_MAGIC, CsvRows, check_text, unpacked

# Each sensor has its own time column and its own length: they are only set side by side, a row is
# not one instant.
# Units: the authors' converter writes the columns as the micro-SD log has them, so acc is in g and
# gyro in deg/s
# (utiasDSL/util-uwb-dataset, scripts/flight-dataset/sdcard_scripts/log_to_csv.py); stamps are in s
# from the start.
_STREAMS = {  # our stream: {column of the file: column of the stream}, the time column first
    "tdoa": {"t_tdoa": "t", "idA": "a", "idB": "b", "tdoa_meas": "d"},
    "acc": {"t_acc": "t", "acc_x": "x", "acc_y": "y", "acc_z": "z"},
    "gyro": {"t_gyro": "t", "gyro_x": "x", "gyro_y": "y", "gyro_z": "z"},
    "tof": {"t_tof": "t", "tof": "tof"},
    "flow": {"t_flow": "t", "deltaX": "x", "deltaY": "y"},
    "baro": {"t_baro": "t", "baro": "baro"},
    "pose": {"t_pose": "t", "pose_x": "x", "pose_y": "y", "pose_z": "z"},
}
_QUATERNION = {"pose_qx": "qx", "pose_qy": "qy", "pose_qz": "qz", "pose_qw": "qw"}
TDOA_COLUMNS = tuple(_STREAMS["tdoa"])
_KNOWN = {name for rename in _STREAMS.values() for name in rename} | {*_QUATERNION}


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
    for stream, rename in _STREAMS.items():
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
