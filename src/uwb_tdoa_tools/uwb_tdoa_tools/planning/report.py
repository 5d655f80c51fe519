"""What plan says: figures for plan.json, and lines for the screen."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

import numpy as np

from .precision import NORMAL_99

if TYPE_CHECKING:
    from collections.abc import Sequence
    from ..simulation.room import Room
    from .maps import Chart

WORTH = 0.02  # of the room: less is not worth an anchor
_COLUMNS = {
    "rmse": "RMSE", "scatter": "scatter", "claimed": "claimed", "bound": "bound", "achieved_over_bound": "/ bound",
    "efficiency_claimed": "eff. cl.", "efficiency_achieved": "eff. ach.",
}  # fmt: skip


def summary(chart: Chart) -> dict[str, Any]:
    """Figures of a Chart: sizes in m, m^2 or m^3, shares 0 to 1 of all its cells: of the room, or of a slice of it. None where no cell is
    inside the hull."""
    inside, step = chart.hull & np.isfinite(chart.error), chart.grid.step
    cell = step**2 if chart.grid.shape[2] == 1 else step**3
    return {
        "cells": list(chart.grid.shape),
        "step": step,
        "flyable_share": float(chart.flyable.mean()),
        "outside_share": float(np.mean(~chart.hull)),
        "two_solutions_share": float(np.mean(chart.hull & ~chart.flyable)),
        "flyable_size": float(chart.flyable.sum() * cell),
        "size": float(chart.flyable.size * cell),
        "bound_in_hull": quantiles(chart.error[inside]),
        "bound_99_per_axis_in_hull": {
            axis: quantiles(column) for axis, column in zip("xyz", NORMAL_99 * chart.std[inside].T)
        },
        "pdop_in_hull": quantiles(chart.dop[inside]),
    }


def say_room(room: Room, given: bool) -> None:
    """Print the Room, and whether it was given."""
    ends = ", ".join(f"{axis} {low:.2f} to {high:.2f}" for axis, low, high in zip("xyz", room.lower, room.upper))
    print(f"room: {ends} m" + ("" if given else ", what the anchors span; if yours is another: --room X0 X1 Y0 Y1 Z0 Z1"))


def say_summary(about: dict[str, Any]) -> None:
    """Print what `summary` found."""
    print(f"{' x '.join(map(str, about['cells']))} cells of {about['step']:.3g} m")
    if about["bound_in_hull"] is None:
        print("no cell is among the anchors with a bound; choose another --room or --height")
        return
    print("among the anchors (inside their hull):")
    for label, values in (
        ("bound of one round, root of the summed variances, m", about["bound_in_hull"]),
        *((f"99 % of {axis} within +-, m", values) for axis, values in about["bound_99_per_axis_in_hull"].items()),
        ("PDOP", about["pdop_in_hull"]),
    ):
        print(f"  {label:52s}" + "  ".join(f"{name} {value:.3f}" for name, value in values.items()))


def say_flyable(about: dict[str, Any], addition: dict[str, Any] | None, criterion: str) -> None:
    """Print how much can be flown, and what one more anchor would give. addition : of `run.addition`, or None; criterion : of FLYABLE."""
    unit, whole = ("m^2", "this slice of your room") if about["cells"][2] == 1 else ("m^3", "your room")
    print(
        f"{_percent(about['flyable_share'])} of {whole} can be flown ({about['flyable_size']:.1f} of {about['size']:.1f} {unit}); "
        f"{_percent(about['outside_share'])} is not among the anchors, {_percent(about['two_solutions_share'])} has two solutions"
    )
    if addition and addition["gain"] >= WORTH:
        at = ", ".join(f"{x:.2f}" for x in addition["position"])
        print(
            f"add an anchor at ({at}): {_percent(about['flyable_share'] + addition['gain'])}; --improve add looks closer, for precision too"
        )
    elif addition:
        ways = ["--improve move looks for better places of those there are"]
        ways += ["--flyable round asks less: that a whole round of TDOAs has one solution"] if criterion == "pairings" else []
        print(f"one more anchor on the walls would not change that by {_percent(WORTH)}; {'; '.join(ways)}")


def say_check(found: dict[str, Any]) -> None:
    """Print what `run.check` found."""
    print(f"check: {found['places']} places, agreement with the brute-force solver {found['agreement']:.2%}")


def say_flights(rows: Sequence[dict[str, Any]]) -> None:
    """Print the rows of accuracy.comparison, each with its "flight"."""
    print("3D, root mean square, m; efficiency: variance of the bound of one round over that of the estimate")
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
        change = f"  ({new / old - 1.0:+.0%})" if old and factor == 1.0 else ""
        print(f"{label:44s}{old:8.{digits}f}{new:8.{digits}f}{change}")
    for anchor in found["placed"]:
        print(f"anchor {anchor['id']}: {anchor['words']}")


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def quantiles(values: np.ndarray) -> dict[str, float] | None:
    """{"best", "median", "95 %", "worst"} of values (n,); None without any."""
    if not len(values):
        return None
    return dict(zip(("best", "median", "95 %", "worst"), np.quantile(values, [0.0, 0.5, 0.95, 1.0]).tolist()))
