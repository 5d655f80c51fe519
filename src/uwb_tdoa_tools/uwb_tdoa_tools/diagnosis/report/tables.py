# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Make the tables of the page: anchors, errors, and what was not added or not determined."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
import re
from typing import Any, NamedTuple

import numpy as np

from uwb_tdoa_bias.effects import Effect
from uwb_tdoa_bias.effects.base import listed
from uwb_tdoa_ekf.evidence import OF_ANCHORS

from ...scoring.phases import TITLES
from ..result import Diagnosis
from .entries import CM, Entry, findings_of
from .unclear import by_remedy, undetermined

ANCHORS = "Values that make these data fit; measure again before you move an anchor"
SURE = 2.0  # standard deviations of a value of an anchor that is not marked with "?"
MANY = 3  # largest number of anchors whose positions or delays stand in a sentence
# a reason, and its figures: after ": ", or in brackets at the end
FIGURES_OF_REASON = re.compile(r"(.*?)(?:: (.*\d.*)| \(([^()]*\d[^()]*)\))?")
BASIS = (
    "figures: position error without and with it in trials, beside the effects that were left then; "
    "so those of two effects do not compare"
)
FIGURES = (  # key, title, factor
    ("rmse_x", "x", CM),
    ("rmse_y", "y", CM),
    ("rmse_z", "z", CM),
    ("rmse_3d", "3D RMSE", CM),
    ("median_3d", "median", CM),
    ("max_3d", "largest", CM),
    ("residual_spread", "scatter of innovations", CM),
    ("nis_mean", "NIS", 1.0),
    ("nees_mean", "NEES", 1.0),
)


class Table(NamedTuple):
    """A table of the page.

    head : names of columns; rows : cells; numbers : indices of numeric columns
    """

    head: Sequence[str] = ()
    rows: Sequence[Sequence[object]] = ()
    numbers: Sequence[int] = ()


def labels(diagnosis: Diagnosis) -> list[str]:
    """Return one name per judged run: its flight, plus its time if a flight was judged in parts."""
    runs = [run["flight"] for run in diagnosis.before["runs"]]
    if len(set(runs)) == len(runs):
        return runs
    return [
        f"{score.name}, {score.first:.0f} to {score.last:.0f} s"
        for score in diagnosis.before["scores"]
    ]


def anchors(diagnosis: Diagnosis) -> Table:
    """Return estimated positions and delays of anchors, an anchor in each row.

    The values fit the data. They do not replace a survey.
    """
    found: dict[str, dict[str, str]] = {}
    for finding in findings_of(diagnosis):
        effect = finding.effect
        if effect.name not in OF_ANCHORS or finding.on_floor or finding.flight is not None:
            continue
        for key, value in effect.values.items():
            anchor, _, axis = key.partition(".")
            std = effect.std.get(key, np.nan)
            doubt = "" if abs(value) >= SURE * std else " ?"
            found.setdefault(anchor, {})[axis] = f"{CM * value:+.0f} ± {CM * std:.0f}{doubt}"
    columns = {"x, cm": "x", "y, cm": "y", "z, cm": "z", "late by, cm": ""}  # a delay has no axis
    names = sorted(found, key=int)
    cells = {
        title: [found[anchor].get(axis, "") for anchor in names] for title, axis in columns.items()
    }
    filled = {title: column for title, column in cells.items() if any(column)}
    rows = list(zip(names, *filled.values()))
    return Table(("anchor", *filled), rows, range(1, 1 + len(filled)))


def advice(effect: Effect) -> Sequence[str]:
    """Return sentences that advise what to do about an Effect.

    Positions and delays of more than MANY anchors are left to the table of anchors.
    """
    sentences = effect.advice()
    several = {key.partition(".")[0] for key in effect.significant()}
    if effect.name not in OF_ANCHORS or len(several) <= MANY:
        return sentences
    what, _, its_values = sentences[0].partition(": ")
    _, _, after = its_values.partition(". ")
    rest = [after] if after else []
    return [f"{what}: the table of anchors in report.html has the values.", *rest, *sentences[1:]]


def tasks(found: Iterable[Entry]) -> list[list[tuple[Entry, list[str]]]]:
    """Return what to do: entries with the same causes together, each with its sentences.

    Only the first one of them states the causes.
    """
    out: dict[Hashable, list[tuple[Entry, list[str]]]] = {}
    for entry in found:
        task = out.setdefault(entry.causes or entry.title, [])
        said = [sentence for one in entry.findings for sentence in advice(one.effect)]
        said[1:1] = entry.levels
        known = entry.causes if task else ()
        task.append((entry, [one for one in dict.fromkeys(said) if one not in known]))
    return list(out.values())


def remedies(diagnosis: Diagnosis) -> Table:
    """Return the data that would determine the undetermined effects."""
    rows = [(remedy, listed(what)) for remedy, what in by_remedy(undetermined(diagnosis)).items()]
    return Table(("what would tell", "effects that could be there unseen"), rows)


def errors(diagnosis: Diagnosis) -> Table:
    """Return the figures of each run, before and after."""
    sides = [[*side["runs"], side["pooled"]] for side in (diagnosis.before, diagnosis.after)]
    shown = [item for item in FIGURES if diagnosis.before["pooled"].get(item[0]) is not None]
    rows = []
    for name, before, after in zip([*labels(diagnosis), "all"], *sides):
        row = [name]
        for key, _, factor in shown:
            row.append(f"{_figure(before, key, factor)} → {_figure(after, key, factor)}")
        if before.get("rmse_3d_ci"):
            row += [_interval(before), _interval(after)]
        rows.append(row)
    bounds = ("95 % of 3D RMSE before", "after") if len(rows[0]) > 1 + len(shown) else ()
    head = ("run", *(title for _, title, _ in shown), *bounds)
    return Table(head, rows, range(1, len(head)))


def phases(diagnosis: Diagnosis) -> Table:
    """Return the errors in each phase of a recording, before and after: all runs, then each run."""
    names = ["all", *labels(diagnosis)]
    sides = [[side["pooled"], *side["runs"]] for side in (diagnosis.before, diagnosis.after)]
    if len(names) == 2:
        names, sides = names[1:], [side[1:] for side in sides]
    rows = []
    for phase, title in TITLES.items():
        cells = [
            _phase(before.get("phases", {}).get(phase), after.get("phases", {}).get(phase))
            for before, after in zip(*sides)
        ]
        if any(cells):
            rows.append((title, *cells))
    return Table(("", *names), rows, range(1, 1 + len(names)))


def _phase(before: dict[str, Any] | None, after: dict[str, Any] | None) -> str:
    """Return the cell of one phase, before and after; "" without the phase or its errors."""
    if before is None or after is None:
        return ""
    if before["rmse_3d"] is None and after["rmse_3d"] is None:
        return ""
    errors = " → ".join(_figure(side, "rmse_3d", CM) for side in (before, after))
    nees = " → ".join(_figure(side, "nees_mean", 1.0) for side in (before, after))
    return f"{errors}; NEES {nees}"


def _figure(row: dict[str, Any], key: str, factor: float) -> str:
    value = row.get(key)
    return "?" if value is None else f"{value * factor:.{1 if factor > 1.0 else 2}f}"


def _interval(row: dict[str, Any]) -> str:
    return " to ".join(f"{bound * CM:.1f}" for bound in row["rmse_3d_ci"] or ()) or "?"


def not_added(found: Sequence[Entry]) -> Table:
    """Return the found entries that were not added, by reason."""
    return by_reason(
        (f"{entry.title}: {entry.values}", entry.why_not) for entry in found if entry.why_not
    )


def basis(rows: Iterable[Sequence[object]]) -> str:
    """Return the BASIS if rows of `by_reason` hold figures of trials, else ""."""
    return BASIS if any(" cm without, " in str(row[1]) for row in rows) else ""


def by_reason(items: Iterable[tuple[str, str]]) -> Table:
    """Return a table with one row per reason, so that no reason repeats.

    items : (what, why not); figures after ": ", or in brackets at the end, go with the item
    """
    rows: dict[str, list[str]] = {}
    for what, why in items:
        split = FIGURES_OF_REASON.fullmatch(why)
        reason, figures = split.group(1, 2) if split else (why, "")
        figures = figures or why[len(reason) :].strip(" ()")
        rows.setdefault(reason, []).append(f"{what} ({figures})" if figures else what)
    return Table(
        ("why not", "what"), [(reason, "; ".join(whats)) for reason, whats in rows.items()]
    )
