# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detector of anchors that are late near the floor, and of the height below which they are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.optimize import nnls

from uwb_tdoa_bias.effects import EFFECTS

from ...checking.pair_rules import MANY
from ..channels.radio import TdoaResidual
from ..regression.fit import Fit
from ..regression.table import RegressionTable
from ..regression.terms import Candidate, Term
from .base import Detector

NEAR = 0.4  # m above z = 0; no flight showed the effect above
HEIGHTS = np.geomspace(0.05, 0.3, 12)  # m, limits that are tried
SWEEPS = 2  # sweeps over the anchors, to find one height per anchor
# fewest late anchors (a single anchor counts as blocked), and fewest rows near the floor
FEWEST, FEWEST_ROWS = 2, 20
ONE_PLACE = 0.5  # m, radius of a single place of take-off and landing
# smallest delay of the first anchors in a model: m, and share of the largest delay
LEAST, GOOD_PART = 0.5, 0.5
# scale in m and degrees of freedom of Student's t: an anchor with several echoes has heavy tails
SCALE, NU = 0.2, 4.0
ITERATIONS = 8  # of the re-weighted least squares
LITTLE = 1e-3  # information, 1/m^2, of a delay of 0: TDOAs do not show a common delay
# m: noise below the first is normal, a residual beyond the second is an outlier
LEAST_NOISE, WILD = 0.2, 3.0
ENOUGH = 5.0  # largest weight of a row, in TDOAs


class FloorMultipathDetector(Detector):
    """Fit delays of all anchors, below one height, then below one height per anchor.

    Anchors with a large delay, two at least, enter the model first, the others afterwards.
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
            return []  # no data near the floor, or no known height
        ids = parts[0].samples.anchors.ids.tolist()
        mine = self.keys_chosen(chosen)
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
        where = dict(zip("xy", middle.tolist())) if one_place else {}  # else it may hold anywhere
        columns = [
            np.concatenate([_below(height, part, new) for part in parts])[low] for height in HEIGHTS
        ]
        trials = _Trials(np.stack(columns), model.residual[rows][low], table.count[rows][low])
        delays, at = trials.best()
        late = delays > (
            self.effect.row.negligible if mine else max(LEAST, GOOD_PART * delays.max())
        )
        late &= HEIGHTS[at] < HEIGHTS[-1]  # an effect above is not of the floor
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
    """Return regressors of delays of anchors, by their rows, below a height, m: (n, anchors)."""
    samples, low = part.samples, part.samples.p[:, 2] < height
    return np.stack(
        [part.cells.mean(low * (1.0 * (samples.b == k) - (samples.a == k))) for k in anchors],
        axis=1,
    )


class _Trials:
    """Robust fits of delays of anchors to a residual, for heights below which they are late.

    columns : (heights, n, anchors) regressors; residual : (n,) m; count : (n,) TDOAs of a row
    """

    def __init__(self, columns: np.ndarray, residual: np.ndarray, count: np.ndarray) -> None:
        self._columns = columns
        self._y = residual
        self._count = np.minimum(count, ENOUGH)

    def best(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (delays (anchors,) m, indices of the heights (anchors,)) of the least loss found.

        The search starts with the best height for all anchors. Each sweep then tries all heights for
        one anchor after the other.
        """
        heights, _, anchors = self._columns.shape
        at = self._least_loss(np.full(anchors, height) for height in range(heights))
        for _ in range(SWEEPS):
            for anchor in range(anchors):
                tried = np.repeat(at[None], heights, axis=0)
                tried[:, anchor] = range(heights)
                at = self._least_loss(tried)
        return self._fit(at)[1], at

    def _least_loss(self, tried: Iterable[np.ndarray]) -> np.ndarray:
        return min(tried, key=lambda at: self._fit(at)[0])

    def noises(self, at: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the residual of each late anchor, (anchors,) m."""
        x = self._columns[at, :, np.arange(len(at))].T
        power = np.minimum(np.abs(self._y - x @ self._fit(at)[1]), WILD) ** 2
        root, both = np.sqrt(self._count), np.hstack([x**2, np.ones((len(x), 1))])
        return np.sqrt(nnls(root[:, None] * both, root * power)[0][:-1])

    def _fit(self, at: np.ndarray) -> tuple[float, np.ndarray]:
        """Return (loss, delays (anchors,) m) of robust least squares with delays of 0 or more.

        at : (anchors,) index of the height of each anchor
        """
        x, weight = self._columns[at, :, np.arange(len(at))].T, self._count
        for _ in range(ITERATIONS):
            root = np.linalg.cholesky((x * weight[:, None]).T @ x + LITTLE * np.eye(x.shape[1])).T
            beta = nnls(root, np.linalg.solve(root.T, x.T @ (weight * self._y)))[0]
            off = (self._y - x @ beta) / SCALE
            weight = self._count * (NU + 1.0) / (NU + off**2)
        return float(self._count @ np.log1p(off**2 / NU)), beta
