"""What a sensor makes of the truth: a matrix and an offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


@dataclass(frozen=True)
class Affine:
    """x -> matrix x + offset, for (n, k) rows."""

    matrix: np.ndarray
    offset: np.ndarray

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return x @ self.matrix.T + self.offset

    def after(self, first: Affine) -> Affine:
        """The map that applies `first`, then this one."""
        return Affine(self.matrix @ first.matrix, self.matrix @ first.offset + self.offset)

    def inverse(self) -> Affine:
        """The map that undoes this one."""
        back = np.linalg.inv(self.matrix)
        return Affine(back, -back @ self.offset)


IDENTITY = Affine(np.eye(3), np.zeros(3))


def regressors(
    model: Callable[[dict[str, float]], Affine],
    values: dict[str, float],
    reading: np.ndarray,
    keys: Sequence[str],
) -> np.ndarray:
    """Derivative of what `model`, the Affine of parameters, makes at `values` of a `reading` (n,
    k), by the parameters `keys`: (n, k, len(keys)); numerical.
    """
    step, out = 1e-6, np.empty((*reading.shape, len(keys)))
    for column, key in enumerate(keys):
        here = values.get(key, 0.0)
        ends = [model({**values, key: here + s})(reading) for s in (-step, step)]
        out[:, :, column] = (ends[1] - ends[0]) / (2.0 * step)
    return out
