"""What debias says: a line on a map, and rows of flights."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..scoring.gains import change_in_words, gain, gain_in_words
from .evaluation import evaluate_map

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.debias import BiasMap

    from .evaluation import Scored

SMALLEST_GAIN = 0.01  # of the 3D RMSE: less is neither gain nor harm
_RUN = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "max_3d", "nees_mean")


def about(bias_map: BiasMap) -> str:
    """One line on a BiasMap."""
    figures = about_figures(bias_map)
    added = ", ".join(f"{std:.3f}" for std in figures["added_std"])
    return (
        f"{figures['markers']} markers {figures['step']:g} m apart, "
        f"root mean square of the bias {figures['bias_rms']:.3f} m; "
        f"standard deviations added to a corrected position {added} m"
    )


def about_figures(bias_map: BiasMap) -> dict[str, Any]:
    """The same for JSON."""
    return {
        "markers": len(bias_map.at),
        "step": bias_map.step,
        "interpolator": bias_map.interpolator,
        "planar": bias_map.planar,
        "frame": bias_map.frame,
        "anchors": bias_map.ids.tolist(),
        "source": bias_map.source,
        "bias_rms": float(np.sqrt(np.mean(np.sum(bias_map.bias**2, axis=1)))),
        "added_std": np.sqrt(np.diag(bias_map.added)).tolist(),
    }


def rows(
    flown: Iterable[Scored], bias_map: BiasMap, effects: EffectSet | None = None
) -> list[dict[str, Any]]:
    """[{"flight", "before": figures, "after": figures, "known"}] of what `fly` gave. known : share
    of the positions that the map knows.
    """
    out = []
    for flight, score, odometry in flown:
        after = evaluate_map((flight, score, odometry), bias_map, effects)
        sides = {"before": score.row(), "after": after.row()}
        airborne = odometry.p[(odometry.t >= score.first) & (odometry.t <= score.last)]
        figures = {side: {name: row[name] for name in _RUN} for side, row in sides.items()}
        out.append(
            {
                "flight": flight.name,
                **figures,
                "known": float(np.mean(bias_map.validity(airborne) == 1.0)),
            }
        )
    return out


def say_rows(title: str, found: Sequence[Mapping[str, Any]]) -> None:
    """Print rows, and their mean."""
    if not found:
        return
    print(
        f"{title:24s}   before: x       y       z      3D    NEES   after: x       y       z  "
        "    3D    NEES   known"
    )
    for row in found:
        print(
            f"{row['flight']:24s}"
            + "".join(_side(row[side]) for side in ("before", "after"))
            + f"{row['known']:8.0%}"
        )
    before, after = (
        np.mean([row[side]["rmse_3d"] for row in found]) for side in ("before", "after")
    )
    print(
        f"mean 3D RMSE {before:.3f} m before, {after:.3f} m after: it {change_in_words(before, after)}"
    )


def gain_of(found: Sequence[Mapping[str, Any]]) -> float:
    """The `gain` of rows, of their mean 3D RMSE."""
    return gain(
        *(float(np.mean([row[side]["rmse_3d"] for row in found])) for side in ("before", "after"))
    )


def verdict(gained: float, on: str) -> str:
    """One sentence on a `gain`. on : what it was judged on."""
    if does_harm(gained):
        return f"harm: the 3D RMSE {gain_in_words(gained)} on {on}; do not use this map there"
    return f"{'better' if gained >= SMALLEST_GAIN else 'no gain'}: the 3D RMSE {gain_in_words(gained)} on {on}"


def does_harm(gained: float) -> bool:
    """Whether a `gain` is a loss, or no number."""
    return not gained > -SMALLEST_GAIN


def _side(figures: Mapping[str, float]) -> str:
    return "  " + "".join(
        f"{figures[name]:8.3f}" for name in ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "nees_mean")
    )
