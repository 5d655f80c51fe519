"""What plan says: figures for plan.json, and lines for the screen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..checking.coverage import to_copy
from ..scoring.gains import change_of
from .judging import FLYABLE, IMPRECISE, OUTSIDE, TOO_FEW, TWO_SOLUTIONS
from .precision import NORMAL_99, dilution

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..simulation.room import Room
    from .installation import Installation
    from .maps import Chart

SHARES = {
    "flyable": FLYABLE,
    "two_solutions": TWO_SOLUTIONS,
    "imprecise": IMPRECISE,
    "too_few": TOO_FEW,
    "outside": OUTSIDE,
}
LISTED = 20  # anchors of a design that are printed one by one; more are in hall.yaml alone
_COLUMNS = {
    "rmse": "RMSE",
    "scatter": "scatter",
    "claimed": "claimed",
    "bound": "bound",
    "achieved_over_bound": "/ bound",
    "efficiency_claimed": "eff. cl.",
    "efficiency_achieved": "eff. ach.",
}


def summary(chart: Chart) -> dict[str, Any]:
    """Figures of a Chart: sizes in m, m^2 or m^3, shares 0 to 1 of all its cells, of the room or of
    a slice of it; "heard": {anchors heard: share}; "bound_flyable": quantiles, m.
    """
    step = chart.grid.step
    cell = step**2 if chart.grid.shape[2] == 1 else step**3
    numbers, counts = np.unique(chart.heard, return_counts=True)
    return {
        "cells": list(chart.grid.shape),
        "step": step,
        **{f"{name}_share": float(np.mean(chart.status == code)) for name, code in SHARES.items()},
        "flyable_size": float(chart.flyable.sum() * cell),
        "size": float(chart.flyable.size * cell),
        "heard": dict(zip(map(str, numbers.tolist()), (counts / len(chart.heard)).tolist())),
        "bound_flyable": quantiles(chart.error[chart.flyable]),
    }


def in_hull(chart: Chart, installation: Installation) -> dict[str, Any]:
    """Figures of a Chart inside the anchors' hull, m; None where no cell is."""
    rows = installation.inside_hull(chart.grid.points) & np.isfinite(chart.error)
    pdop = (
        np.linalg.norm(dilution(chart.grid.points[rows], installation), axis=1)
        if rows.any()
        else np.empty(0)
    )
    return {
        "bound_in_hull": quantiles(chart.error[rows]),
        "bound_99_per_axis_in_hull": {
            axis: quantiles(column) for axis, column in zip("xyz", NORMAL_99 * chart.std[rows].T)
        },
        "pdop_in_hull": quantiles(pdop),
    }


def say_room(room: Room, given: bool) -> None:
    """Print the Room, and whether it was given."""
    ends = ", ".join(
        f"{axis} {low:.2f} to {high:.2f}" for axis, low, high in zip("xyz", room.lower, room.upper)
    )
    print(
        f"room: {ends} m"
        + (
            ""
            if given
            else ", what the anchors span; if yours is another: --room X0 X1 Y0 Y1 Z0 Z1"
        )
    )


def say_in_hull(about: dict[str, Any]) -> None:
    """Print what `in_hull` found."""
    if about["bound_in_hull"] is None:
        print("no cell is among the anchors with a bound; choose another --room or --height")
        return
    print("among the anchors (inside their hull):")
    for label, values in (
        ("bound of one round, root of the summed variances, m", about["bound_in_hull"]),
        *(
            (f"99 % of {axis} within +-, m", values)
            for axis, values in about["bound_99_per_axis_in_hull"].items()
        ),
        ("PDOP", about["pdop_in_hull"]),
    ):
        print(f"  {label:52s}" + _quantiles(values, 3))


def say_heard(about: dict[str, Any]) -> None:
    """Print how many anchors are heard where, in a hall."""
    shares = {int(number): share for number, share in about["heard"].items()}
    for label, low, high in (
        ("fewer than 4", 0, 3),
        ("4 or 5", 4, 5),
        ("6 or 7", 6, 7),
        ("8 or more", 8, 1 << 30),
    ):
        print(
            f"  {label:14s} anchors heard: "
            f"{100.0 * sum(s for n, s in shares.items() if low <= n <= high):5.1f} % of the "
            "cells"
        )


def say_flyable(about: dict[str, Any], accuracy: float) -> None:
    """Print how much can be flown, and what keeps it from the rest. about : of `summary`; accuracy
    : m, that is asked for.
    """
    unit, whole = (
        ("m^2", "this slice of your room") if about["cells"][2] == 1 else ("m^3", "your room")
    )
    print(f"{' x '.join(map(str, about['cells']))} cells of {about['step']:.3g} m")
    print(
        f"{_percent(about['flyable_share'])} of {whole} can be flown "
        f"({about['flyable_size']:.1f} of {about['size']:.1f} {unit}); "
        f"too few anchors heard {_percent(about['too_few_share'])}, imprecise (bound of one "
        f"round over {accuracy:g} m) "
        f"{_percent(about['imprecise_share'])}, two solutions "
        f"{_percent(about['two_solutions_share'])}"
        + (
            f", outside of the anchors' hull {_percent(about['outside_share'])}"
            if about["outside_share"]
            else ""
        )
    )
    if about["bound_flyable"]:
        print(
            "  bound of one round where it can be flown, m: "
            + _quantiles(about["bound_flyable"], 2)
        )


def say_addition(told: dict[str, Any] | None, before: float) -> None:
    """Print what one more anchor gains. told : of `advice.one_more`; before : share that can be
    flown without it.
    """
    if told is None:
        print(
            "no place that was tried for one more anchor gains 1 % of the room, or 5 % of precision"
        )
        return
    at = ", ".join(f"{x:.2f}" for x in told["position"])
    finer = ""
    if told["bound_before"]:
        finer = (
            f"; the bound where it can be flown now goes from {100.0 * told['bound_before']:.1f} "
            f"to {100.0 * told['bound_after']:.1f} cm (median)"
        )
    print(
        f"add an anchor at ({at}): {100.0 * before:.1f} -> "
        f"{100.0 * told['flyable_share']:.1f} % can be flown{finer}"
    )


def say_design(
    steps: Sequence[dict[str, Any]],
    chosen: dict[str, Any],
    placed: Sequence[dict[str, Any]],
    share: float,
) -> None:
    """Print what layouts give, the one that was chosen, and where its anchors are put. steps,
    chosen : of design.Step; placed : of design.about.
    """
    print(
        f"{'anchors':>8s}{'one for':>9s}{'spacing':>9s}{'flyable':>9s}  bound there, m: "
        "median, 95 %"
    )
    for step in [*steps, chosen]:
        bound = (
            "       -" if step["median"] is None else f"{step['median']:8.2f}{step['most']:8.2f}"
        )
        mark = f"  <- on all cells; wanted {_percent(share)}" if step is chosen else ""
        print(
            f"{step['count']:8d}{step['spacing'] ** 2:5.0f} m^2{step['spacing']:7.1f} "
            f"m{100.0 * step['share']:7.1f} %{bound}{mark}"
        )
    heights = np.array([anchor["position"][2] for anchor in placed])
    print(
        f"heights: {heights.min():.1f} to {heights.max():.1f} m, "
        f"{np.sum(heights < heights.mean())} low and {np.sum(heights >= heights.mean())} high"
    )
    for anchor in placed if len(placed) <= LISTED else ():
        at = ", ".join(f"{x:.1f}" for x in anchor["position"])
        print(
            f"anchor {anchor['id']}: at ({at}), upright, its front turned {anchor['yaw']:.0f} "
            "deg from x towards y"
        )


def say_side(side: dict[str, Any] | None) -> None:
    """Print what `Hall.side` found."""
    if side:
        print(
            f"at {_percent(side['share'])} of the cells the anchors that are heard lie in a "
            f"plane: {to_copy(side['tag_side'])}"
        )


def say_check(found: dict[str, Any]) -> None:
    """Print what `run.check` found."""
    print(
        f"check: {found['places']} places, agreement with the brute-force solver "
        f"{found['agreement']:.2%}"
    )


def say_flights(rows: Sequence[dict[str, Any]]) -> None:
    """Print the rows of accuracy.comparison, each with its "flight"."""
    print(
        "3D, root mean square, m; efficiency: variance of the bound of one round over that of "
        "the estimate"
    )
    print(f"{'flight':20s}" + "".join(f"{label:>10s}" for label in _COLUMNS.values()))
    for row in rows:
        print(f"{row['flight']:20s}" + "".join(f"{row[name]:10.3f}" for name in _COLUMNS))


def say_improvement(found: dict[str, Any]) -> None:
    """Print before and after in the terms of `summary`, and what is judged where it flies."""
    print(f"{'':44s}  before   after")
    for name, label, factor, digits in (
        ("flyable_share", "flyable, % of the room", 100.0, 1),
        ("worst", f"worst bound of {found['points']} places that are flown, m", 1.0, 3),
        ("mean", "mean bound there, m", 1.0, 3),
        ("failing", "of them not flyable, %", 100.0, 1),
    ):
        old, new = (factor * found[when][name] for when in ("before", "after"))
        change = f"  {change_of(old, new)}" if old and factor == 1.0 else ""
        print(f"{label:44s}{old:8.{digits}f}{new:8.{digits}f}{change}")
    for anchor in found["placed"]:
        print(f"anchor {anchor['id']}: {anchor['words']}")


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _quantiles(values: dict[str, float], digits: int) -> str:
    return "  ".join(f"{name} {value:.{digits}f}" for name, value in values.items())


def quantiles(values: np.ndarray) -> dict[str, float] | None:
    """{"best", "median", "95 %", "worst"} of values (n,); None without any."""
    if not len(values):
        return None
    return dict(
        zip(
            ("best", "median", "95 %", "worst"), np.quantile(values, [0.0, 0.5, 0.95, 1.0]).tolist()
        )
    )
