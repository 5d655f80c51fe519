"""TDOAs of a flight beside what the geometry of its ground truth says, pair by pair."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EffectSet, Track, true_samples
from uwb_tdoa_bias.foundation.geometry import tdoa

if TYPE_CHECKING:
    from uwb_tdoa_bias.effects import LabelEffect
    from uwb_tdoa_bias.foundation.flight import Flight, Truth

AIRBORNE = 0.3  # m of z
# anchors, beyond which a tag hears a small part of them: a hall, most of which has nothing to do
# with any of them
MANY = 64
FEWEST = 40  # TDOAs of a pair in the air, or of a vehicle that never is, of which something is said


def least_height(truth: Truth) -> float:
    """z, m, above which what is measured beside a Truth counts: 0.3, or minus infinity for a
    vehicle that never leaves the floor.
    """
    return AIRBORNE if (truth.p[:, 2] > AIRBORNE).any() else -np.inf


class KnownPath:
    """d, true (n,) m, t (n,) s: the usable TDOAs and what they should be; samples : Samples; ids
    (N,); track : Track of the truth;
    start : s, stamp of the first TDOA; pairs {(a, b) ids: rows (k,)} of those in the air, of a
        vehicle that
    never is of all, that are often heard.
    """

    def __init__(self, flight: Flight) -> None:
        """flight : Flight with ground truth."""
        assert flight.truth is not None
        self._flight = flight
        self.samples, rows = true_samples(flight)
        self.t, self.d = self.samples.t, flight.tdoa.d[rows]
        self.true = tdoa(self.samples.p, self.samples.position_a, self.samples.position_b)
        self.ids, self.track, self.start = (
            self.samples.anchors.ids,
            Track(flight.truth),
            flight.start,
        )
        self.flown = np.flatnonzero(self.samples.p[:, 2] > least_height(flight.truth))
        key = (self.samples.a * len(self.ids) + self.samples.b)[self.flown]
        order = np.argsort(key, kind="stable")
        parts = (
            np.split(self.flown[order], np.flatnonzero(np.diff(key[order])) + 1)
            if len(order)
            else []
        )
        self.pairs = {self._named(part[0]): part for part in parts if len(part) >= FEWEST}

    def without(self, *effects: LabelEffect) -> KnownPath:
        """The same without some LabelEffects."""
        return KnownPath(EffectSet(effects).correct_streams(self._flight))

    def _named(self, row: int) -> tuple[int, int]:
        return int(self.ids[self.samples.a[row]]), int(self.ids[self.samples.b[row]])
