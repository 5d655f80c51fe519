# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Make the tables of the page: values, errors, health, and undetermined parameters."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, NamedTuple

from uwb_tdoa_bias.effects.base import listed, measured, rounded

from ...scoring.phases import TITLES
from ..channels import CHANNELS
from .entries import by_anchor, for_people
from .runs import CM, labels
from .unclear import by_remedy, undetermined

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from uwb_tdoa_bias.effects import Effect

    from ..channels.base import Figures
    from ..result import Diagnosis
    from .entries import Entry

UNITS = ", ".join(f"{channel.unit} for {name}" for name, channel in CHANNELS.items())
# a reason, and its figures: after ": ", or in brackets at the end
FIGURES_OF_REASON = re.compile(r"(.*?)(?:: (.*\d.*)| \(([^()]*\d[^()]*)\))?")
MANY = 3  # largest number of anchors whose values stand in a sentence
SIDE_BY_SIDE = 2  # largest number of runs side by side on a phone
EVIDENCE = {  # key of EffectFinding.evidence: title of the column
    "criterion": "criterion (twice a log-likelihood)",
    "held_out_gain": "gain on data held out",
    "held_out_t": "t value of that gain",
    "standard_errors": "standard errors",
    "slow_before": "slow innovations before, m",
    "slow_left": "slow innovations after, m",
    "median_error": "median error with it, m",
    "median_error_without": "median error without it, m",
}
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


def advice(effect: Effect) -> tuple[Sequence[str], Table]:
    """Return (sentences, table) that advise what to do about an Effect.

    With more than MANY anchors the table holds their values, lengths in cm.
    """
    anchors, sentences = by_anchor(effect), effect.advice()
    if len(anchors) <= MANY or not sentences:
        return sentences, Table()
    first, _, rest = sentences[0].partition(": ")
    last = rest.rpartition("; ")[2].partition(". ")[2]
    unit, factor = ("cm", 100.0) if effect.unit == "m" else for_people(effect.unit)
    parts = sorted({part for values in anchors.values() for part in values})
    head = ("anchor", *(f"{part} [{unit}]".lstrip() for part in parts))
    rows = [
        (anchor, *(_signed(values.get(part), factor) for part in parts))
        for anchor, values in anchors.items()
    ]
    return [f"{first}.", *filter(None, [last]), *sentences[1:]], Table(
        head, rows, range(1, len(head))
    )


def _signed(found: tuple[float, float | None] | None, factor: float) -> str:
    """Return a value with sign and deviation, such as "+12.3 ± 0.5"; "" for None."""
    if found is None:
        return ""
    value, std = found
    text = measured(factor * value, factor * std if std else None)
    return text if text.startswith("-") else f"+{text}"


def remedies(diagnosis: Diagnosis) -> Table:
    """Return the data that would determine the undetermined effects."""
    rows = [(remedy, listed(what)) for remedy, what in by_remedy(undetermined(diagnosis)).items()]
    return Table(("what would tell", "effects that could be there unseen"), rows)


def untraced(diagnosis: Diagnosis) -> Table:
    """Return all combinations of parameters that the flights do not determine, by remedy."""
    rows: dict[str, list[str]] = {}
    for item in undetermined(diagnosis):
        if item.what or not item.harmless:
            what = f"{item.effect}: {item.what or 'all of it'}"
            rows.setdefault(item.remedy, []).append(what)
    return Table(
        ("what would tell", "parameters"),
        [(remedy, "; ".join(whats)) for remedy, whats in rows.items()],
    )


def values(diagnosis: Diagnosis) -> Table:
    """Return the values of effects.yaml."""
    rows = []
    for effect in (effect for effect in diagnosis.effects.effects if not effect.settings):
        known = effect.significant()
        for key, value in effect.values.items():
            std, (unit, factor) = effect.std.get(key), for_people(effect.unit, key)
            sure = "" if std is None else ("yes" if key in known else "no")
            spread = None if std is None else factor * std
            error = "" if spread is None else rounded(spread, spread)
            rows.append((effect.name, key, rounded(factor * value, spread), error, unit, sure))
    return Table(
        ("effect", "parameter", "value", "standard deviation", "unit", "significant"), rows, (2, 3)
    )


def evidence(diagnosis: Diagnosis, found: Sequence[Entry]) -> Table:
    """Return a row for each Entry: its channel and the figures of its first finding.

    A cell is empty where the finding has no such figure. found : Entries of the Diagnosis
    """
    used = [
        key for key in EVIDENCE if any(key in finding.evidence for finding in diagnosis.findings)
    ]
    firsts = [(entry.title, entry.findings[0]) for entry in found]
    rows = [
        (title, first.channel, *(_cell(first.evidence.get(key)) for key in used))
        for title, first in firsts
    ]
    head = ("finding", "channel", *(EVIDENCE[key] for key in used))
    return Table(head, rows, range(2, len(head)))


def _cell(value: object) -> object:
    return "" if value is None else value


def errors(diagnosis: Diagnosis) -> Table:
    """Return the figures of each run, before and after."""
    before, after = diagnosis.before, diagnosis.after
    shown = [item for item in FIGURES if before["pooled"].get(item[0]) is not None]
    names = [*labels(diagnosis), "all"]
    rows = []
    for name, first, second in zip(
        names, [*before["runs"], before["pooled"]], [*after["runs"], after["pooled"]]
    ):
        intervals = [_interval(side) for side in (first, second)] if first.get("rmse_3d_ci") else []
        figures = (
            f"{_figure(first, key, factor)} → {_figure(second, key, factor)}"
            for key, _, factor in shown
        )
        rows.append((name, *figures, *intervals))
    bounds = ("95 % of 3D RMSE before", "after") if len(rows[0]) > 1 + len(shown) else ()
    head = ("run", *(title for _, title, _ in shown), *bounds)
    return Table(head, rows, range(1, len(head)))


def phases(diagnosis: Diagnosis) -> tuple[Table, Table]:
    """Return the errors in each phase of a recording, before and after, as two tables.

    With few runs the first holds them and the second is empty. Else the first holds the total and
    the second each run.
    """
    sides = [[*side["runs"], side["pooled"]] for side in (diagnosis.before, diagnosis.after)]
    found = [[row.get("phases", {}) for row in side] for side in sides]
    names = [
        name
        for name in TITLES
        if any(phases.get(name, {}).get("rmse_3d") is not None for side in found for phases in side)
    ]
    runs = labels(diagnosis)
    columns = dict(zip([*runs, "all"], zip(*found)))
    if len(runs) == 1:
        del columns["all"]
    if len(columns) <= SIDE_BY_SIDE:
        return _of_phases(names, columns), Table()
    return _of_phases(names, {"all": columns["all"]}), _of_phases(names, columns)


def _of_phases(names: Sequence[str], columns: Mapping[str, Sequence[dict[str, Any]]]) -> Table:
    """Return a table with a row per phase and a column per run."""
    rows = [
        (
            TITLES[name],
            *(_phase(first.get(name), second.get(name)) for first, second in columns.values()),
        )
        for name in names
    ]
    return Table(("", *columns), rows, numbers=range(1, 1 + len(columns)))


def _phase(before: dict[str, Any] | None, after: dict[str, Any] | None) -> str:
    """Return the cell of one phase, before and after."""
    if before is None or after is None:
        return ""
    errors, nees = (
        " → ".join(_figure(side, key, factor) for side in (before, after))
        for key, factor in (("rmse_3d", CM), ("nees_mean", 1.0))
    )
    return f"{errors}; NEES {nees}"


def _figure(row: dict[str, Any], key: str, factor: float) -> str:
    value = row.get(key)
    return "?" if value is None else f"{value * factor:.{1 if factor > 1.0 else 2}f}"


def _interval(row: dict[str, Any]) -> str:
    return " to ".join(f"{bound * CM:.1f}" for bound in row["rmse_3d_ci"] or ()) or "?"


def refused(diagnosis: Diagnosis) -> Table:
    """Return the candidates that were not added, by reason."""
    added = {finding.effect.label for finding in diagnosis.findings if finding.added}
    return by_reason(
        (f"a further part of {item.what}" if item.what in added else item.what, item.why)
        for item in diagnosis.refused
    )


def not_added(found: Sequence[Entry]) -> Table:
    """Return the found entries that were not added, by reason."""
    return by_reason(
        (f"{entry.title}: {entry.values}", entry.why_not) for entry in found if entry.why_not
    )


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


def health(figures: Figures) -> Iterator[Table]:
    """Yield the health figures of channels and of the filter."""
    for group, name in (("pairs", "pair"), ("anchors", "anchor"), ("axes", "axis")):
        head = (name, "samples", "offset", "scatter", "far off", "likeness")
        yield Table(head, [_of_channel(item, name) for item in figures[group]], range(1, 6))
    crossed = [
        (" and ".join(item["pairs"]), f"{item['correlation']:.2f}")
        for item in figures["cross_correlation"]
    ]
    yield Table(("pairs that err together", "correlation"), crossed, (1,))
    rows = []
    for item in figures["filter"]:
        means = [f"{item[key]:.2f}" for key in ("nis_mean", "nees_mean")]
        rows.append(
            (
                item["flight"],
                *means,
                *(f"{item[key]:.0%}" for key in ("nis_below_3.84", "nees_below_7.81")),
            )
        )
    yield Table(
        ("flight", "NIS", "NEES", "NIS within its 95 % bound", "NEES within its 95 % bound"),
        rows,
        range(1, 5),
    )


def _of_channel(item: dict[str, Any], name: str) -> tuple[Any, ...]:
    near = next(iter((item.get("autocorrelation") or {}).values()), None)
    offset, scatter = (f"{item[key]:.2g}" for key in ("bias", "spread"))
    return (
        item[name],
        item["count"],
        offset,
        scatter,
        f"{item['tails']:.1%}",
        "" if near is None else f"{near:.2f}",
    )
