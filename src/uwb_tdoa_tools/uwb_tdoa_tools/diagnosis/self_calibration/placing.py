"""Anchors of which nothing is known: placed from where the others say that the tag flew."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.smoother import smooth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.results import Odometry

MOST = 3000  # TDOAs of a flight that are used
FEWEST = 200
SCALE = 0.3  # m, beyond which a TDOA counts less
BEYOND = 1.0  # m, of the starts beyond the box of the other anchors
PLACED_STD = 0.5  # m, of what is found, for what follows


def place(
    flights: Sequence[Flight], rows: Sequence[int], config: FilterConfig | None = None
) -> Anchors:
    """Anchors of Flights with those of some rows placed, one after the other.

    Each TDOA between the anchor and one of the others is a hyperboloid about where the tag was;
    robust least squares over all of them, started from the corners of the room. Raises InputError
    where too few determine it.
    """
    anchors = flights[0].anchors
    known = np.setdiff1d(np.arange(len(anchors)), rows)
    positions = anchors.positions.copy()
    paths = [smooth(flight.among(known).without("truth"), config).odometry for flight in flights]
    low, high = positions[known].min(axis=0) - BEYOND, positions[known].max(axis=0) + BEYOND
    for row in rows:
        parts = [
            _distances(flight, path, row, known, positions) for flight, path in zip(flights, paths)
        ]
        p, to = (np.concatenate(some) for some in zip(*parts))
        if len(p) < FEWEST:
            raise InputError(
                f"--unknown {anchors.ids[row]}: {len(p)} TDOAs tell of it, {FEWEST} are "
                "needed; record motion for longer."
            )

        def residual(x: np.ndarray, p: np.ndarray = p, to: np.ndarray = to) -> np.ndarray:
            return np.linalg.norm(p - x, axis=1) - to

        starts = itertools.product(*zip(low, high))
        found = [
            least_squares(
                residual, start, loss="soft_l1", f_scale=SCALE, bounds=(low - 5.0, high + 5.0)
            )
            for start in starts
        ]
        positions[row] = min(found, key=lambda one: one.cost).x
    return anchors.at(positions)


def _distances(
    flight: Flight, path: Odometry, row: int, known: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the tag was, (n, 3) m, and how far from the anchor of a row, (n,) m, as its TDOAs with
    known ones tell.
    """
    tdoa = flight.tdoa
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    inside = (tdoa.t > path.t[0]) & (tdoa.t < path.t[-1])
    chosen = np.flatnonzero(
        inside & (((a == row) & np.isin(b, known)) | ((b == row) & np.isin(a, known)))
    )
    chosen = chosen[:: max(1, len(chosen) // MOST)]
    p = np.stack([np.interp(tdoa.t[chosen], path.t, path.p[:, k]) for k in range(3)], axis=1)
    of_b = b[chosen] == row  # d = |x - p_b| - |x - p_a|
    other = positions[np.where(of_b, a[chosen], b[chosen])]
    return p, np.linalg.norm(p - other, axis=1) + np.where(of_b, 1.0, -1.0) * tdoa.d[chosen]
