"""What plan says: figures for plan.json, and lines for the screen."""

import numpy as np

from .precision import NORMAL_99

_COLUMNS = {
    "rmse": "RMSE", "scatter": "scatter", "claimed": "claimed", "bound": "bound", "achieved_over_bound": "/ bound",
    "efficiency_claimed": "eff. cl.", "efficiency_achieved": "eff. ach.",
}  # fmt: skip


def summary(chart):
    """Figures of a Chart: sizes in m, m^2 or m^3, shares 0 to 1; None where no cell is inside the hull."""
    inside, step = chart.hull & np.isfinite(chart.error), chart.grid.step
    cell = step**2 if chart.grid.shape[2] == 1 else step**3
    return {
        "cells": list(chart.grid.shape),
        "step": step,
        "hull_share": float(chart.hull.mean()),
        "unique_share_of_hull": _mean(chart.ambiguous[chart.hull] == 0.0),
        "flyable_share_of_hull": _mean(chart.flyable[chart.hull]),
        "flyable_size": float(chart.flyable.sum() * cell),
        "bound_in_hull": _quantiles(chart.error[inside]),
        "bound_99_per_axis_in_hull": {
            axis: _quantiles(column) for axis, column in zip("xyz", NORMAL_99 * chart.std[inside].T)
        },
        "pdop_in_hull": _quantiles(chart.dop[inside]),
    }


def say_summary(about):
    """Print what `summary` found."""
    cells = " x ".join(map(str, about["cells"]))
    print(f"{cells} cells of {about['step']:.3g} m; {about['hull_share']:.0%} inside the hull of the anchors")
    if about["bound_in_hull"] is None:
        print("no cell is inside the hull with a bound; choose another --area or --height")
        return
    for label, values in (
        ("bound of one round, root of the summed variances, m", about["bound_in_hull"]),
        *((f"99 % of {axis} within +-, m", values) for axis, values in about["bound_99_per_axis_in_hull"].items()),
        ("PDOP", about["pdop_in_hull"]),
    ):
        print(f"{label:52s}" + "  ".join(f"{name} {value:.3f}" for name, value in values.items()))
    unique, flyable = about["unique_share_of_hull"], about["flyable_share_of_hull"]
    print(f"of the hull, every pairing has one solution in {unique:.1%}; flyable is {flyable:.1%}")


def say_check(found):
    """Print what `run.check` found."""
    print(f"check: {found['places']} places, agreement with the brute-force solver {found['agreement']:.2%}")


def say_flights(rows):
    """Print the rows of accuracy.comparison, each with its "flight"."""
    print("3D, root mean square, m; efficiency: variance of the bound of one round over that of the estimate")
    print(f"{'flight':20s}" + "".join(f"{label:>10s}" for label in _COLUMNS.values()))
    for row in rows:
        print(f"{row['flight']:20s}" + "".join(f"{row[name]:10.3f}" for name in _COLUMNS))


def say_improvement(found):
    """Print before and after, as layout.Goal.judge gives them."""
    print(f"over {found['points']} places that are flown: bound in m, share that is not flyable")
    for name in ("worst", "mean", "failing"):
        old, new = found["before"][name], found["after"][name]
        print(f"{name:8s} before {old:.4f}  after {new:.4f}" + (f"  ({new / old - 1.0:+.1%})" if old else ""))


def _mean(values):
    return float(np.mean(values)) if len(values) else None


def _quantiles(values):
    if not len(values):
        return None
    return dict(zip(("best", "median", "95 %", "worst"), np.quantile(values, [0.0, 0.5, 0.95, 1.0]).tolist()))
