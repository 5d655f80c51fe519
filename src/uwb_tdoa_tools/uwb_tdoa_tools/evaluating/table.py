"""Errors as tables: lines for the screen, and Markdown, beside what others reach."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.foreign_text import harmless

from ..readers.tables import number, read_table
from ..scoring.phases import NEAR_THE_FLOOR, TITLES

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from ..scoring.metrics import Pool, Result, Score

COLUMNS = {
    "rmse_x": "x",
    "rmse_y": "y",
    "rmse_z": "z",
    "rmse_3d": "3D",
    "median_3d": "median",
    "max_3d": "max",
    "frac_gt_1m": ">1 m",
    "nees_mean": "NEES",
    "nis_mean": "NIS",
    "start_delay": "delay",
}
PHASE = {  # of the figures of a phase
    "duration": "s",
    "rmse_x": "x",
    "rmse_y": "y",
    "rmse_z": "z",
    "rmse_3d": "3D",
    "max_3d": "max",
    "std_3d": "stated",
    "nees_mean": "NEES",
    "step": "step",
    "without_estimate": "without, s",
}
OF_RUNS = {
    "rmse_3d_median_of_runs": "runs: median",
    "rmse_3d_max_of_runs": "largest",
    "nees_mean_max_of_runs": "largest NEES",
}
SHORT = {"rmse_3d": "3D", "max_3d": "max", "nees_mean": "NEES", "without_estimate": "without, s"}
ERRORS = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "median_3d", "max_3d")


def head() -> str:
    """The line above those of `line`."""
    return _line("flight", COLUMNS.values())


def line(row: dict[str, Any]) -> str:
    """One run, `Score.row`, or several, `pooled`."""
    word = ""
    if row["diverged"]:
        word = "  LATE START" if row["diverged"] == row["late_start"] else "  DIVERGED"
    return _line(row["flight"], (f"{row[key]:.3f}" for key in COLUMNS)) + word


def lines_of_errors(scores: Sequence[Score]) -> list[str]:
    """Lines of the errors alone, m, of several Scores of one flight."""
    titles = "".join(f"{COLUMNS[key]:>9s}" for key in ERRORS)
    rows = [
        f"{score.name:28s}" + "".join(f"{score.row()[key]:9.3f}" for key in ERRORS)
        for score in scores
    ]
    return [f"{'error, m':28s}{titles}", *rows]


def markdown(rows: Sequence[dict[str, Any]], others: dict[str, dict[str, str]]) -> str:
    """The table of rows, in metres, with one column per other estimator, as `read_others` gives
    them.
    """
    table = [["flight", *COLUMNS.values(), *others]]
    for row in rows:
        cells = [f"{row[key]:.3f}" for key in COLUMNS] + [
            peer.get(row["flight"], "") for peer in others.values()
        ]
        table.append([row["flight"], *cells])
    return _as_markdown(table)


def lines_of_alignment(aligned: dict[str, Any], means: dict[str, float]) -> Iterator[str]:
    """Lines on ground truth beside estimates. aligned : of a single run, as of Result, else {};
    means : {one of ALIGN: 3D RMSE, m}.
    """
    if aligned:
        late = aligned["late"]
        clock = (
            f"its stamps {abs(late):.2f} s {'late' if late > 0.0 else 'early'}"
            if late
            else "its stamps in time"
        )
        yield f"ground truth beside the estimate: {clock}, {aligned['words']}"
    figures = [f"{error:.3f} m --align {how}" for how, error in means.items() if np.isfinite(error)]
    if figures:
        yield f"{'3D RMSE' if aligned else 'mean 3D RMSE of the runs'}: {', '.join(figures)}"


def lines_of_phases(phases: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of the phases of one run, `Score.phases`, or of several, `Pool.phases`."""
    head, *rows = _table_of_phases(phases)
    return [
        f"{row[0]:20s}"
        + "".join(f"{cell:>{max(8, len(title)) + 1}s}" for cell, title in zip(row[1:], head[1:]))
        for row in (head, *rows)
    ]


def markdown_of(results: Sequence[Result], pool: Pool, others: dict[str, dict[str, str]]) -> str:
    """All tables of Results, and of the Pool of them: those of `markdown`, and of phases of all and
    of each.
    """
    rows = [result.row for result in results]
    if len(results) == 1:
        return f"{markdown(rows, others)}\n{_as_markdown(_table_of_phases(results[0].phases))}"
    together = pool.figures()
    of_all, of_each = _table_of_phases(together["phases"]), _table_of_runs(results)
    return f"{markdown([*rows, together], others)}\n{_as_markdown(of_all)}\n{_as_markdown(of_each)}"


def _table_of_runs(results: Sequence[Result]) -> list[list[str]]:
    titles = [
        f"{TITLES[name]}: {first}" if first == "3D" else first
        for name in NEAR_THE_FLOOR
        for first in SHORT.values()
    ]
    table = [["flight", *titles, "step until z > 0.3 m", "ready, s"]]
    for result in results:
        cells = [
            _cell(result.phases.get(phase, {}).get(key))
            for phase in NEAR_THE_FLOOR
            for key in SHORT
        ]
        step = result.phases.get("to_0.3_m", {}).get("step")
        table.append([result.row["flight"], *cells, _cell(step), _cell(result.row["ready_delay"])])
    return table


def _table_of_phases(phases: dict[str, dict[str, Any]]) -> list[list[str]]:
    columns = PHASE | (OF_RUNS if any("runs" in figures for figures in phases.values()) else {})
    rows = [
        [TITLES[name], *(_cell(figures[key]) for key in columns)]
        for name, figures in phases.items()
    ]
    return [["phase", *columns.values()], *rows]


def _cell(value: float | None) -> str:
    """A number, or nothing where there is none."""
    return (
        ""
        if value is None or math.isnan(value)
        else f"{value:.{1 if abs(value) >= 100.0 else 2 if abs(value) >= 10.0 else 3}f}"
    )


def _as_markdown(table: Sequence[Sequence[str]]) -> str:
    """A table, its head first, whose first column is text."""
    ruled = [table[0], ["---"] + ["---:"] * (len(table[0]) - 1), *table[1:]]
    return "".join("| " + " | ".join(cells) + " |\n" for cells in ruled)


def read_others(path: str | Path) -> dict[str, dict[str, str]]:
    """{peer and mode: {flight: 3D RMSE as text, or "diverged"}} of a CSV file.

    Raises InputError.
    """
    others: dict[str, dict[str, str]] = {}
    for line, row in read_table(path, ("flight", "peer", "mode", "rmse_3d", "diverged")):
        cell = (
            "diverged" if row["diverged"] == "True" else f"{number(path, line, row, 'rmse_3d'):.3f}"
        )
        others.setdefault(harmless(f"{row['peer']} {row['mode']}"), {})[harmless(row["flight"])] = (
            cell
        )
    return others


def _line(first: str, cells: Iterable[str]) -> str:
    return f"{first:20s}" + "".join(f"{cell:>9s}" for cell in cells)
