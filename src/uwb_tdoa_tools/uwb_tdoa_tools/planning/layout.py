# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Describe layouts of anchors: where anchors may be, as numbers, and their score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.safe_yaml import read_yaml

from ..simulation.rooms import facing
from .installation import Installation
from .maps import Demand, judge
from .precision import bound, information, position_error


class AnchorPlaces:
    """Boxes in which anchors may be. A box may be flat (a wall), thin (a rail) or a point.

    Two numbers between 0 and 1 give a place on flat boxes, three if a box has volume. The first runs
    through all boxes along their longest sides, the others across.
    """

    def __init__(self, boxes: ArrayLike) -> None:
        """Take boxes (B, 6) m: lower x y z and upper x y z of each. Raises InputError."""
        boxes = np.asarray(boxes, dtype=float)
        if boxes.ndim != 2 or boxes.shape[1] != 6 or not len(boxes) or not np.isfinite(boxes).all():
            raise InputError("places: give a list of boxes [x0, y0, z0, x1, y1, z1] in metres.")
        if (boxes[:, 3:] < boxes[:, :3]).any():
            raise InputError(
                "places: a box ends before it begins; write [x0, y0, z0, x1, y1, z1], each x1 "
                ">= x0."
            )
        self.lower, self.size = boxes[:, :3], boxes[:, 3:] - boxes[:, :3]
        self.order = np.argsort(-self.size, axis=1, kind="stable")  # longest side first
        lengths = np.take_along_axis(self.size, self.order, axis=1)
        self.numbers = 3 if (lengths[:, 2] > 0.0).any() else 2
        self.ends = np.cumsum(np.maximum(lengths[:, 0], 1e-3))
        self.starts = self.ends - np.maximum(lengths[:, 0], 1e-3)
        across = np.maximum(lengths[:, 1 : self.numbers].max(axis=0), 1e-3)
        # m, of what each number runs through, at most
        self.lengths = np.append(self.ends[-1], across)

    @classmethod
    def walls(
        cls,
        lower: Sequence[float] | np.ndarray,
        upper: Sequence[float] | np.ndarray,
        lowest: float = 0.2,
        depth: float = 0.0,
    ) -> AnchorPlaces:
        """Return the four walls of a room, and the space within `depth` m of them.

        They reach from `lowest` m above the floor to the ceiling.
        """
        (x0, y0, z0), (x1, y1, z1) = lower, upper
        z0 = min(z0 + lowest, z1)
        return cls(
            [
                (x0, y0, z0, x1, y0 + depth, z1),
                (x1 - depth, y0, z0, x1, y1, z1),
                (x0, y1 - depth, z0, x1, y1, z1),
                (x0, y0, z0, x0 + depth, y1, z1),
            ]
        )

    @classmethod
    def from_yaml(cls, path: str | Path) -> AnchorPlaces:
        """Read `places: [[x0, y0, z0, x1, y1, z1], ...]`. Raises InputError."""
        content = read_yaml(path)
        try:
            return cls(content["places"])
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}: is no list of places ({error!r}); write 'places: [[x0, y0, z0, x1, "
                "y1, z1]]'."
            ) from error

    def positions(self, numbers: np.ndarray) -> np.ndarray:
        """Return the positions (..., 3) m of (..., self.numbers) numbers between 0 and 1."""
        at = np.clip(numbers[..., 0], 0.0, 1.0) * self.ends[-1]
        box = np.minimum(np.searchsorted(self.ends, at), len(self.ends) - 1)
        along = (at - self.starts[box]) / (self.ends[box] - self.starts[box])
        share = np.zeros((*at.shape, 3))
        for k, value in enumerate([along, *np.moveaxis(numbers[..., 1:], -1, 0)]):
            np.put_along_axis(share, self.order[box][..., k : k + 1], value[..., None], axis=-1)
        return self.lower[box] + share * self.size[box]

    def grid(self, count: int) -> np.ndarray:
        """Return the numbers of about `count` places, evenly spread: (n, self.numbers)."""
        side = max(2, round(count ** (0.8 / self.numbers)))
        along = max(2, count // side ** (self.numbers - 1))
        axes = [np.linspace(0.0, 1.0, along), *[np.linspace(0.0, 1.0, side)] * (self.numbers - 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.numbers)

    def nearest(self, wanted: ArrayLike) -> np.ndarray:
        """Return the numbers of the places nearest to `wanted` (n, 3) m: (n, self.numbers).

        They are strictly between 0 and 1, and approximate.
        """
        numbers = 0.01 + 0.98 * self.grid(4000)
        away = np.linalg.norm(self.positions(numbers) - np.asarray(wanted)[:, None], axis=-1)
        return numbers[np.argmin(away, axis=1)]


def lattice(
    lower: Sequence[float] | np.ndarray, upper: Sequence[float] | np.ndarray, step: float
) -> np.ndarray:
    """Return points at most `step` m apart that fill a box and its faces: (n, 3) m."""
    counts = [
        max(1, int(np.ceil((high - low) / step - 1e-9))) + 1 for low, high in zip(lower, upper)
    ]
    axes = [np.unique(np.linspace(*ends)) for ends in zip(lower, upper, counts)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of `count` points (n, 3) m that are far from each other.

    The corners come first, then the points between them.
    """
    diagonals = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    rows = list(np.unique(np.argmax(points @ diagonals.T, axis=0)))
    away = np.min([np.linalg.norm(points - points[row], axis=1) for row in rows], axis=0)
    while len(rows) < min(count, len(points)):
        rows.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[rows[-1]], axis=1))
    return np.array(rows[:count])


# m, stands for an infinite bound, and for a layout that determines no position
UNUSABLE = 100.0


@dataclass(frozen=True)
class Goal:
    """Score of a layout of anchors.

    points : (n, 3) m, to be located; installation : everything but the anchors; demand : Demand
    """

    points: np.ndarray
    installation: Installation
    demand: Demand = field(default_factory=Demand)

    def errors(self, anchors: Anchors) -> np.ndarray:
        """Return the bound at the points: (n,) m. Raises InputError for useless anchors.

        The small second term of eq. 1 is left out.
        """
        installation = replace(self.installation, anchors=anchors)
        found = position_error(bound(information(self.points, installation, correction=False)))
        return np.minimum(found, UNUSABLE)

    def figures(self, anchors: Anchors) -> dict[str, float]:
        """Return {"worst", "mean": m, of the bound; "failing": share that cannot be flown}."""
        errors = self.errors(anchors)
        judged = judge(self.points, replace(self.installation, anchors=anchors), self.demand)
        return {
            "worst": float(errors.max()),
            "mean": float(errors.mean()),
            "failing": float(1.0 - np.mean(judged.flyable)),
        }

    def score(self, anchors: Anchors) -> float:
        """Return the worst bound in m, times 1 to 2 for the share of points that fail."""
        try:
            found = self.figures(anchors)
        except InputError:
            return 2.0 * UNUSABLE
        return found["worst"] * (1.0 + found["failing"])


_ARM = 3.0  # m; to move an anchor so far changes about as much as to turn it by 1 rad
_STEP = 1e-6  # of x, for derivatives


@dataclass(frozen=True)
class Layout:
    """Anchors as a vector x of numbers of about the same effect.

    x holds for each anchor the numbers of AnchorPlaces, times their length over an arm, then a
    rotation vector, rad.

    count : anchors to place; target : (3,) m, which antennas face, with their axis upright, before
    the rotation; turned : False if antennas radiate alike in all directions, like anchors without a
    surveyed orientation.
    """

    places: AnchorPlaces
    count: int
    target: np.ndarray
    turned: bool = True

    @property
    def width(self) -> int:
        """Numbers per anchor."""
        return self.places.numbers + 3 * self.turned

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """The (low, high) of each number of x."""
        return (
            [(0.0, length / _ARM) for length in self.places.lengths]
            + [(-np.pi, np.pi)] * 3 * self.turned
        ) * self.count

    def start(self, numbers: np.ndarray) -> np.ndarray:
        """Return x for place numbers (count, places.numbers), with antennas that are not rotated."""
        placed = np.reshape(numbers, (self.count, -1)) * self.places.lengths / _ARM
        return np.hstack([placed, np.zeros((self.count, 3 * self.turned))]).ravel()

    def anchors(self, x: np.ndarray) -> Anchors:
        """Return the Anchors of x."""
        placed = self._placed(np.reshape(x, (self.count, self.width)))
        return Anchors(np.arange(self.count), *placed)

    def nudged(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return all anchors, and again after a small step of each number.

        Returns positions ((1 + width) count, 3) m, orientations likewise, and steps (len(x),).
        """
        rows = np.reshape(x, (self.count, self.width))
        upper = np.reshape(self.bounds, (self.count, self.width, 2))[:, :, 1]
        steps = np.where(rows > 0.5 * upper, -_STEP, _STEP)  # not over the upper end of a place
        moved = np.concatenate([rows[None], rows + steps * np.eye(self.width)[:, None]])
        return *self._placed(moved.reshape(-1, self.width)), steps.ravel()

    def columns(self) -> np.ndarray:
        """Return the rows of `nudged` of each layout: (1 + len(x), N).

        The first layout is x, then x after the step of each number.
        """
        chosen = np.tile(np.arange(self.count), (1 + self.count * self.width, 1))
        anchor, number = np.divmod(np.arange(self.count * self.width), self.width)
        chosen[1 + np.arange(len(anchor)), anchor] = self.count * (1 + number) + anchor
        return chosen

    def _placed(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (n, 3) m and orientations (n, 4) of rows (n, width)."""
        n = self.places.numbers
        new = facing(self.places.positions(rows[:, :n] * _ARM / self.places.lengths), self.target)
        if not self.turned:
            return new.positions, np.full((len(rows), 4), np.nan)
        return new.positions, (
            Rotation.from_rotvec(rows[:, n:]) * Rotation.from_quat(new.orientations)
        ).as_quat()


def free_ids(taken: np.ndarray, count: int) -> np.ndarray:
    """Return the `count` smallest ids that are not taken."""
    return np.setdiff1d(np.arange(count + taken.max() + 1), taken)[:count]
