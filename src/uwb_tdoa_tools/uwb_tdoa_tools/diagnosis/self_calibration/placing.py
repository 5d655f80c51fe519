# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Place anchors with unknown positions by TDOAs to known anchors along an estimated path."""

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

# number of TDOAs of a flight and an anchor; of more, every second, third, ... is used
MOST = 3000
FEWEST = 200  # fewest TDOAs of all flights that place an anchor
SCALE = 0.3  # m, scale of the robust loss
BEYOND = 1.0  # m, from the box of the known anchors to the starting points
BOUND = 5.0  # m, from the starting points to the limits of the search
# m, prior standard deviation of a placed coordinate in the calibration that follows
PLACED_STD = 0.5


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
    # the ground truth is not read
    paths = [smooth(flight.among(known).without("truth"), config).odometry for flight in flights]
    low, high = positions[known].min(axis=0) - BEYOND, positions[known].max(axis=0) + BEYOND
    for row in rows:
        parts = [
            _distances(flight, path, row, known, positions) for flight, path in zip(flights, paths)
        ]
        tag, distance = (np.concatenate(arrays) for arrays in zip(*parts))
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


def _distances(
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
    of_b = b[chosen] == row  # d = |x - p_b| - |x - p_a|
    other = positions[np.where(of_b, a[chosen], b[chosen])]
    return p, np.linalg.norm(p - other, axis=1) + np.where(of_b, 1.0, -1.0) * tdoa.d[chosen]
