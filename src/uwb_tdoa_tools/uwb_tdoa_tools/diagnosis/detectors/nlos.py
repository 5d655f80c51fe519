"""An anchor that was blocked for a while, or from a region."""

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from ..regression.terms import Candidate, Term
from .base import Detector
from .intervals import LEAST_GAIN, LONGEST, best_interval

RADII = (0.6, 1.0, 1.5)  # m
CENTRES = 60
PRIOR = 4.0  # information, 1/m^2, of what delays are plausible


class NlosDetector(Detector):
    """Tries every anchor over all intervals of one flight, and over spheres about places that were flown."""

    effect = EFFECTS["nlos"]

    def search(self, table, model, chosen):
        rows = table.rows_of("tdoa")
        part = next(part for _, channel, _, part in table.parts if channel == "tdoa")
        a, b = part.arrivals(table.series[rows])
        information, residual = model.information(table)[rows], model.residual[rows]
        keys = {key for candidate in chosen if candidate.name == self.effect.name for key in candidate.terms[0].keys}
        out = []
        for row, anchor in enumerate(part.samples.anchors.ids.tolist()):
            key = f"{anchor}.delay"
            if key in keys:
                continue
            x = 1.0 * (b == row) - 1.0 * (a == row)
            score, power = x * information * residual, x * x * information
            searches = [_region(table.place[rows], score, power)]
            if table.flights == 1:  # only a flight alone has a time of its own
                searches.append(best_interval(table.t[rows], score, power, PRIOR))
            for gain, limits, price in searches:
                if gain > LEAST_GAIN:
                    values = {f"{anchor}.{name}": value for name, value in limits.items()}
                    out.append(Candidate((Term(self.effect(values, source="diagnose"), (key,)),), price))
        return out


def _region(place, score, power):
    """Best (gain, {limit: value}, price of the search) over spheres."""
    centres = place[:: max(1, len(place) // CENTRES)]
    away = np.linalg.norm(place[None] - centres[:, None], axis=2)
    best, limits = 0.0, {}
    for radius in RADII:
        inside = away <= radius
        gain = np.maximum(inside @ score, 0.0) ** 2 / (inside @ power + PRIOR)
        gain[inside.mean(axis=1) > LONGEST] = 0.0
        k = int(np.argmax(gain))
        if gain[k] > best:
            best, limits = gain[k], {**dict(zip("xyz", centres[k].tolist())), "radius": radius}
    return best, limits, 2.0 * np.log(len(centres) * len(RADII))
