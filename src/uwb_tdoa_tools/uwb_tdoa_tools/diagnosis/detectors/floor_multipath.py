"""Which anchors are late near the floor, and below which height."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls

from uwb_tdoa_bias.effects import EFFECTS

from ...checking.pair_rules import MANY
from ..regression.terms import Candidate, Term
from .base import Detector

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ..channels.tdoa import TdoaResidual
    from ..regression.fit import Fit
    from ..regression.table import RegressionTable

NEAR = 0.4  # m above z = 0; higher up nobody has seen it
HEIGHTS = np.geomspace(0.05, 0.3, 12)  # m, that are tried
SWEEPS = 2  # over the anchors, each of which then gets a height of its own
FEWEST, FEWEST_ROWS = 2, 20  # anchors that are late: one alone is blocked; rows near the floor
ONE_PLACE = 0.5  # m about which it took off and landed
LEAST, GOOD_PART = (
    0.5,
    0.5,
)  # m, and share of the largest, by which those are late that come into the model first
SCALE, NU = (
    0.2,
    4.0,
)  # m, of Student's t: of what is left of an anchor that is late by several echoes in turn
ITERATIONS = 8
LITTLE = 1e-3  # information, 1/m^2, that an anchor is on time: what all share is not seen
LEAST_NOISE, WILD = 0.2, 3.0  # m: less is that of any anchor, more an outlier
ENOUGH = 5.0  # TDOAs, that count as often as they are


class FloorMultipathDetector(Detector):
    """Fits a delay of every anchor at once, below one height or each below its own. Those that are
    late by much, two at least, come into the model first, the others then.
    """

    effect = EFFECTS["floor_multipath"]
    on_floor = True

    def search(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
    ) -> list[Candidate]:
        parts = table.tdoa_parts
        rows = table.rows_of("tdoa")
        place = table.place[rows]
        low = np.flatnonzero(place[:, 2] < NEAR)
        if len(low) < FEWEST_ROWS or any(part.innovations is not None for part in parts):
            return []  # it was not there, or nobody knows where it was
        ids = parts[0].samples.anchors.ids.tolist()
        mine = {
            key
            for candidate in chosen
            if candidate.name == self.effect.name
            for key in candidate.terms[0].keys
        }
        heard = (
            np.unique(parts[0].arrivals(table.series[rows][low]))
            if len(ids) > MANY
            else np.arange(len(ids))
        )
        new = [k for k in heard.tolist() if f"{ids[k]}.delay" not in mine]
        if not new:
            return []
        lowest = place[low[place[low, 2] < max(HEIGHTS[0], 2.0 * place[low, 2].min())], :2]
        middle = np.median(lowest, axis=0)
        one_place = np.hypot(*(lowest - middle).T).max() < ONE_PLACE
        where = (
            dict(zip("xy", middle.tolist())) if one_place else {}
        )  # seen at several places, it may be like that at others
        columns = [
            np.concatenate([_below(height, part, new) for part in parts])[low] for height in HEIGHTS
        ]
        trials = _Trials(np.stack(columns), model.residual[rows][low], table.count[rows][low])
        delays, at = trials.best()
        late = delays > (self.effect.negligible if mine else max(LEAST, GOOD_PART * delays.max()))
        late &= HEIGHTS[at] < HEIGHTS[-1]  # what goes on higher up is not of the floor
        if late.sum() < (1 if mine else FEWEST):
            return []
        some = [ids[new[k]] for k in np.flatnonzero(late)]
        limits = {f"{i}.height": float(HEIGHTS[k]) for i, k in zip(some, at[late])}
        limits |= {
            f"{i}.noise": float(std)
            for i, std in zip(some, trials.noises(at)[late])
            if std > LEAST_NOISE
        }
        term = Term(
            self.effect({**limits, **where}, source="diagnose"), tuple(f"{i}.delay" for i in some)
        )
        return [Candidate((term,), 2.0 * np.log(len(HEIGHTS)) * len(some))]


def _below(height: float, part: TdoaResidual, anchors: Sequence[int]) -> np.ndarray:
    """What a delay of each of some anchors, by their rows, adds to the rows of a TdoaResidual if it
    is late below a height, m, and never above: (n, anchors). A row of which nobody knows whether it
    is late would fit neither.
    """
    samples, low = part.samples, part.samples.p[:, 2] < height
    return np.stack(
        [part.cells.mean(low * (1.0 * (samples.b == k) - (samples.a == k))) for k in anchors],
        axis=1,
    )


class _Trials:
    """Delays of anchors in a residual (n,), m, of so many TDOAs (n,) each, below one of the heights
    of columns (heights, n, anchors).
    """

    def __init__(self, columns: np.ndarray, residual: np.ndarray, count: np.ndarray) -> None:
        self._columns, self._y, self._count = columns, residual, np.minimum(count, ENOUGH)
        self._fits: dict[
            bytes, tuple[float, np.ndarray]
        ] = {}  # by places: a search comes to the same ones again

    def best(self) -> tuple[np.ndarray, np.ndarray]:
        """(delays (anchors,) m, places of the heights (anchors,))."""
        count = self._columns.shape[2]
        at = self._best(np.full(count, k) for k in range(len(self._columns)))
        for _ in range(SWEEPS):
            for anchor in range(count):
                tried = np.repeat(at[None], len(self._columns), axis=0)
                tried[:, anchor] = range(len(tried))
                at = self._best(tried)
        return self._fit(at)[1], at

    def _best(self, tried: Iterable[np.ndarray]) -> np.ndarray:
        return min(tried, key=lambda at: self._fit(at)[0])

    def noises(self, at: np.ndarray) -> np.ndarray:
        """(anchors,) m: standard deviation of what is left of each while it is late."""
        x = self._columns[at, :, np.arange(len(at))].T
        power = np.minimum(np.abs(self._y - x @ self._fit(at)[1]), WILD) ** 2
        root, both = np.sqrt(self._count), np.hstack([x**2, np.ones((len(x), 1))])
        return np.sqrt(nnls(root[:, None] * both, root * power)[0][:-1])

    def _fit(self, at: np.ndarray) -> tuple[float, np.ndarray]:
        """(loss, delays) of robust least squares.

        None is early: else those that are on time could be, and the others not late.
        """
        key = at.tobytes()
        if key not in self._fits:
            self._fits[key] = self._fitted(at)
        return self._fits[key]

    def _fitted(self, at: np.ndarray) -> tuple[float, np.ndarray]:
        x, weight = self._columns[at, :, np.arange(len(at))].T, self._count
        for _ in range(ITERATIONS):
            root = np.linalg.cholesky((x * weight[:, None]).T @ x + LITTLE * np.eye(x.shape[1])).T
            beta = nnls(root, np.linalg.solve(root.T, x.T @ (weight * self._y)))[0]
            off = (self._y - x @ beta) / SCALE
            weight = self._count * (NU + 1.0) / (NU + off**2)
        return float(self._count @ np.log1p(off**2 / NU)), beta
