"""Places and directions of anchors as a vector of numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.anchors import Anchors

from ..simulation.rooms import facing
from .places import AnchorPlaces

_ARM = 3.0  # m; to move an anchor so far changes about as much as to turn it by 1 rad
_STEP = 1e-6  # of x, for derivatives


@dataclass(frozen=True)
class Layout:
    """What is free and what is not, as a vector x of numbers that matter alike: for each anchor to
    place those of AnchorPlaces, times their length over an arm, then a rotation vector, rad.

    count : anchors to place; fixed : Anchors that stay, or None; target : (3,) m, what new antennas
        face, their axis
    upright, before they are turned; turned : whether they are, or radiate alike in all directions,
    like anchors whose orientation nobody surveyed.
    """

    places: AnchorPlaces
    count: int
    fixed: Anchors | None
    target: np.ndarray
    turned: bool = True

    @property
    def width(self) -> int:
        """Numbers per anchor."""
        return self.places.numbers + 3 * self.turned

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """(low, high) of every number of x."""
        return (
            [(0.0, length / _ARM) for length in self.places.lengths]
            + [(-np.pi, np.pi)] * 3 * self.turned
        ) * self.count

    def start(self, numbers: np.ndarray) -> np.ndarray:
        """x of place numbers (count, places.numbers), antennas not turned."""
        placed = np.reshape(numbers, (self.count, -1)) * self.places.lengths / _ARM
        return np.hstack([placed, np.zeros((self.count, 3 * self.turned))]).ravel()

    def anchors(self, x: np.ndarray) -> Anchors:
        """Anchors of x, after the fixed ones."""
        positions, orientations = self._placed(np.reshape(x, (self.count, self.width)))
        if self.fixed is None:
            return Anchors(np.arange(self.count), positions, orientations)
        return Anchors(
            np.append(self.fixed.ids, free_ids(self.fixed.ids, self.count)),
            np.vstack([self.fixed.positions, positions]),
            np.vstack([self.fixed.orientations, orientations]),
            self.fixed.frame,
        )

    def nudged(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The fixed anchors, the free ones, and these again after a small step of each of their
        numbers in turn: positions (F + (1 + width) count, 3) m, orientations likewise, steps
        (len(x),).
        """
        rows = np.reshape(x, (self.count, self.width))
        upper = np.reshape(self.bounds, (self.count, self.width, 2))[:, :, 1]
        steps = np.where(rows > 0.5 * upper, -_STEP, _STEP)  # not over the upper end of a place
        moved = np.concatenate([rows[None], rows + steps * np.eye(self.width)[:, None]])
        positions, orientations = self._placed(moved.reshape(-1, self.width))
        if self.fixed is not None:
            positions = np.vstack([self.fixed.positions, positions])
            orientations = np.vstack([self.fixed.orientations, orientations])
        return positions, orientations, steps.ravel()

    def free(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the positions of `nudged`: the free anchors (count, 3) m, and after each step (count,
        width, 3) m.
        """
        moved = positions[-self.count * (1 + self.width) :].reshape(1 + self.width, self.count, 3)
        return moved[0], moved[1:].swapaxes(0, 1)

    def columns(self) -> np.ndarray:
        """Which rows of `nudged` make up each layout, first x, then x after the step of each
        number: (1 + len(x), N).
        """
        fixed = 0 if self.fixed is None else len(self.fixed)
        chosen = np.tile(np.arange(fixed + self.count), (1 + self.count * self.width, 1))
        anchor, number = np.divmod(np.arange(self.count * self.width), self.width)
        chosen[1 + np.arange(len(anchor)), fixed + anchor] = (
            fixed + self.count * (1 + number) + anchor
        )
        return chosen

    def _placed(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3) m and orientations (n, 4) of rows (n, width)."""
        n = self.places.numbers
        new = facing(self.places.positions(rows[:, :n] * _ARM / self.places.lengths), self.target)
        if not self.turned:
            return new.positions, np.full((len(rows), 4), np.nan)
        return new.positions, (
            Rotation.from_rotvec(rows[:, n:]) * Rotation.from_quat(new.orientations)
        ).as_quat()


def free_ids(taken: np.ndarray, count: int) -> np.ndarray:
    """The `count` smallest ids that nobody has."""
    return np.setdiff1d(np.arange(count + taken.max() + 1), taken)[:count]
