"""Where one more anchor helps most: places that are tried on some cells, of which the best are
judged on the whole map that is printed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from .optimisation import BESIDE, with_one
from .places import spread
from .report import quantiles

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.anchors import Anchors

    from ..parallel import Progress
    from .judging import Judged
    from .maps import Chart

LOOKED_AT, VERIFIED = (
    600,
    4,
)  # cells that all places are tried on, and places that are judged on all cells
PRECISION = 0.2  # of the share of the room: what halving the bound is worth twice
WORTH, FINER = (
    0.01,
    0.05,
)  # share of the room, and of the bound: less than both is not worth an anchor


class Judge(Protocol):
    """Judged of points (n, 3) m with one more anchor at a place (3,) m. before : Judged without it.
    Raises InputError where there can be none.
    """

    def __call__(
        self, before: Judged, points: np.ndarray, anchors: Anchors, place: np.ndarray
    ) -> Judged: ...


def one_more(
    found: Chart, anchors: Anchors, places: np.ndarray, judge: Judge, progress: Progress
) -> dict[str, Any] | None:
    """What one more anchor gains at the best of some places (m, 3) m; None where none gains WORTH
    or FINER.

    Returns {"position" (3,) m, "flyable_share", "bound_flyable": quantiles, m, as of a plan with
    it; "gain": share of the cells; "bound_before", "bound_after": m, median where it can be flown
    without it}. found : Chart of Anchors.
    """
    points = found.grid.points
    away = np.linalg.norm(places[:, None] - anchors.positions, axis=2).min(axis=1)
    places = places[away >= BESIDE]
    rows = (
        np.sort(spread(points, LOOKED_AT)) if len(points) <= 4 * LOOKED_AT else _some(len(points))
    )
    some, before = points[rows], found.part(rows)
    values = []
    for place in progress.over(places, what="places for one more anchor"):
        try:
            values.append(_value(before, judge(before, some, with_one(anchors, place), place)))
        except InputError:
            values.append(-np.inf)
    best: tuple[float, dict[str, Any]] | None = None
    for number in np.argsort(-np.array(values), kind="stable")[:VERIFIED]:
        if (
            best is not None and values[number] <= best[0]
        ):  # the others promise no more than this one gives
            break
        if not np.isfinite(values[number]):
            continue
        progress("judging the best place on the whole map")
        after = judge(found, points, with_one(anchors, places[number]), places[number])
        if best is None or _value(found, after) > best[0]:
            best = _value(found, after), _told(found, after, places[number])
    return best[1] if best and worth(best[1]) else None


def worth(told: dict[str, Any]) -> bool:
    """Whether what `one_more` found gains enough."""
    finer = 1.0 - told["bound_after"] / told["bound_before"] if told["bound_before"] else 0.0
    return told["gain"] >= WORTH or finer >= FINER


def _some(count: int) -> np.ndarray:
    """LOOKED_AT of `count` rows, in order."""
    return np.sort(np.random.default_rng(0).permutation(count)[:LOOKED_AT])


def _value(before: Judged, after: Judged) -> float:
    """What an anchor gains: share of the cells, and precision where it could be flown before."""
    told = _told(before, after, np.zeros(3))
    finer = 1.0 - told["bound_after"] / told["bound_before"] if told["bound_before"] else 0.0
    return told["gain"] + PRECISION * finer


def _told(before: Judged, after: Judged, place: np.ndarray) -> dict[str, Any]:
    flown = before.flyable
    medians = [
        float(np.median(one.error[flown])) if flown.any() else None for one in (before, after)
    ]
    return {
        "position": place.tolist(),
        "flyable_share": float(after.flyable.mean()),
        "bound_flyable": quantiles(after.error[after.flyable]),
        "gain": float(after.flyable.mean() - before.flyable.mean()),
        "bound_before": medians[0],
        "bound_after": medians[1],
    }
