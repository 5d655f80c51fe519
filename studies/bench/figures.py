# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measured figures, and how they are printed: a table, and JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_tools import cli

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike

HEADER = ("", "median", "quartiles", "unit", "target")


@dataclass(frozen=True)
class Figure:
    """One line of the table: the median of repeated measurements and their quartiles, in `unit`.

    section, name : unique together; count : of the measurements; target : upper limit in the same
        unit, or None.
    """

    section: str
    name: str
    unit: str
    median: float
    low: float
    high: float
    count: int
    target: float | None = None

    @classmethod
    def of(
        cls, section: str, name: str, unit: str, values: ArrayLike, target: float | None = None
    ) -> Figure:
        """Return the Figure of repeated measurements: a number or (n,), NaN where it is missing."""
        numbers = np.atleast_1d(np.asarray(values, dtype=float))
        numbers = numbers[np.isfinite(numbers)]
        low, median, high = np.percentile(numbers, [25, 50, 75]) if len(numbers) else (np.nan,) * 3
        return cls(
            section, name, unit, float(median), float(low), float(high), len(numbers), target
        )

    @property
    def met(self) -> bool | None:
        """Whether the median meets the target; None if there is none."""
        if self.target is None:
            return None
        return bool(self.median <= self.target)


def table(figures: Iterable[Figure]) -> list[str]:
    """Lines of text, with a title above each section."""
    rows = [(f, _cells(f)) for f in figures]
    wide = [max(len(cells[k]) for _, cells in [*rows, (None, HEADER)]) for k in range(len(HEADER))]
    lines, section = [_line(HEADER, wide)], None
    for figure, cells in rows:
        if figure.section != section:
            section = figure.section
            lines += ["", section]
        lines.append(_line(cells, wide))
    return lines


def as_json(figures: Iterable[Figure]) -> list[dict[str, Any]]:
    """List of dicts; JSON has no NaN: null."""
    return [cli.as_json(asdict(figure) | {"met": figure.met}) for figure in figures]


def _cells(figure: Figure) -> tuple[str, ...]:
    target = ""
    if figure.target is not None:
        target = f"<= {_number(figure.target)}{'' if figure.met else ' MISSED'}"
    spread = f"{_number(figure.low)} .. {_number(figure.high)}" if figure.count > 1 else ""
    return f"  {figure.name}", _number(figure.median), spread, figure.unit, target


def _number(value: float) -> str:
    return f"{value:.0f}" if value == round(value) or abs(value) >= 1000.0 else f"{value:.3g}"


def _line(cells: Sequence[str], wide: Sequence[int]) -> str:
    name, median, spread, unit, target = (
        cell.rjust(width) if k in (1, 2) else cell.ljust(width)
        for k, (cell, width) in enumerate(zip(cells, wide))
    )
    return f"{name}  {median}  {spread}  {unit}  {target}".rstrip()
