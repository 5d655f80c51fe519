# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ULog files of PX4 as a foreign recording. pyulog, an optional extra, parses them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_bytes, read_head

from ..command_lines import SALVAGE

MAGIC = b"ULog\x01\x12\x35"
_TIME = "timestamp"  # us since the start of the autopilot


def is_ulog(path: Path) -> bool:
    """Return whether a file is a ULog."""
    return path.is_file() and path.stat().st_size > 0 and read_head(path, 16).startswith(MAGIC)


class ULogFile:
    """Messages of one ULog file, with the interface of a `ForeignBag`.

    Attributes
    ----------
    types, counts : {message: the same}, {message: number}. Instances but the first are called NAME.1, NAME.2, ...
    remarks : sentences on what the autopilot could not log.
    """

    def __init__(self, paths: Sequence[Path], salvage: bool = False) -> None:
        """Read a file. Raises InputError."""
        path, *more = paths
        if more:
            raise InputError(f"{more[0]}: a ULog is one recording; convert one by one.")
        try:
            from pyulog.core import ULog
        except ImportError as error:
            raise InputError(
                f"{path}: is a ULog of PX4, which needs pyulog; run `pip install pyulog` first."
            ) from error
        read_bytes(path)  # limits its size
        try:
            log = ULog(str(path))
        except Exception as error:  # pyulog raises whatever its parser runs into
            raise _damaged(path, str(error)) from error
        if log.file_corruption and not salvage:
            raise _damaged(path, "pyulog finds messages that do not fit")
        self._data: dict[str, dict[str, np.ndarray]] = {
            each.name + (f".{each.multi_id}" if each.multi_id else ""): each.data
            for each in log.data_list
        }
        self.types = {name: name for name in self._data}
        self.counts = Counter({name: len(data[_TIME]) for name, data in self._data.items()})
        self.remarks: list[str] = []
        if log.file_corruption:
            self.remarks.append("the log is damaged: read what fits.")
        if log.dropouts:
            lost = sum(each.duration for each in log.dropouts)
            self.remarks.append(
                f"the autopilot dropped messages {len(log.dropouts)} times, {lost} ms in all."
            )

    def fields(self, table: str) -> list[str]:
        """Return the fields of a message; entries of arrays are fields as gyro_rad[0]."""
        return [*self._data[table]]

    def time_of(self, table: str) -> tuple[str, float]:
        """Return the field with the time, and its unit in s."""
        return _TIME, 1e-6

    def messages(self, tables: Sequence[str]) -> Iterator[tuple[str, str, ULogRow]]:
        """Yield (message, its place, ULogRow)."""
        for table in tables:
            for number in range(self.counts[table]):
                yield table, f"message {number + 1}", ULogRow(self._data[table], number)


class ULogRow:
    """One message of a ULog."""

    def __init__(self, data: dict[str, np.ndarray], number: int) -> None:
        self._data, self._number = data, number

    def length(self, path: str) -> int:
        """Return the length of an array. Raises KeyError."""
        length = 0
        while f"{path}[{length}]" in self._data:
            length += 1
        if not length:
            raise KeyError(path)
        return length

    def value(self, path: str, index: int | None = None) -> Any:
        """Return the number of a field; raise KeyError if there is none."""
        if path == "index":
            return index
        entry = f"{path}[{index}]"
        return self._data[entry if entry in self._data else path][self._number]


def _damaged(path: Path, said: str) -> InputError:
    return InputError(
        f"{path}: this ULog is cut or damaged ({said}); copy it from the autopilot again, or {SALVAGE}."
    )
