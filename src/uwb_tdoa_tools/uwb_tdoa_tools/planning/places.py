"""Where anchors may be, and points that fill a volume."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.safe_yaml import read_yaml

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike


class AnchorPlaces:
    """Where anchors may be: boxes, which may be flat (a wall), thin (a rail) or a point.

    Two numbers between 0 and 1 for a place on flat boxes, three where a box has volume: the first
    runs through all boxes along their longest sides, the others across.
    """

    def __init__(self, boxes: ArrayLike) -> None:
        """boxes : (B, 6) lower x y z and upper x y z of each, m. Raises InputError."""
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
        self.lengths = np.append(
            self.ends[-1], across
        )  # m, of what each number runs through, at most

    @classmethod
    def walls(
        cls,
        lower: Sequence[float] | np.ndarray,
        upper: Sequence[float] | np.ndarray,
        lowest: float = 0.2,
        depth: float = 0.0,
    ) -> AnchorPlaces:
        """The four walls of a room from `lowest` m above its floor to its ceiling, and what is
        within `depth` m of them.
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
        """Read `places: [[x0, y0, z0, x1, y1, z1], ...]`; raises InputError."""
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
        """(..., 3) m of (..., self.numbers) numbers between 0 and 1."""
        at = np.clip(numbers[..., 0], 0.0, 1.0) * self.ends[-1]
        box = np.minimum(np.searchsorted(self.ends, at), len(self.ends) - 1)
        along = (at - self.starts[box]) / (self.ends[box] - self.starts[box])
        share = np.zeros((*at.shape, 3))
        for k, value in enumerate([along, *np.moveaxis(numbers[..., 1:], -1, 0)]):
            np.put_along_axis(share, self.order[box][..., k : k + 1], value[..., None], axis=-1)
        return self.lower[box] + share * self.size[box]

    def grid(self, count: int) -> np.ndarray:
        """Numbers of about `count` places all over: (n, self.numbers)."""
        side = max(2, round(count ** (0.8 / self.numbers)))
        along = max(2, count // side ** (self.numbers - 1))
        axes = [np.linspace(0.0, 1.0, along), *[np.linspace(0.0, 1.0, side)] * (self.numbers - 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.numbers)

    def nearest(self, wanted: ArrayLike) -> np.ndarray:
        """Numbers (n, self.numbers), strictly between 0 and 1, of about the places nearest to
        `wanted` (n, 3), m.
        """
        numbers = 0.01 + 0.98 * self.grid(4000)
        away = np.linalg.norm(self.positions(numbers) - np.asarray(wanted)[:, None], axis=-1)
        return numbers[np.argmin(away, axis=1)]


def lattice(
    lower: Sequence[float] | np.ndarray, upper: Sequence[float] | np.ndarray, step: float
) -> np.ndarray:
    """Points at most `step` apart that fill a box, its faces and corners included: (n, 3) m."""
    counts = [
        max(1, int(np.ceil((high - low) / step - 1e-9))) + 1 for low, high in zip(lower, upper)
    ]
    axes = [np.unique(np.linspace(*ends)) for ends in zip(lower, upper, counts)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """Rows of `count` of the points (n, 3), m, far from each other: first the corners, then what
    lies between.
    """
    diagonals = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    rows = list(np.unique(np.argmax(points @ diagonals.T, axis=0)))
    away = np.min([np.linalg.norm(points - points[row], axis=1) for row in rows], axis=0)
    while len(rows) < min(count, len(points)):
        rows.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[rows[-1]], axis=1))
    return np.array(rows[:count])
