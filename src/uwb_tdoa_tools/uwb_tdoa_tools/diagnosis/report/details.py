"""What is there for who wants to know more: values, errors, residuals, health, words."""

from __future__ import annotations

from html import escape
from typing import Any, TYPE_CHECKING

from uwb_tdoa_bias.effects.wording import rounded, significant

from ...scoring.phases import TITLES
from ..channels import CHANNELS
from . import curves
from .entries import entries, for_people
from .markup import folded, paragraphs, table
from .runs import CM, labels
from .words import used

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from ..channels.base import Figures
    from ..diagnose import Diagnosis


def details(diagnosis: Diagnosis) -> list[str]:
    """Folded parts."""
    return [
        folded("Every value in effects.yaml", _values(diagnosis)),
        folded("How sure each finding is", _evidence(diagnosis)),
        folded("Errors of every run", _errors(diagnosis)),
        folded("Functions without a name", curves.functions(diagnosis)),
        folded("What measurements leave, over time", curves.residual_series(diagnosis)),
        folded("What measurements leave, pair by pair", curves.pairs(diagnosis)),
        folded("Looked at and not added", _refused(diagnosis)),
        folded("Health of every channel, before", _health(diagnosis.health)),
    ]


def terms(text: str) -> str:
    """Meanings of the terms that a text uses."""
    rows = "".join(f"<dt><b>{escape(name)}</b></dt><dd>{escape(meaning)}</dd>" for name, meaning in used(text).items())
    return folded("What abbreviations and names of effects mean", f"<dl>{rows}</dl>" if rows else "")


def _values(diagnosis: Diagnosis) -> str:
    note = (
        "Standard deviations are those of the fit. A value smaller than two of them is not significant: by itself "
        "it could be chance, beside the others it may still help. Values without one were set, not estimated. "
        "Coefficients of functions without a name are in the file alone. Angles are in degrees here, in the file in radians."
    )
    rows = []
    for effect in (effect for effect in diagnosis.effects.effects if not effect.settings):
        known = significant(effect)
        for key, value in effect.values.items():
            std, (unit, factor) = effect.std.get(key), for_people(effect.unit, key)
            sure = "" if std is None else ("yes" if key in known else "no")
            spread = None if std is None else factor * std
            error = "" if spread is None else rounded(spread, spread)
            rows.append((effect.name, key, rounded(factor * value, spread), error, unit, sure))
    if not rows:
        return ""
    head = ("effect", "parameter", "value", "standard deviation", "unit", "significant")
    return paragraphs([note], "note") + table(head, rows, numbers=(2, 3))


EVIDENCE = {
    "criterion": "criterion",
    "held_out_gain": "gain on data held out",
    "held_out_t": "its t value",
    "standard_errors": "standard errors",
    "slow_before": "slow innovations before, m",
    "slow_left": "after, m",
    "scatter_over_air": "scatter over that in the air",
}


def _evidence(diagnosis: Diagnosis) -> str:
    if not diagnosis.findings:
        return ""
    note = (
        "Criterion: by how much likelier the measurements are with it, as twice a logarithm, less the price of its "
        "parameters and of the search. Gain on data held out: the same on stretches that it was not fitted to, "
        "without any price; its t value says how evenly they agree. Standard errors: the size of what a search of "
        "its own found, in its uncertainty. Slow innovations: measured minus predicted TDOAs, averaged over half a second."
    )
    used_keys = [key for key in EVIDENCE if any(key in finding.evidence for finding in diagnosis.findings)]
    rows = [
        (entry.title, entry.findings[0].channel, *(entry.findings[0].evidence.get(key) or "" for key in used_keys))
        for entry in entries(diagnosis)
    ]
    head = ("finding", "channel", *(EVIDENCE[key] for key in used_keys))
    return paragraphs([note], "note") + table(head, rows, numbers=range(2, len(head)))


SIDE_BY_SIDE = 2  # runs that a phone shows beside each other
FIGURES = (  # key, title, factor
    ("rmse_x", "x", CM), ("rmse_y", "y", CM), ("rmse_z", "z", CM), ("rmse_3d", "3D RMSE", CM),
    ("median_3d", "median", CM), ("max_3d", "largest", CM), ("residual_spread", "scatter of innovations", CM),
    ("nis_mean", "NIS", 1.0), ("nees_mean", "NEES", 1.0),
)  # fmt: skip


def _errors(diagnosis: Diagnosis) -> str:
    before, after = diagnosis.before, diagnosis.after
    shown = [item for item in FIGURES if before["pooled"].get(item[0]) is not None]
    names = [*labels(diagnosis), "all"]
    rows = []
    for name, first, second in zip(names, [*before["runs"], before["pooled"]], [*after["runs"], after["pooled"]]):
        intervals = [_interval(side) for side in (first, second)] if first.get("rmse_3d_ci") else []
        rows.append((name, *(f"{_figure(first, *item)} → {_figure(second, *item)}" for item in shown), *intervals))
    note = (
        f"Before → after, on {diagnosis.judged_on}. Errors and scatter in centimetres; NIS and NEES as they are, 1 "
        "and 3 if the filter judges itself rightly, more if it is too sure."
    )
    bounds = ("95 % of 3D RMSE before", "after") if rows and len(rows[0]) > 1 + len(shown) else ()
    head = ("run", *(title for _, title, _ in shown), *bounds)
    return paragraphs([note], "note") + table(head, rows, numbers=range(1, len(head)))


def phases(diagnosis: Diagnosis) -> str:
    """The error of every run in each phase of its recording, before and after."""
    sides = [[*side["runs"], side["pooled"]] for side in (diagnosis.before, diagnosis.after)]
    found = [[row.get("phases", {}) for row in side] for side in sides]
    names = [name for name in TITLES if any(phases.get(name, {}).get("rmse_3d") is not None for side in found for phases in side)]
    if not names:
        return ""
    runs = labels(diagnosis)
    columns = dict(zip([*runs, "all"], zip(*found)))
    if len(runs) == 1:
        del columns["all"]
    note = (
        "3D RMSE in centimetres, before → after; and NEES, which is 3 if the filter judges itself rightly, more if it is too sure. "
        "Every other error of this page is of the time in the air."
    )
    few = columns if len(columns) <= SIDE_BY_SIDE else {"all": columns["all"]}
    rest = "" if few is columns else folded("Of each run", _of_phases(names, columns))
    return paragraphs([note], "note") + _of_phases(names, few) + rest


def _of_phases(names: Sequence[str], columns: Mapping[str, Sequence[dict[str, Any]]]) -> str:
    """A row for each phase, a column for each run."""
    rows = [(TITLES[name], *(_phase(first.get(name), second.get(name)) for first, second in columns.values())) for name in names]
    return table(("", *columns), rows, numbers=range(1, 1 + len(columns)))


def _phase(before: dict[str, Any] | None, after: dict[str, Any] | None) -> str:
    """A cell of figures of one phase, before and after."""
    if before is None or after is None:
        return ""
    sides = before, after
    errors, judged = (" → ".join(_figure(side, key, "", factor) for side in sides) for key, factor in (("rmse_3d", CM), ("nees_mean", 1.0)))
    return f"{errors}; NEES {judged}"


def _figure(row: dict[str, Any], key: str, title: str, factor: float) -> str:
    value = row.get(key)
    return "?" if value is None else f"{value * factor:.{1 if factor > 1.0 else 2}f}"


def _interval(row: dict[str, Any]) -> str:
    return " to ".join(f"{bound * CM:.1f}" for bound in row["rmse_3d_ci"] or ()) or "?"


def _refused(diagnosis: Diagnosis) -> str:
    added = {finding.effect.label for finding in diagnosis.findings if finding.added}
    rows = [
        (f"a further part of {item.what}" if item.what in added else item.what, item.why) for item in diagnosis.refused
    ]
    return table(("what", "why not"), rows) if rows else ""


def _health(health: Figures) -> str:
    note = (
        "Offset: median of what is left; scatter: its spread, as standard deviation of the bulk; far off: share "
        "beyond four times the scatter; likeness: correlation with what is left 0.1 s later, 0 for white noise. "
        f"Units: {', '.join(f'{channel.unit} for {name}' for name, channel in CHANNELS.items())}."
    )
    parts = [paragraphs([note], "note")]
    for group, name in (("pairs", "pair"), ("anchors", "anchor"), ("axes", "axis")):
        rows = [_row(item, name) for item in health[group]]
        parts.append(
            table((name, "samples", "offset", "scatter", "far off", "likeness"), rows, range(1, 6)) if rows else ""
        )
    crossed = [(" and ".join(item["pairs"]), f"{item['correlation']:.2f}") for item in health["cross_correlation"]]
    parts.append(table(("pairs that err together", "correlation"), crossed, (1,)) if crossed else "")
    rows = []
    for item in health["filter"]:
        means = [f"{item[key]:.2f}" for key in ("nis_mean", "nees_mean")]
        rows.append((item["flight"], *means, *(f"{item[key]:.0%}" for key in ("nis_below_3.84", "nees_below_7.81"))))
    head = ("flight", "NIS", "NEES", "NIS within its 95 % bound", "NEES within its 95 % bound")
    parts.append(table(head, rows, range(1, 5)) if rows else "")
    return "".join(parts)


def _row(item: dict[str, Any], name: str) -> tuple[Any, ...]:
    near = next(iter((item.get("autocorrelation") or {}).values()), None)
    offset, scatter = (f"{item[key]:.2g}" for key in ("bias", "spread"))
    return item[name], item["count"], offset, scatter, f"{item['tails']:.1%}", "" if near is None else f"{near:.2f}"
