"""Measured figures, and how they are told: a table, and JSON."""

from dataclasses import asdict, dataclass

import numpy as np

HEADER = ("", "median", "quartiles", "unit", "target")


@dataclass(frozen=True)
class Figure:
    """One line of the table: the median of repeated measurements and their quartiles, in `unit`.

    section, name : unique together; count : of the measurements; target : upper limit in the same unit, or None.
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
    def of(cls, section, name, unit, values, target=None):
        """From repeated measurements, a number or (n,) of them; NaN where there is none."""
        values = np.atleast_1d(np.asarray(values, dtype=float))
        values = values[np.isfinite(values)]
        low, median, high = np.percentile(values, [25, 50, 75]) if len(values) else (np.nan,) * 3
        return cls(section, name, unit, float(median), float(low), float(high), len(values), target)

    @property
    def met(self):
        """Whether the median meets the target; None if there is none."""
        if self.target is None:
            return None
        return bool(self.median <= self.target)


def table(figures):
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


def as_json(figures):
    """List of dicts; JSON has no NaN: null."""
    rows = [asdict(figure) | {"met": figure.met} for figure in figures]
    return [{key: None if value != value else value for key, value in row.items()} for row in rows]


def _cells(figure):
    target = ""
    if figure.target is not None:
        target = f"<= {_number(figure.target)}{'' if figure.met else ' MISSED'}"
    spread = f"{_number(figure.low)} .. {_number(figure.high)}" if figure.count > 1 else ""
    return f"  {figure.name}", _number(figure.median), spread, figure.unit, target


def _number(value):
    return f"{value:.0f}" if value == round(value) or abs(value) >= 1000.0 else f"{value:.3g}"


def _line(cells, wide):
    name, median, spread, unit, target = (
        cell.rjust(width) if k in (1, 2) else cell.ljust(width) for k, (cell, width) in enumerate(zip(cells, wide))
    )
    return f"{name}  {median}  {spread}  {unit}  {target}".rstrip()
