"""The failure map against brute force: solve with the TDOAs of every pairing, from many starts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .bifurcation import Subsets
from .maps import Grid
from .multistart import same_place, solutions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from .installation import Installation

    Wrap = Callable[
        [Iterable[Any]], Iterable[Any]
    ]  # gives the same items, and tells how many are done

ACROSS = {2: 40, 3: 10}  # places along the longest side of a slice, of a volume, at most
MOST_PAIRINGS = 8  # pairings that are solved, spread over all; each takes thousands of solutions
_BATCH = 200


def brute_force(
    installation: Installation, grid: Grid, progress: Wrap = iter
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Solve all over a grid for the pairings of an Installation, from many starts.

    Returns (unique (n,) bool: every pairing solved gave one position; agrees (n,) bool: each as
    predicted; points (n, 3) m; arrows ((m, 2), (m, 2)): some of the flips, from and to, within the
    grid).
    """
    subsets = Subsets(installation.anchors, installation.unknowns)
    extent = np.array(grid.shape) * grid.step
    across = min(ACROSS[3 if grid.shape[2] > 1 else 2], max(grid.shape))
    points = Grid.box(grid.lower, grid.lower + extent, extent.max() / across).points
    if grid.shape[2] == 1:
        points[:, 2] = grid.axes[2][0]
    row, subset, mirror = subsets.mirrors(points)
    other = ~same_place(
        points[row], mirror, installation.anchors.positions
    )  # on the lines through two anchors they meet
    predicted = np.ones((len(points), len(subsets.rows)), bool)
    predicted[row[other], subset[other]] = False
    chosen = np.unique(np.linspace(0, len(subsets.rows) - 1, MOST_PAIRINGS).astype(int))
    unique, agrees = np.ones(len(points), bool), np.ones(len(points), bool)
    for q in progress(chosen):
        corners = installation.anchors.positions[subsets.rows[q]]
        for rows in np.array_split(np.arange(len(points)), max(1, len(points) // _BATCH)):
            found = solutions(points[rows], corners, installation.unknowns)
            one = (np.isnan(found[..., 0]) | same_place(points[rows, None], found, corners)).all(
                axis=1
            )
            unique[rows] &= one
            agrees[rows] &= one == predicted[rows, q]
    near = np.flatnonzero(((mirror >= grid.lower) & (mirror <= grid.lower + extent)).all(axis=1))[
        ::37
    ]
    return unique, agrees, points, (points[row[near], :2], mirror[near, :2])
