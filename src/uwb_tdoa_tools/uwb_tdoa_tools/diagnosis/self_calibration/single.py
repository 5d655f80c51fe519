# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Place anchors from the path that the others give, and test whether a single one has moved.

A single moved anchor is tested before its error is spread over all anchors. The filter rejects
TDOAs with large innovations. Equations about the given anchors then hold few TDOAs of a moved
anchor, and the other anchors absorb its shift. Therefore each anchor is placed from the path that
the others give, and the filter runs again. All innovations count, also rejected ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
import itertools

import numpy as np
from scipy.optimize import least_squares

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.results import Odometry
from uwb_tdoa_ekf.smoother import smooth

from ...estimate import FlightEstimator
from ...parallel import MapFunction
from ...scoring.metrics import has_innovation
from ...scoring.phases import AIRBORNE
from ..regression.fit import NU

# number of anchors that are calibrated as unknown: those with the best likelihood after placing
TRIED = 2
# number of TDOAs of a flight and an anchor; of more, every second, third, ... is used
MOST = 3000
FEWEST = 200  # fewest TDOAs of all flights that place an anchor
SCALE = 0.3  # m, scale of the robust loss
BEYOND = 1.0  # m, from the box of the known anchors to the starting points
BOUND = 5.0  # m, from the starting points to the limits of the search
# m, prior standard deviation of a placed coordinate in the calibration that follows
PLACED_STD = 0.5


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
        for row, result in enumerate(map_function(partial(_placed, self, effects), rows)):
            progress()
            if result is not None:  # enough TDOAs determine this anchor
                placed[row], misfits[row] = result
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


def place(
    flights: Sequence[Flight], rows: Sequence[int], config: FilterConfig | None = None
) -> Anchors:
    """Return the Anchors of Flights with some of them placed, each from the known anchors alone.

    The known anchors give the path of the tag. Then each TDOA between the new and a known anchor is
    a distance from the tag to the new anchor. Robust least squares over all distances starts at the
    corners of the box of the known anchors, enlarged by BEYOND. Raises InputError if fewer than
    FEWEST TDOAs determine an anchor.

    flights : they have the same Anchors; rows : of the unknown anchors
    """
    anchors = flights[0].anchors
    known = np.setdiff1d(np.arange(len(anchors)), rows)
    positions = anchors.positions.copy()
    low, high = positions[known].min(axis=0) - BEYOND, positions[known].max(axis=0) + BEYOND
    for row, (tag, distance) in zip(rows, _distances(flights, rows, config)):
        if len(tag) < FEWEST:
            raise InputError(
                f"--unknown {anchors.ids[row]}: {len(tag)} TDOAs tell of it, {FEWEST} are "
                "needed; record motion for longer."
            )

        def residual(x: np.ndarray) -> np.ndarray:
            return np.linalg.norm(tag - x, axis=1) - distance

        starts = itertools.product(*zip(low, high))
        found = [
            least_squares(
                residual, start, loss="soft_l1", f_scale=SCALE, bounds=(low - BOUND, high + BOUND)
            )
            for start in starts
        ]
        positions[row] = min(found, key=lambda one: one.cost).x
    return anchors.at(positions)


def lateness(flights: Sequence[Flight], row: int, config: FilterConfig | None = None) -> float:
    """Return by how much an anchor is late at its given place, m, on the path by the others."""
    ((tag, distance),) = _distances(flights, [row], config)
    return float(
        np.median(distance - np.linalg.norm(tag - flights[0].anchors.positions[row], axis=1))
    )


def _distances(
    flights: Sequence[Flight], rows: Sequence[int], config: FilterConfig | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the return value of `_of_flight` for each row, of all Flights together.

    The other anchors give the path. The ground truth is not read.
    """
    anchors = flights[0].anchors
    known = np.setdiff1d(np.arange(len(anchors)), rows)
    paths = [smooth(flight.among(known).without("truth"), config).odometry for flight in flights]
    for row in rows:
        parts = [
            _of_flight(flight, path, row, known, anchors.positions)
            for flight, path in zip(flights, paths)
        ]
        tag, distance = (np.concatenate(arrays) for arrays in zip(*parts))
        yield tag, distance


def _of_flight(
    flight: Flight, path: Odometry, row: int, known: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of the tag, (n, 3) m, and measured distances to the anchor `row`, (n,) m.

    The path comes from the smoother. Each distance is a TDOA with a known anchor plus the distance to
    that known anchor.

    known : rows of the known anchors; positions : (N, 3) m, world
    """
    tdoa = flight.tdoa
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    inside = (tdoa.t > path.t[0]) & (tdoa.t < path.t[-1])
    chosen = np.flatnonzero(
        inside & (((a == row) & np.isin(b, known)) | ((b == row) & np.isin(a, known)))
    )
    chosen = chosen[:: max(1, len(chosen) // MOST)]
    p = np.stack([np.interp(tdoa.t[chosen], path.t, path.p[:, k]) for k in range(3)], axis=1)
    row_is_b = b[chosen] == row  # d = |x - p_b| - |x - p_a|
    other = positions[np.where(row_is_b, a[chosen], b[chosen])]
    return p, np.linalg.norm(p - other, axis=1) + np.where(row_is_b, 1.0, -1.0) * tdoa.d[chosen]
