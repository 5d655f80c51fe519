# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""CSV files of other tools as one foreign recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.limits import TABLE_CELLS

from .tables import CsvTable, read_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


class CsvFiles:
    """Tables of CSV files, plain or gzip, with the interface of a `ForeignBag`.

    Attributes
    ----------
    types : {path: "CSV"}.
    counts : {path: rows that were read}.
    remarks : always empty.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._tables: dict[str, CsvTable] = {
            str(path): read_table(path, most=TABLE_CELLS, complete=False) for path in paths
        }
        self.types = dict.fromkeys(self._tables, "CSV")
        self.counts: Counter[str] = Counter()
        self.remarks: list[str] = []

    def fields(self, table: str) -> list[str]:
        """Return the columns of a file."""
        return self._tables[table].names

    def time_of(self, table: str) -> None:
        """Return None: a profile names the column with the time."""

    def messages(self, tables: Sequence[str]) -> Iterator[tuple[str, str, Row]]:
        """Yield (path, place in the file, Row). Raises InputError."""
        for path in tables:
            for line, cells in self._tables[path]:
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
