# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detector of anchors that were blocked during an interval or from a region."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.spatial import cKDTree

from uwb_tdoa_bias.effects import EFFECTS

from ..regression.fit import Fit
from ..regression.table import RegressionTable
from ..regression.terms import Candidate, Term
from .auxiliary import LEAST_GAIN, LONGEST, best_interval
from .base import Detector

RADII = (0.6, 1.0, 1.5)  # m, radii of spheres that are tried
CENTRES = 60  # approximate number of centres of spheres
PRIOR = 4.0  # information, 1/m^2, of the prior of a delay


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
