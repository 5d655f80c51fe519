# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of recordings: the interface to all kinds, CSV files, JSON lines, ULog files of PX4.

Rows are read in blocks, because the cells of a large file as text exceed the memory.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
import csv
from gzip import GzipFile
import io
from itertools import chain, dropwhile, islice, takewhile, zip_longest
import json
import math
import operator
from pathlib import Path
import re
import struct
from typing import Any, NamedTuple
import zlib

import numpy as np

from uwb_tdoa_bias.common.errors import (
    ROW_CHARACTERS,
    SMALL_TABLE_CELLS,
    TABLE_BYTES,
    TABLE_CELLS,
    Budget,
    InputError,
    most_unpacked,
    number_of,
)
from uwb_tdoa_bias.common.files import read_bytes, read_head

from ..command_lines import SALVAGE

GZIP_MAGIC = b"\x1f\x8b"
BLOCK = 4096  # records that are read at once
_BLOCK_BYTES = 1 << 20  # that are unpacked at once
_NUMBER = re.compile(r"\s*[-+]?\.?\d[\d.,eE+-]*\s*")


class Wanted(NamedTuple):
    """Fields of a table to read.

    Attributes
    ----------
    table : its name.
    each : path of an array, each entry of which is a record; "" for one record per message or row.
    paths : names of fields, as "pose.x", or of columns.
    """

    table: str
    each: str
    paths: tuple[str, ...]


class Block(NamedTuple):
    """Some records of one Wanted.

    Attributes
    ----------
    number : of the Wanted, from 0.
    places : numbers of the messages or lines, from 1.
    columns : {path: values}, as many as places.
    """

    number: int
    places: list[int]
    columns: dict[str, list[Any]]


class Foreign:
    """Tables of a recording: topics of a bag, CSV files, messages of a ULog.

    Attributes
    ----------
    types : {table: type}.
    columns : {table: names of its fields}.
    time : field with the time and its unit in s, if every table has it.
    counts, unstamped : {table: messages}, {table: messages without a stamp}.
    remarks : sentences on what is missing, after reading.
    place : word for the place of a record.
    """

    place = "message"
    time: tuple[str, float] | None = None

    def __init__(self) -> None:
        self.types: dict[str, str] = {}
        self.columns: dict[str, list[str]] = {}
        self.counts: Counter[str] = Counter()
        self.unstamped: Counter[str] = Counter()
        self.remarks: list[str] = []

    def fields(self, table: str) -> list[str]:
        """Return the fields of a table."""
        return self.columns[table]

    def topic(self, table: str) -> str:
        """Return what the topic of a profile is compared with."""
        return table

    def recorded_anchors(self) -> Any:
        """Return the anchors in a bag (`bags.bag.Recorded`), or None. Raises InputError."""

    def blocks(self, wanted: Sequence[Wanted]) -> Iterator[Block]:
        """Yield the records of tables. Raises InputError for a field that a table lacks."""
        raise NotImplementedError

    def sample(self, table: str, most: int) -> dict[tuple[str, str], list[Any]]:
        """Return {(path, array that it lies in, or ""): values} of the first messages or rows."""
        wanted = [Wanted(table, "", tuple(self.fields(table)))]
        columns = next((block.columns for block in self.blocks(wanted)), {})
        return {(path, ""): values[:most] for path, values in columns.items()}

    def lacks(self, table: str, path: str) -> InputError:
        """Return the InputError of a field that a table does not have."""
        listed = ", ".join(self.fields(table))
        return InputError(f"{table}: has no field {path!r}; its fields are {listed}.")


def _is_comment(text: str) -> bool:
    return text.startswith(("#", "%"))


class CsvTable:
    """Iterate over blocks [(line, cells)] of the rows of a CSV file. Raises InputError.

    Attributes
    ----------
    names : columns of the file; "1", "2", ... without a header. It may stand behind # or %. JSON
        lines have the paths of their values, as "stamp.sec" and "d[0]".
    delimiter : the most frequent of comma, semicolon and tab in the first row; a blank without any.
    remark : sentence on a damaged file, or "".
    """

    def __init__(
        self,
        path: str | Path,
        most: int = SMALL_TABLE_CELLS,
        what: str = "CSV file",
        salvage: bool = False,
    ) -> None:
        """Read the header.

        Parameters
        ----------
        most : largest number of cells.
        what : words for the expected file.
        salvage : read gzip data up to the damage.

        Raises InputError, also during the iteration.
        """
        self._path, self._most = path, most
        content, self.remark = _content(path, what, salvage)
        self._size = len(content)
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
        rows = self._rows(content, form)
        self._cells: Iterator[tuple[int, list[str]]] = dropwhile(
            lambda row: _is_comment(row[1][0]), rows
        )
        comment = [line.strip("#% ") for line in above[-1:]]
        self.names = self._header(next(csv.reader(comment, **form), []))

    def __iter__(self) -> Iterator[list[tuple[int, list[str]]]]:
        budget = Budget(self._path, self._size)
        while block := [*islice(self._cells, BLOCK)]:
            budget.spend("cells", sum(len(cells) for _, cells in block), self._most)
            yield block

    def place_of(self, name: str) -> int:
        """Return the place of a column. Raises InputError if it is there twice."""
        if self.names.count(name) > 1:
            raise InputError(
                f"{self._path}: column {name!r} is there twice; every column must be there once."
            )
        return self.names.index(name)

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

    def _rows(self, content: bytes, form: dict[str, Any]) -> Iterator[tuple[int, list[str]]]:
        """Yield (line, cells) of the rows that are not empty. `form` : options of csv.reader."""
        file, length = io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline=""), 0

        def lines() -> Iterator[str]:
            nonlocal length
            while line := file.readline(ROW_CHARACTERS):
                length += len(line)  # a row goes over several lines where cells do
                if length >= ROW_CHARACTERS:
                    raise csv.Error(f"has a row of more than {ROW_CHARACTERS} characters")
                yield line

        reader = csv.reader(lines(), **form)
        try:
            for cells in reader:
                length = 0
                if cells:
                    yield reader.line_num - self._added, cells
        except UnicodeDecodeError:
            check_text(self._path, content)
            raise
        except csv.Error as error:
            raise InputError(
                f"{self._path}: line {reader.line_num}: is no CSV ({error}); correct it there."
            ) from error


def _content(path: str | Path, what: str, salvage: bool) -> tuple[bytes, str]:
    """Return the unpacked text of a file, and a sentence on damage that is left out, or ""."""
    content, most = read_bytes(path, TABLE_BYTES, what), TABLE_BYTES
    problem = ""
    if content.startswith(GZIP_MAGIC):
        most = most_unpacked(len(content), TABLE_BYTES)
        content, problem = _unpacked(path, content, most)
        Budget(path).spend("bytes of text", len(content), most)
    if problem and not salvage:
        raise InputError(
            f"{path}: the gzip data is cut or damaged ({problem}); copy the file again, or {SALVAGE}."
        )
    if b"\0" in content:
        place = content.index(0)
        raise InputError(f"{path}: byte {place} is 0, not text; write the file in UTF-8.")
    remark = f"the gzip data is cut or damaged ({problem}): read up to there." if problem else ""
    return content, remark


def _as_csv(path: str | Path, content: bytes, most: int) -> bytes:
    """Return JSON lines as CSV with a column for each path of a value. Raises InputError."""
    check_text(path, content)
    lines = [line.strip(" ,[]\t") for line in content.decode("utf-8-sig").splitlines()]
    names, rows, header = dict[str, None](), [], 0  # characters of all names
    try:
        for line in lines:
            if max(len(line), header) > ROW_CHARACTERS:
                raise ValueError(f"a row of more than {ROW_CHARACTERS} characters")
            rows.append(dict(_leaves(json.loads(line or "{}"), "")))
            new = [name for name in rows[-1] if name not in names]
            names.update(dict.fromkeys(new))
            header += sum(map(len, new))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: is no JSON with one record on each line ({error}); write it so, as "
            "jq -c '.[]' does."
        ) from error
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


def _unpacked(path: str | Path, content: bytes, most: int) -> tuple[bytes, str]:
    """Return the content of gzip data, and why it ends early, or "".

    It is limited to little more than `most` bytes: the header of gzip data does not contain the size.
    """
    out, budget, problem = io.BytesIO(), Budget(path, len(content)), ""
    # a file may have a million members: no copy of the rest for each
    with GzipFile(fileobj=io.BytesIO(content)) as file:
        try:
            while out.tell() <= most and (block := file.read1(_BLOCK_BYTES)):
                out.write(block)
                budget.check_time()
        except (EOFError, OSError, zlib.error) as error:
            problem = str(error)
    return out.getvalue(), problem


def read_rows(
    path: str | Path, columns: Sequence[str], most: int = SMALL_TABLE_CELLS
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield (line, {column: text}) of a CSV file of ours, at most so many cells. Raises InputError."""
    listed = ", ".join(columns)
    table = CsvTable(path, most, f"CSV file with columns {listed}")
    for name in columns:
        if name not in table.names:
            raise InputError(f"{path}: has no column {name}; it needs columns {listed}.")
    places = {name: table.place_of(name) for name in columns}
    for line, cells in chain.from_iterable(table):
        if len(cells) <= max(places.values()):
            raise InputError(f"{path}: line {line}: has fewer cells than the header; complete it.")
        yield line, {name: cells[place] for name, place in places.items()}


def read_numbers(path: str | Path, columns: Sequence[str]) -> np.ndarray:
    """Return the columns of a CSV file as finite numbers: (n, k). Raise InputError."""
    numbers = (
        number(path, line, row, name)
        for line, row in read_rows(path, columns, TABLE_CELLS)
        for name in columns
    )
    return np.fromiter(numbers, float).reshape(-1, len(columns))


def number(path: str | Path, line: int, row: dict[str, str], column: str) -> float:
    """Return a cell as a float. Raise InputError unless it is finite."""
    value = number_of(row[column])
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
        raise InputError(
            f"{path}: byte {error.start} is not text in UTF-8; write the file in UTF-8."
        ) from error


class CsvFiles(Foreign):
    """Tables of CSV files, plain or gzip: {path: "CSV"}.

    Attributes
    ----------
    delimiters : {path: delimiter of the cells}.
    """

    place = "line"

    def __init__(self, paths: Sequence[Path], salvage: bool = False) -> None:
        """Read the headers. `salvage` : see CsvTable. Raises InputError."""
        super().__init__()
        self._salvage = salvage
        self.delimiters: dict[str, str] = {}
        for path in map(str, paths):
            table = CsvTable(path, TABLE_CELLS, salvage=salvage)
            self.columns[path], self.delimiters[path] = table.names, table.delimiter
            self.remarks += filter(None, [table.remark])
            self._open = {path: table}  # the last one: the content of all may be too much
        self.types = dict.fromkeys(self.columns, "CSV")

    def topic(self, table: str) -> str:
        """Return the name of a file."""
        return Path(table).name

    def blocks(self, wanted: Sequence[Wanted]) -> Iterator[Block]:
        """Yield the records of files. Raises InputError."""
        for path in dict.fromkeys(one.table for one in wanted):
            rows = self._open.pop(path, None) or CsvTable(path, TABLE_CELLS, salvage=self._salvage)
            mine = [(number, one) for number, one in enumerate(wanted) if one.table == path]
            for _, one in mine:
                if lacking := {*one.paths, one.each} - {*rows.names, ""}:
                    raise self.lacks(path, min(lacking))
            places = {name: rows.place_of(name) for _, one in mine for name in one.paths}
            for block in rows:
                self.counts[path] += len(block)
                lines, cells = zip(*block)
                columns = [*zip_longest(*cells, fillvalue="")]
                columns += [("",) * len(block)] * (len(rows.names) - len(columns))
                known = {name: list(map(str.strip, columns[k])) for name, k in places.items()}
                for number, one in mine:
                    yield Block(number, [*lines], {name: known[name] for name in one.paths})
            if not self.counts[path]:
                raise InputError(f"{path}: has no row below its header; record the flight again.")


MAGIC = b"ULog\x01\x12\x35"
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"  # where a reader continues after a damage
_MESSAGE = struct.Struct("<HB")  # size and type of a message
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,5})\])? (\w+)")
_NUMBERS = {"bool": "i1", "char": "i1", "float": "<f4", "double": "<f8"} | {
    f"{sign}int{8 * size}_t": f"<{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}
_MOST_NAMES = 2_000_000  # characters of the names of all fields, nested ones too
_TIME = "timestamp"  # us since the start of the autopilot


def is_ulog(path: Path) -> bool:
    """Return whether a file is a ULog."""
    return path.is_file() and path.stat().st_size > 0 and read_head(path, 16).startswith(MAGIC)


class ULogFile(Foreign):
    """Messages of one ULog file: {message: the same}. Instances but the first are called NAME.1, NAME.2, ...

    Entries of arrays are fields as gyro_rad[0]. docs.px4.io, ULog file format.
    """

    time = _TIME, 1e-6

    def __init__(self, paths: Sequence[Path], salvage: bool = False) -> None:
        """Read a file. Raises InputError."""
        super().__init__()
        path, *more = paths
        if more:
            raise InputError(f"{more[0]}: a ULog is one recording; convert one by one.")
        content = read_bytes(path)
        self._budget, self._formats = Budget(path, len(content)), dict[str, str]()
        # {number of a message: (name, its bytes, their layout)}
        self._logged: dict[bytes, tuple[str, bytearray, np.dtype]] = {}
        self._damage, self._dropouts = "", list[int]()  # ms
        for kind, message in self._messages(content):
            try:
                self._take(kind, message)
            except (KeyError, RecursionError, ValueError) as error:
                self._damage = f"a message of type {kind}: {error!r:.80}"
        if self._damage and not salvage:
            raise InputError(
                f"{path}: this ULog is cut or damaged ({self._damage}); copy it from the autopilot "
                f"again, or {SALVAGE}."
            )
        self._data = {
            name: {
                field: np.frombuffer(data, layout)[field]
                for field in layout.names or ()
                if "_padding" not in field
            }
            for name, data, layout in self._logged.values()
            if data
        }
        self.types = {name: name for name in sorted(self._data)}
        self.columns = {name: [*data] for name, data in self._data.items()}
        self.counts.update({name: len(data[_TIME]) for name, data in self._data.items()})
        if self._damage:
            self.remarks.append("the log is damaged: read what fits.")
        if self._dropouts:
            self.remarks.append(
                f"the autopilot dropped messages {len(self._dropouts)} times, "
                f"{sum(self._dropouts)} ms in all."
            )

    def _messages(self, content: bytes) -> Iterator[tuple[str, bytes]]:
        """Yield (type, content) of the messages. After a damage, continue behind the next _SYNC."""
        at, end = 16, len(content)
        while at + _MESSAGE.size <= end:
            self._budget.check_time()
            size, kind = _MESSAGE.unpack_from(content, at)
            at += _MESSAGE.size + size
            message = content[at - size : at]
            if not (size and kind):
                self._damage = f"no message begins at byte {at - size - _MESSAGE.size}"
                mark = content.find(_SYNC, at)
                at = mark + len(_SYNC) if mark >= 0 else end
            elif at <= end:  # otherwise it is cut
                yield chr(kind), message
            if kind == ord("B"):  # what was appended after a crash is no flight
                end = min(int.from_bytes(message[16:24], "little") or end, end)

    def _take(self, kind: str, message: bytes) -> None:
        """Take a format, a name, data or a dropout. Raises KeyError, RecursionError, ValueError."""
        if kind == "B" and int.from_bytes(message[8:16], "little") > 1:
            raise ValueError("flags that this reader does not know")
        if kind == "F":
            name, _, text = message.decode().partition(":")
            self._formats[name] = text
        elif kind == "A":
            name = message[3:].decode() + (f".{message[0]}" if message[0] else "")
            fields = [*self._fields(message[3:].decode(), "")]
            if (_TIME, _NUMBERS["uint64_t"]) not in fields:
                raise ValueError(f"no {_TIME}")
            while fields[-1][0].startswith("_padding"):  # is not logged at the end
                fields.pop()
            self._logged.setdefault(message[1:3], (name, bytearray(), np.dtype(fields)))
        elif kind == "D":
            _, data, layout = self._logged[message[:2]]
            if len(message) < 2 + layout.itemsize:
                raise ValueError("fewer bytes than its format")
            data += message[2 : 2 + layout.itemsize]
        elif kind == "O":
            self._dropouts.append(int.from_bytes(message[:2], "little"))

    def _fields(self, name: str, prefix: str) -> Iterator[tuple[str, str]]:
        """Yield (name, type of number) of the fields of a message, also of nested ones."""
        for text in filter(None, self._formats[name].split(";")):
            if not (found := _FIELD.fullmatch(text)):
                raise ValueError(f"no field {text[:40]!r}")
            kind, size, field = found.groups()
            spent = int(size or 1) * len(f"{prefix}{field}[100]")
            self._budget.spend("characters of names of fields", spent, _MOST_NAMES)
            for place in [f"[{k}]" for k in range(int(size))] if size else [""]:
                if kind in _NUMBERS:
                    yield f"{prefix}{field}{place}", _NUMBERS[kind]
                else:
                    yield from self._fields(kind, f"{prefix}{field}{place}.")

    def blocks(self, wanted: Sequence[Wanted]) -> Iterator[Block]:
        """Yield the messages, of each Wanted at once. Raises InputError."""
        for number, (table, each, paths) in enumerate(wanted):
            data, count = self._data[table], self.counts[table]
            length = sum(name.startswith(f"{each}[") for name in data) if each else 1
            if not length:
                raise self.lacks(table, each)
            columns = {"index": [*range(length)] * count}
            for path in {*paths} - {"index"}:
                names = [f"{path}[{k}]" for k in range(length)] if each else [path]
                parts: list[Any] = [data.get(name, data.get(path)) for name in names]
                if parts[0] is None:
                    raise self.lacks(table, path)
                columns[path] = [*np.stack(parts, axis=1).ravel()]
            yield Block(number, np.repeat(np.arange(1, count + 1), length).tolist(), columns)
