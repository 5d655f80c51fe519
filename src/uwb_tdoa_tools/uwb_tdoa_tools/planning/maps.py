"""Precision and failure over a slice or a volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flyable import FlyableVolume

from .judging import Judged, judge

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from uwb_tdoa_bias.foundation.anchors import Anchors

    from .installation import Installation
    from .judging import Demand

MOST_CELLS = 4_000_000


@dataclass(frozen=True)
class Grid:
    """Cubes side by side. lower (3,) corner of the first, m; step: size of a cube, m; shape (nx,
    ny, nz).
    """

    lower: np.ndarray
    step: float
    shape: tuple[int, int, int]

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike, step: float) -> Grid:
        """Cubes of `step` m that cover the box from lower (3,) to upper (3,), m.

        Raises InputError.
        """
        lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        if not 0.0 < step < np.inf:
            raise InputError(
                f"step: {step!r} m is not the size of a cell; give one above 0, e.g. 0.1."
            )
        if not (upper > lower).all():
            raise InputError(
                f"room: {lower.tolist()} to {upper.tolist()} m is empty; give X0 X1 Y0 Y1 (Z0 "
                "Z1), each rising."
            )
        shape = np.ceil((upper - lower) / step - 1e-6)
        if np.prod(shape) > MOST_CELLS:
            raise InputError(
                f"step: {step:g} m makes {np.prod(shape):.0f} cells, more than {MOST_CELLS}; "
                "take it larger."
            )
        return cls(
            0.5 * (lower + upper - step * shape), float(step), tuple(shape.astype(int).tolist())
        )

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
class Chart(Judged):
    """What is true at every cell of a grid: Judged of n cells, k the dimensions of the
    installation. grid : Grid; heard : (n,) anchors.
    """

    grid: Grid
    heard: np.ndarray

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


def chart(installation: Installation, grid: Grid, demand: Demand) -> Chart:
    """Chart of an Installation all of whose anchors are heard, over a Grid."""
    points = grid.points
    found = judge(points, installation, demand)
    return Chart(
        found.covariance,
        found.error,
        found.status,
        grid,
        np.full(len(points), len(installation.anchors)),
    )
