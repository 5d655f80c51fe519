"""One anchor that stands elsewhere, tried as such before its error is spread over all.

The filter rejects TDOAs that it does not explain. Equations about the anchors as given then hold
few TDOAs of a moved anchor, and the others share its shift. Each anchor is placed from the path
that the others give. The filter runs anew with it there. All its innovations count, those that it
rejects too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError

from ...estimate import FlightEstimator
from ...scoring.metrics import has_innovation
from ...scoring.phases import AIRBORNE
from ..regression.fit import NU
from .placing import place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.core.config import FilterConfig

TRIED = 2  # anchors that explain the most once they are placed; each is then calibrated as unknown


@dataclass(frozen=True)
class Misfit:
    """How badly the filter explains Flights with some anchors.

    flights, config : as of `self_calibrate`; scale : m, of an innovation that is explained; count :
    innovations that each sum stands for, since a lost filter has fewer.
    """

    flights: Sequence[Flight]
    config: FilterConfig
    scale: float
    count: int

    @classmethod
    def about(
        cls, flights: Sequence[Flight], config: FilterConfig, anchors: Anchors, effects: EffectSet
    ) -> Misfit:
        """Take the scale from the innovations with Anchors and an EffectSet."""
        innovations = _innovations(flights, config, anchors, effects)
        scale = 1.4826 * float(np.median(np.abs(innovations))) if len(innovations) else 0.0
        return cls(flights, config, max(scale, 1e-3), len(innovations))

    def of(self, anchors: Anchors, effects: EffectSet) -> float:
        """Return minus the logarithm of the likelihood of all innovations in the air (Student t).

        Innovations of one filter are independent if the anchors are right; the caller divides by
        how alike they are.
        """
        value = _innovations(self.flights, self.config, anchors, effects) / self.scale
        if not len(value):
            return np.inf
        return float(0.5 * (NU + 1.0) * self.count * np.mean(np.log1p(value**2 / NU)))

    def suspects(self, effects: EffectSet) -> list[int]:
        """Rows of the TRIED anchors that explain the most if they stand elsewhere, best first."""
        misfits = {}
        for row in range(len(self.flights[0].anchors)):
            try:
                placed = place(self.flights, [row], self.config)
            except InputError:  # too few TDOAs tell of it
                continue
            misfits[row] = self.of(placed, effects)
        return sorted(misfits, key=misfits.__getitem__)[:TRIED]


def _innovations(
    flights: Sequence[Flight], config: FilterConfig, anchors: Anchors, effects: EffectSet
) -> np.ndarray:
    """Innovations of the TDOAs of Flights in the air, (n,) m, accepted or not."""
    out = []
    for flight in flights:
        run = FlightEstimator(config, effects)(replace(flight, anchors=anchors))
        t, odometry = run.residuals.t, run.odometry
        if not len(odometry):
            continue
        height = np.interp(t, odometry.t, odometry.p[:, 2])
        out.append(run.residuals.innovation[has_innovation(run.residuals) & (height > AIRBORNE)])
    return np.concatenate(out) if out else np.zeros(0)
