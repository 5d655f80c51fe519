"""As much of a bias map as flights left out of it bear out, and the gain that can be expected of it."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from ..scoring.borne_out import SHARES, BorneOut, choose
from .evaluation import evaluate_map
from .mapping import fit_map

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from .evaluation import Estimator, Scored

FEWEST = 2  # flights; one alone leaves none to judge


def bear_out(
    flown: Sequence[Scored], static: Sequence[str | Path], estimator: Estimator, **options: Any
) -> BorneOut | None:
    """BorneOut of maps, each made without one of the flights that an Estimator gave and judged on it; None for fewer than
    FEWEST. static, options : as of `fit_map`."""
    if len(flown) < FEWEST:
        return None
    errors: dict[str, dict[float | None, float]] = {}
    for number, one in enumerate(flown, start=1):
        made = fit_map([other for other in flown if other is not one], static, estimator, **options)
        flight, score, _ = one
        name = flight.name if flight.name not in errors else f"{flight.name} ({number})"
        errors[name] = {None: score.row()["rmse_3d"]}
        for share in SHARES:
            errors[name][share] = evaluate_map(one, made.scaled(share), estimator.effects).row()["rmse_3d"]
    return BorneOut(choose(errors), errors)
