# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test the hypothesis that a single anchor has moved, before its error is spread over all anchors.

The filter rejects TDOAs with large innovations. Equations about the given anchors then hold few
TDOAs of a moved anchor, and the other anchors absorb its shift. Therefore each anchor is placed
from the path that the others give, and the filter runs again. All innovations count, also rejected
ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError

from ...estimate import FlightEstimator
from ...scoring.metrics import has_innovation
from ...scoring.phases import AIRBORNE
from ..regression.fit import NU
from .placing import place

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ...parallel import MapFunction

# number of anchors that are calibrated as unknown: those with the best likelihood after placing
TRIED = 2


@dataclass(frozen=True)
class Misfit:
    """The negative log-likelihood of Flights under some anchors.

    flights, config : as of `self_calibrate`; scale : m, robust scale of the innovations
    count : number of innovations in each sum, since a diverged filter has fewer
    """

    flights: Sequence[Flight]
    config: FilterConfig
    scale: float
    count: int

    @classmethod
    def about(
        cls, flights: Sequence[Flight], config: FilterConfig, anchors: Anchors, effects: EffectSet
    ) -> tuple[Misfit, float]:
        """Return a Misfit with the scale of the innovations under Anchors and an EffectSet.

        Also return its value for them.
        """
        innovations = _innovations(flights, config, anchors, effects)
        scale = 1.4826 * float(np.median(np.abs(innovations))) if len(innovations) else 0.0
        made = cls(flights, config, max(scale, 1e-3), len(innovations))
        return made, made._of(innovations)

    def of(self, anchors: Anchors, effects: EffectSet) -> float:
        """Return the negative log-likelihood (Student's t) of all innovations in the air.

        It assumes independent innovations. The caller divides it by their variance inflation.
        """
        return self._of(_innovations(self.flights, self.config, anchors, effects))

    def _of(self, innovations: np.ndarray) -> float:
        if not len(innovations):
            return np.inf
        value = innovations / self.scale
        return float(0.5 * (NU + 1.0) * self.count * np.mean(np.log1p(value**2 / NU)))

    def suspects(
        self,
        effects: EffectSet,
        progress: Callable[[], object] = lambda: None,
        map_function: MapFunction = map,
    ) -> dict[int, Anchors]:
        """Return {row: placed Anchors} of the TRIED anchors with the best likelihood after placing.

        The best comes first. progress, map_function : as of `self_calibrate`
        """
        misfits: dict[int, float] = {}
        placed: dict[int, Anchors] = {}
        rows = range(len(self.flights[0].anchors))
        for row, one in enumerate(map_function(partial(_placed, self, effects), rows)):
            progress()
            if one is not None:
                placed[row], misfits[row] = one
        best = sorted(misfits, key=misfits.__getitem__)[:TRIED]
        return {row: placed[row] for row in best}


def _placed(misfit: Misfit, effects: EffectSet, row: int) -> tuple[Anchors, float] | None:
    """Return (Anchors with one row placed, their Misfit); None if too few TDOAs determine it."""
    try:
        placed = place(misfit.flights, [row], misfit.config)
    except InputError:
        return None
    return placed, misfit.of(placed, effects)


def _innovations(
    flights: Sequence[Flight], config: FilterConfig, anchors: Anchors, effects: EffectSet
) -> np.ndarray:
    """Return innovations of all TDOAs of Flights in the air, accepted or rejected, (n,) m."""
    out = []
    for flight in flights:
        run = FlightEstimator(config, effects)(replace(flight, anchors=anchors))
        t, odometry = run.residuals.t, run.odometry
        if not len(odometry):
            continue
        height = np.interp(t, odometry.t, odometry.p[:, 2])
        out.append(run.residuals.innovation[has_innovation(run.residuals) & (height > AIRBORNE)])
    return np.concatenate(out) if out else np.zeros(0)
