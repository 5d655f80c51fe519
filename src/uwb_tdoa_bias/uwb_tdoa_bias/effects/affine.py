"""What a sensor makes of the truth: a matrix and an offset."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Affine:
    """x -> matrix x + offset, for (n, 3) rows."""

    matrix: np.ndarray
    offset: np.ndarray

    def __call__(self, x):
        return x @ self.matrix.T + self.offset

    def after(self, first):
        """The map that applies `first`, then this one."""
        return Affine(self.matrix @ first.matrix, self.matrix @ first.offset + self.offset)

    def inverse(self):
        """The map that undoes this one."""
        back = np.linalg.inv(self.matrix)
        return Affine(back, -back @ self.offset)


IDENTITY = Affine(np.eye(3), np.zeros(3))
