"""Precision and failure over a slice or a volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flyable import FlyableVolume

from .bifurcation import Subsets
from .precision import bound, dilution, information, position_error

if TYPE_CHECKING:
    from collections.abc import Sequence
    from numpy.typing import ArrayLike
    from uwb_tdoa_bias.foundation.anchors import Anchors
    from .installation import Installation

MOST_CELLS = 4_000_000
FLYABLE = {  # criteria for what is flyable inside the hull
    "pairings": "every pairing of k + 1 anchors alone has one solution (Grasso et al., sec. 2.3.2)",
    "round": "all TDOAs of a round together tell the tag from every mirrored position",
}


@dataclass(frozen=True)
class Grid:
    """Cubes side by side. lower (3,) corner of the first, m; step: size of a cube, m; shape (nx, ny, nz)."""

    lower: np.ndarray
    step: float
    shape: tuple[int, int, int]

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike, step: float) -> Grid:
        """Cubes of `step` m that cover the box from lower (3,) to upper (3,), m. Raises InputError."""
        lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        if not 0.0 < step < np.inf:
            raise InputError(f"step: {step!r} m is not the size of a cell; give one above 0, e.g. 0.1.")
        if not (upper > lower).all():
            raise InputError(
                f"room: {lower.tolist()} to {upper.tolist()} m is empty; give X0 X1 Y0 Y1 (Z0 Z1), each rising."
            )
        shape = np.ceil((upper - lower) / step - 1e-6)
        if np.prod(shape) > MOST_CELLS:
            raise InputError(
                f"step: {step:g} m makes {np.prod(shape):.0f} cells, more than {MOST_CELLS}; take it larger."
            )
        return cls(0.5 * (lower + upper - step * shape), float(step), tuple(shape.astype(int).tolist()))

    @classmethod
    def slice(cls, x: Sequence[float], y: Sequence[float], height: float, step: float) -> Grid:
        """One layer of cells, centred on `height`, m; x and y: (lower, upper), m."""
        return cls.box((x[0], y[0], height - 0.5 * step), (x[1], y[1], height + 0.5 * step), step)

    @property
    def axes(self) -> list[np.ndarray]:
        """Centres of the cells along x, y and z, m."""
        return [low + self.step * (np.arange(n) + 0.5) for low, n in zip(self.lower, self.shape)]

    @property
    def points(self) -> np.ndarray:
        """Centres of the cells: (nx ny nz, 3) m, z running fastest."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def layer(self, values: np.ndarray, k: int) -> np.ndarray:
        """The layer k of values (n, ...) of all cells, to draw: (ny, nx, ...)."""
        return values.reshape(*self.shape, *values.shape[1:])[:, :, k].swapaxes(0, 1)


@dataclass(frozen=True)
class Chart:
    """What is true at every cell of a grid. n is the number of cells, k the dimensions of the installation.

    grid : Grid
    covariance : (n, k, k) m^2, the Cramer-Rao bound of one round of TDOAs
    error : (n,) m, root of its trace; dop : (n,), position dilution of precision
    hull : (n,) inside the anchors' convex hull
    ambiguous : (n,) share of the pairings, each of one anchor more than TDOAs must determine coordinates, with two solutions
    flyable : (n,) inside the hull and with one solution, by the criterion that was asked for
    """

    grid: Grid
    covariance: np.ndarray
    error: np.ndarray
    dop: np.ndarray
    hull: np.ndarray
    ambiguous: np.ndarray
    flyable: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Bound along x, y (and z): (n, k) m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def volume(self, anchors: Anchors, dimensions: int) -> FlyableVolume:
        """The FlyableVolume of this chart, among Anchors."""
        return FlyableVolume(
            self.grid.lower,
            np.full(3, self.grid.step),
            self.flyable.reshape(self.grid.shape),
            self.error.reshape(self.grid.shape),
            anchors.ids,
            anchors.positions,
            anchors.frame,
            dimensions == 2,
        )


def chart(installation: Installation, grid: Grid, criterion: str = "pairings") -> Chart:
    """Chart of an Installation over a Grid. criterion : of FLYABLE."""
    points = grid.points
    covariance = bound(information(points, installation))
    dop = np.linalg.norm(dilution(points, installation), axis=1)
    return Chart(grid, covariance, position_error(covariance), dop, *flyable(installation, points, criterion))


def flyable(
    installation: Installation, points: np.ndarray, criterion: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """hull, ambiguous, flyable of a Chart, (n,) each, at points (n, 3) m."""
    subsets = Subsets(installation.anchors, installation.unknowns)
    hull, ambiguous = installation.inside_hull(points), subsets.ambiguous(points)
    return hull, ambiguous, hull & subsets.unique(points, installation, criterion, ambiguous)
