# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find anchors that were blocked during an interval or from a region, and that switch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.sparse import csc_array, csr_array
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import EFFECTS, SmoothTerm

from ..channels import TdoaResidual
from ..regression.fit import Fit
from ..regression.table import RegressionTable
from ..regression.terms import Candidate, Term
from .auxiliary import LEAST_GAIN, LONGEST, best_interval
from .base import Detector

RADII = (0.6, 1.0, 1.5)  # m, radii of spheres that are tried
CENTRES = 60  # approximate number of centres of spheres
PRIOR = 4.0  # information, 1/m^2, of the prior of a delay
# s, shortest time for which the lateness of each anchor is estimated, and TDOAs of each anchor in it
STEP, OF_EACH = 0.1, 6
HUBER, ROUNDS = 0.3, 4  # m, limit of a residual with full weight, and number of weighted fits
# Two levels are APART times the spread around them. The levels of a normal distribution are 2.7
# times it apart, those of a wave 4.1 times.
# LEAST_SWITCHES: fewer are intervals. RARE: smallest share of the time at a level.
APART, LEAST_SWITCHES, RARE = 6.0, 4, 0.05
# Two times of one place: largest distance, m, and of one direction in the tag; shortest time between
# them, s; FEWEST such pairs for each time
NEAR, ALIKE, APART_IN_TIME, FEWEST = 0.4, 0.2, 3.0, 0.1
# Above this agreement of their levels beyond chance (Cohen's kappa), the level follows the place, or
# the direction, which another flight has too. It is 0.37 to 0.46 and more for obstacles of measured
# flights.
OF_PLACE, OF_DIRECTION = 0.25, 0.5


class NlosDetector(Detector):
    """Search over anchors, intervals of one flight, and spheres around flown positions."""

    effect = EFFECTS["nlos"]

    def search(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
    ) -> list[Candidate]:
        rows = table.rows_of("tdoa")
        part = table.tdoa_parts[0]
        a, b = part.arrivals(table.series[rows])
        information, residual = model.information(table)[rows], model.residual[rows]
        keys = self.keys_chosen(chosen)
        spheres, out, anchors = _Spheres(table.place[rows]), [], len(part.samples.anchors)
        heard = csr_array(  # (n, anchors): 1 for the second anchor of a TDOA, -1 for the first
            (
                np.repeat([-1.0, 1.0], len(a)),
                (np.tile(np.arange(len(a)), 2), np.concatenate([a, b])),
            ),
            shape=(len(a), anchors),
        ).tocsc()
        in_spheres = spheres.best(heard, information, residual)
        for row, anchor in enumerate(part.samples.anchors.ids.tolist()):
            key, its = f"{anchor}.delay", slice(*heard.indptr[row : row + 2])
            if key in keys or its.start == its.stop:
                continue
            searches, at, x = [in_spheres[row]], heard.indices[its], heard.data[its]
            if table.flights == 1:  # flights share no time
                score, power = x * information[at] * residual[at], x * x * information[at]
                searches.append(best_interval(table.t[rows], score, power, PRIOR, rows=at))
            for gain, limits, price in searches:
                if gain > LEAST_GAIN:
                    values = {f"{anchor}.{name}": value for name, value in limits.items()}
                    out.append(
                        Candidate((Term(self.effect(values, source="diagnose"), (key,)),), price)
                    )
        return out


def switching(parts: Sequence[TdoaResidual]) -> list[list[Candidate]]:
    """Return, for each flight, a Candidate of each anchor that switches between two levels.

    It does so at times of its own: the level follows neither the place nor the direction in the
    tag, as far as the flights return there.

    parts : residuals of TDOAs, of one flight each, with the same anchors
    """
    several = [_levels(part) for part in parts]
    own = set[int]()  # anchors whose levels follow nothing that flights share
    for row in set[int]().union(*several):
        told = [levels[row] for levels in several if row in levels]
        gap = max(one.gap for one in told)
        above, place, direction = (
            np.concatenate([getattr(one, name) for one in told])
            for name in ("above", "place", "direction")
        )
        if (
            _agreement(above, place, gap) < OF_PLACE
            and _agreement(above, direction, gap) < OF_DIRECTION
        ):
            own.add(row)
    return [
        [Candidate((one.term,)) for row, one in levels.items() if row in own] for levels in several
    ]


class _Levels(NamedTuple):
    """The two levels of an anchor in a flight.

    term : the function of the time; gap : as of `_agreement`
    above : (b,) 0 or 1; place, direction : (b, 3) in units of what counts as near
    """

    term: Term
    gap: float
    above: np.ndarray
    place: np.ndarray
    direction: np.ndarray


def _levels(part: TdoaResidual) -> dict[int, _Levels]:
    """Return {row of an anchor: its _Levels} of the anchors with two levels of lateness.

    part : residual of TDOAs of a single flight
    """
    samples, out = part.samples, dict[int, _Levels]()
    t, n = samples.t[part.fitted], len(samples.anchors)
    begin, step = t.min() - samples.start, max(STEP, OF_EACH * n * np.ptp(t) / len(t))
    at = ((t - t.min()) / step).astype(int)
    late, gap = _lateness(part, at), APART_IN_TIME / step
    first = np.searchsorted(at, np.arange(len(late)))  # stamps ascend
    place, turned = (value[part.fitted][first] for value in (samples.p, samples.q))
    known = np.linalg.norm(turned, axis=1)[:, None] > 0.5
    attitude = Rotation.from_quat(np.where(known, turned, [0.0, 0.0, 0.0, 1.0]))
    for row in np.flatnonzero(np.isfinite(late).sum(axis=0) > LEAST_SWITCHES).tolist():
        heard = np.flatnonzero(np.isfinite(late[:, row]))
        x, count = late[heard, row], np.arange(1, len(heard))
        level = np.sort(x).cumsum()
        low, high = level[:-1] / count, (level[-1] - level[:-1]) / count[::-1]
        between = count * count[::-1] * (high - low) ** 2 / len(x) ** 2  # Otsu, IEEE SMC 1979
        best = int(np.argmax(between))
        above = median_filter(1 * (x > 0.5 * (low[best] + high[best])), 3, mode="nearest")
        switches = heard[np.flatnonzero(np.diff(above, prepend=0))]
        if (
            high[best] - low[best] > APART * np.sqrt(max(np.var(x) - between[best], 0.0))
            and len(switches) >= LEAST_SWITCHES
            and RARE < above.mean() < 1.0 - RARE
        ):
            anchor = samples.anchors.positions[row]
            away = attitude[heard].apply(anchor - place[heard], inverse=True)
            away /= np.linalg.norm(away, axis=1)[:, None]
            knots = tuple((begin + step * np.array([-1, *switches, len(late)])).tolist())
            term = SmoothTerm(covariate="time", form="anchor", knots=knots, shape="switching")
            keys = term.keys_of((str(samples.anchors.ids[row]),))
            out[row] = _Levels(Term(term, keys), gap, above, place[heard] / NEAR, away / ALIKE)
    return out


def _agreement(level: np.ndarray, features: np.ndarray, gap: float) -> float:
    """Return by how much levels (b,), 0 or 1, agree beyond chance where features (b, k) are near.

    gap : smallest difference of the numbers of two levels that are compared
    """
    pairs = cKDTree(features).query_pairs(1.0, output_type="ndarray")
    one, other = level[pairs[np.abs(np.diff(pairs, axis=1)[:, 0]) > gap]].T
    if len(one) < FEWEST * len(level):  # a flight that does not return cannot tell
        return 1.0
    chance = 1.0 - one.mean() * (1.0 - other.mean()) - other.mean() * (1.0 - one.mean())
    return float((np.mean(one == other) - chance) / max(1.0 - chance, 1e-9))


def _lateness(part: TdoaResidual, step: np.ndarray) -> np.ndarray:
    """Return by how much each anchor is late in each step, compared with the median, (b, N) m.

    It is NaN where the anchor is not heard.

    step : (n,) number of the step of each fitted TDOA
    """
    samples, residual = part.samples, part.residual[part.fitted]
    a, b, n = samples.a[part.fitted], samples.b[part.fitted], len(samples.anchors)
    late = np.zeros((step.max() + 1, n))
    for _ in range(ROUNDS):
        left = residual - late[step, b] + late[step, a]
        weight = 1.0 / np.maximum(np.abs(left) / HUBER, 1.0)
        gram, vector = np.tile(np.eye(n), (len(late), 1, 1)), np.zeros_like(late)
        for first, second, sign in ((a, b, -1.0), (b, a, 1.0)):
            np.add.at(vector, (step, first), sign * weight * residual)
            np.add.at(gram, (step, first, first), weight)
            np.add.at(gram, (step, first, second), -weight)
        late = np.linalg.solve(gram, vector[..., None])[..., 0]
    late -= np.median(late, axis=1, keepdims=True)
    return np.where(np.diagonal(gram, axis1=1, axis2=2) > 1.0, late, np.nan)


class _Spheres:
    """Spheres around some of the flown positions (n, 3) m, the same for every anchor."""

    def __init__(self, place: np.ndarray) -> None:
        self._centres = place[:: max(1, len(place) // CENTRES)]
        tree, inside = cKDTree(place), []
        for radius in RADII:  # sorted by radius
            inside.extend(tree.query_ball_point(self._centres, radius, return_sorted=True))
        ends = np.cumsum([0, *map(len, inside)])
        rows = np.concatenate([np.asarray(some, int) for some in inside])
        self._inside = csr_array((np.ones(len(rows)), rows, ends), shape=(len(inside), len(place)))
        self._constant = np.diff(ends) / len(place) > LONGEST

    def best(
        self, heard: csc_array, information: np.ndarray, residual: np.ndarray
    ) -> list[tuple[float, dict[str, float], float]]:
        """Return the best (gain, {limit: value}, price of the search) of each anchor.

        heard : sparse (n, anchors), 1 and -1; information, residual : (n,)
        """
        inside = self._inside.multiply(information[None, :]).tocsr()
        score, power = inside.multiply(residual[None, :]).tocsr() @ heard, inside @ abs(heard)
        gain = np.maximum(score.toarray(), 0.0) ** 2 / (power.toarray() + PRIOR)
        gain[self._constant] = 0.0
        out, price = [], 2.0 * np.log(len(gain))
        for number, its in zip(np.argmax(gain, axis=0).tolist(), gain.T):
            radius, centre = divmod(number, len(self._centres))
            limits = {**dict(zip("xyz", self._centres[centre].tolist())), "radius": RADII[radius]}
            out.append((float(its[number]), limits, price))
        return out
