"""An anchor that was blocked for a while, or from a region."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.distance import cdist

from uwb_tdoa_bias.effects import EFFECTS

from ..regression.terms import Candidate, Term
from .base import Detector
from .intervals import LEAST_GAIN, LONGEST, best_interval

if TYPE_CHECKING:
    from collections.abc import Sequence
    from ..regression.fit import Fit
    from ..regression.table import Table

RADII = (0.6, 1.0, 1.5)  # m
CENTRES = 60
PRIOR = 4.0  # information, 1/m^2, of what delays are plausible


class NlosDetector(Detector):
    """Tries every anchor over all intervals of one flight, and over spheres about places that were flown."""

    effect = EFFECTS["nlos"]

    def search(self, table: Table, model: Fit, chosen: Sequence[Candidate]) -> list[Candidate]:
        rows = table.rows_of("tdoa")
        part = table.tdoa_parts[0]
        a, b = part.arrivals(table.series[rows])
        information, residual = model.information(table)[rows], model.residual[rows]
        keys = {key for candidate in chosen if candidate.name == self.effect.name for key in candidate.terms[0].keys}
        spheres, out = _Spheres(table.place[rows]), []
        for row, anchor in enumerate(part.samples.anchors.ids.tolist()):
            key = f"{anchor}.delay"
            if key in keys:
                continue
            heard = np.flatnonzero((b == row) | (a == row))
            if not len(heard):
                continue
            x = 1.0 * (b[heard] == row) - 1.0 * (a[heard] == row)
            score, power = x * information[heard] * residual[heard], x * x * information[heard]
            searches = [spheres.best(score, power, heard)]
            if table.flights == 1:  # only a flight alone has a time of its own
                searches.append(best_interval(table.t[rows], score, power, PRIOR, rows=heard))
            for gain, limits, price in searches:
                if gain > LEAST_GAIN:
                    values = {f"{anchor}.{name}": value for name, value in limits.items()}
                    out.append(Candidate((Term(self.effect(values, source="diagnose"), (key,)),), price))
        return out


class _Spheres:
    """Spheres about some of the places (n, 3) m that were flown; the same for every anchor, so found once."""

    def __init__(self, place: np.ndarray) -> None:
        self._centres = place[:: max(1, len(place) // CENTRES)]
        away = cdist(self._centres, place)
        self._inside = np.concatenate([away <= radius for radius in RADII]).astype(float)  # all of a radius after the other
        self._constant = self._inside.mean(axis=1) > LONGEST

    def best(self, score: np.ndarray, power: np.ndarray, heard: np.ndarray) -> tuple[float, dict[str, float], float]:
        """Best (gain, {limit: value}, price of the search), as `best_interval`. score, power (m,) : of the places at `heard` (m,)."""
        score, power = (self._inside[:, heard] @ np.stack([score, power], axis=1)).T
        gain = np.where(self._constant, 0.0, np.maximum(score, 0.0) ** 2 / (power + PRIOR))
        best = int(np.argmax(gain))
        radius, centre = divmod(best, len(self._centres))
        limits = {**dict(zip("xyz", self._centres[centre].tolist())), "radius": RADII[radius]}
        return gain[best], limits, 2.0 * np.log(len(gain))
