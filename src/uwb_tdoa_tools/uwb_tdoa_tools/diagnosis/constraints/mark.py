"""A place where the tag was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WITHIN = 5  # stamps at which the estimate is averaged over a mark


@dataclass(frozen=True)
class Mark:
    """Where the tag was on average from `first` to `last`, s since the first TDOA of a flight:
    position (3,) m +- std, m.
    """

    flight: str
    first: float
    last: float
    position: tuple[float, ...]
    std: float

    def stamps(self, begin: float) -> np.ndarray:
        """(m,) s. begin : stamp of the first TDOA, s."""
        return begin + np.linspace(self.first, self.last, WITHIN)

    def equations(
        self, t: np.ndarray, estimate: np.ndarray, covariance: np.ndarray, moved: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The estimate, averaged over the mark, is off by what the parameters do to it.

        t (m,) s: `stamps`; estimate (m, 3) m, covariance (m, 3, 3) m^2, moved (m, 3, k): its
        derivative by the parameters, all at the stamps.
        """
        off, columns = self.off(estimate, moved)
        weight = 1.0 / (np.diag(covariance[WITHIN // 2]) + self.std**2)
        return (columns * weight[:, None]).T @ columns, columns.T @ (weight * off)

    def off(self, estimate: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """((3,) m, by how much the estimate is off; (3, k), by how much it is less so for each unit
        of the parameters).
        """
        return estimate.mean(axis=0) - self.position, moved.mean(axis=0)
