# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""CSV tables, and CSV files and JSON lines of other tools as one foreign recording.

Rows are read one by one, because the cells of a large file as text exceed the memory.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
import csv
from gzip import GzipFile
import io
from itertools import chain, dropwhile, islice, takewhile
import json
import math
import operator
from pathlib import Path
import re
from typing import Any
import zlib

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_bytes, read_head
from uwb_tdoa_bias.common.limits import (
    ROW_CHARACTERS,
    SMALL_TABLE_CELLS,
    TABLE_BYTES,
    TABLE_CELLS,
    Budget,
)

from ..command_lines import SALVAGE

GZIP_MAGIC = b"\x1f\x8b"
_BLOCK = 1 << 20  # bytes that are unpacked at once
_NUMBER = re.compile(r"\s*[-+]?\.?\d[\d.,eE+-]*\s*")


def _is_comment(text: str) -> bool:
    return text.startswith(("#", "%"))


class CsvRows:
    """Iterate over the rows of CSV content (bytes), as lists of cells.

    Raises csv.Error for invalid CSV, and InputError for bytes that are not text.
    """

    def __init__(self, path: str | Path, content: bytes, **options: Any) -> None:
        self._path, self._content, self._read = path, content, 0
        self._file = io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline="")
        self._reader = csv.reader(self._lines(), **options)

    @property
    def line(self) -> int:
        """Return the number of lines read so far."""
        return self._reader.line_num

    def __iter__(self) -> Iterator[list]:
        try:
            for row in self._reader:
                self._read = 0
                yield row
        except UnicodeDecodeError:
            check_text(self._path, self._content)
            raise

    def _lines(self) -> Iterator[str]:
        while line := self._file.readline(ROW_CHARACTERS):
            self._read += len(line)  # a row goes over several lines where cells do
            if self._read >= ROW_CHARACTERS:
                raise csv.Error(f"has a row of more than {ROW_CHARACTERS} characters")
            yield line


class CsvTable:
    """Iterate over (line, {column: text}) of the rows of a CSV file. Raises InputError.

    Attributes
    ----------
    names : columns of the file; "1", "2", ... without a header. It may stand behind # or %. JSON
        lines have the paths of their values, as "stamp.sec" and "d[0]".
    delimiter : the most frequent of comma, semicolon and tab in the first row; a blank without any.
    """

    def __init__(
        self,
        path: str | Path,
        columns: Sequence[str] | None = None,
        most: int = SMALL_TABLE_CELLS,
        complete: bool = True,
    ) -> None:
        """Read the header of a file that has at least the columns; default: all of its columns.

        Parameters
        ----------
        most : largest number of cells.
        complete : refuse rows with fewer cells than the header; otherwise missing cells are empty.

        Raises InputError, also during the iteration.
        """
        self._path, self._most, self._complete = path, most, complete
        named = f" with columns {', '.join(columns)}" if columns else ""
        content = read_bytes(path, TABLE_BYTES, f"CSV file{named}")
        if content.startswith(GZIP_MAGIC):
            content, problem = unpacked(path, content, TABLE_BYTES)
            if problem:
                raise InputError(
                    f"{path}: the gzip data is cut or damaged ({problem}); copy the file again."
                )
            Budget(path).spend("bytes of text", len(content), TABLE_BYTES)
        self._added = content.lstrip()[:1] in (b"{", b"[")  # lines above the first one of the file
        if self._added:
            content = _as_csv(path, content, most)
        lines = content[:ROW_CHARACTERS].decode("utf-8-sig", "replace").strip().splitlines()
        above = [*takewhile(_is_comment, lines)]
        first = "".join(lines[len(above) : len(above) + 1])
        self.delimiter = max(",;\t", key=first.count)
        if self.delimiter not in first and " " in first:
            self.delimiter = " "
        form: dict[str, Any] = {"skipinitialspace": True, "delimiter": self.delimiter}
        self._rows = CsvRows(path, content, **form)
        self._cells: Iterator[tuple[int, list[str]]] = dropwhile(
            lambda row: _is_comment(row[1][0]), self._each()
        )
        comment = [line.strip("#% ") for line in above[-1:]]
        self.names = self._header(next(csv.reader(comment, **form), []))
        self._columns = columns if columns is not None else [name for name in self.names if name]
        if missing := [name for name in self._columns if name not in self.names]:
            raise InputError(
                f"{path}: has no column {missing[0]}; it needs columns {', '.join(self._columns)}."
            )

    def __iter__(self) -> Iterator[tuple[int, dict[str, str]]]:
        names, budget = (
            {name: self.names.index(name) for name in self._columns},
            Budget(self._path, TABLE_BYTES),
        )
        for line, cells in self._cells:
            budget.spend("cells", len(cells), self._most)
            short = len(cells) <= max(names.values(), default=0)
            if short and self._complete:
                raise InputError(
                    f"{self._path}: line {line}: has fewer cells than the header; complete it."
                )
            yield (
                line,
                {
                    name: cells[place] if not short or place < len(cells) else ""
                    for name, place in names.items()
                },
            )

    def _header(self, comment: list[str]) -> list[str]:
        """Return the names of the columns; the next row is then the first with values.

        comment : cells of the last comment above the table.
        """
        rows = [*islice(self._cells, 2)]
        cells, below = ([cells for _, cells in rows] + [[], []])[:2]
        numeric, numeric_below = (
            [_NUMBER.fullmatch(cell) is not None for cell in row] for row in (cells, below)
        )
        begins = not numeric[:1] == [True] and any(map(operator.lt, numeric, numeric_below))
        is_header = begins or not any(numeric)
        self._cells = chain(rows[1:] if is_header else rows, self._cells)
        numbers = [f"{k + 1}" for k in range(max(len(cells), len(below)))]
        names = cells if is_header else comment if len(comment) == len(cells) else numbers
        return [name.strip() for name in names]

    def _each(self) -> Iterator[tuple[int, list[str]]]:
        """Yield (line, cells) of the rows that are not empty."""
        try:
            yield from ((self._rows.line - self._added, cells) for cells in self._rows if cells)
        except csv.Error as error:
            raise InputError(
                f"{self._path}: line {self._rows.line}: is no CSV ({error}); correct it there."
            ) from error


def _as_csv(path: str | Path, content: bytes, most: int) -> bytes:
    """Return JSON lines as CSV with a column for each path of a value. Raises InputError."""
    check_text(path, content)
    lines = [line.strip(" ,[]\t") for line in content.decode("utf-8-sig").splitlines()]
    try:
        rows = [dict(_leaves(json.loads(line or "{}"), "")) for line in lines]
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: is no JSON with one record on each line ({error}); write it so, as "
            "jq -c '.[]' does."
        ) from error
    names = dict.fromkeys(name for row in rows for name in row)
    Budget(path).spend("cells", len(names) * len(rows), most)
    out = io.StringIO()
    table = csv.DictWriter(out, names)
    table.writeheader()
    table.writerows(rows)
    return out.getvalue().encode()


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield (path, number or text) of a JSON value, as ("stamp.sec", 3); 1 for true."""
    if not isinstance(value, (dict, list)):
        yield path.lstrip("."), int(value) if isinstance(value, bool) else value
        return
    for key, each in value.items() if isinstance(value, dict) else enumerate(value):
        yield from _leaves(each, f"{path}.{key}" if isinstance(value, dict) else f"{path}[{key}]")


def unpacked(path: str | Path, content: bytes, most: int) -> tuple[bytes, str]:
    """Return the content of gzip data, and why it ends early, or "".

    It is limited to little more than `most` bytes: the header of gzip data does not contain the size.
    """
    out, budget, problem = io.BytesIO(), Budget(path, len(content)), ""
    # a file may have a million members: no copy of the rest for each
    with GzipFile(fileobj=io.BytesIO(content)) as file:
        try:
            while out.tell() <= most and (block := file.read1(_BLOCK)):
                out.write(block)
                budget.check_time()
        except (EOFError, OSError, zlib.error) as error:
            problem = str(error)
    return out.getvalue(), problem


def read_numbers(path: str | Path, columns: Sequence[str]) -> np.ndarray:
    """Return the columns of a CSV file as finite numbers: (n, k). Raise InputError."""
    out = array("d")
    for line, row in CsvTable(path, columns, TABLE_CELLS):
        out.extend(number(path, line, row, name) for name in columns)
    return np.array(out).reshape(-1, len(columns))


def number(path: str | Path, line: int, row: dict[str, str], column: str) -> float:
    """Return a cell as a float. Raise InputError unless it is finite."""
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(
            f"{path}: line {line}: {column} is {row[column][:40]!r}; it must be a finite number."
        )
    return value


def check_text(path: str | Path, content: bytes) -> None:
    """Raise InputError for bytes that are not text."""
    try:
        content.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not text; give a CSV file.") from error


class CsvFiles:
    """Tables of CSV files, plain or gzip, with the interface of a `ForeignBag`.

    Attributes
    ----------
    types : {path: "CSV"}.
    delimiters : {path: delimiter of the cells}.
    counts : {path: rows that were read}.
    remarks : always empty.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._names: dict[str, list[str]] = {}
        self.delimiters: dict[str, str] = {}
        for path in map(str, paths):
            table = CsvTable(path, most=TABLE_CELLS, complete=False)
            self._names[path], self.delimiters[path] = table.names, table.delimiter
        self.types = dict.fromkeys(self._names, "CSV")
        self.counts: Counter[str] = Counter()
        self.remarks: list[str] = []

    def fields(self, table: str) -> list[str]:
        """Return the columns of a file."""
        return self._names[table]

    def time_of(self, table: str) -> None:
        """Return None: a profile names the column with the time."""

    def messages(self, tables: Sequence[str]) -> Iterator[tuple[str, str, Row]]:
        """Yield (path, place in the file, Row). Raises InputError."""
        for path in tables:
            # anew, as a second pass reads the anchors
            for line, cells in CsvTable(path, most=TABLE_CELLS, complete=False):
                self.counts[path] += 1
                yield path, f"line {line}", Row(cells)
            if not self.counts[path]:
                raise InputError(f"{path}: has no row below its header; record the flight again.")


class Row:
    """A row of a CSV file."""

    def __init__(self, cells: dict[str, str]) -> None:
        self._cells = cells

    def length(self, path: str) -> int:
        """Raise KeyError: a cell is no array."""
        raise KeyError(path)

    def value(self, path: str, index: int | None = None) -> str:
        """Return the text of a cell. Raises KeyError."""
        return self._cells[path].strip()


def table_of(table: str) -> str:
    """Return the name of a file that the topic of a profile is compared with."""
    return Path(table).name


# ULog files of PX4 as a foreign recording. pyulog, an optional extra, parses them.


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
