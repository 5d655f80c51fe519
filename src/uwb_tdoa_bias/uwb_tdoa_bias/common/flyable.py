# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The volume in which a tag can be located reliably; `plan` saves it and `ekf_node` reads it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .anchors import Anchors
from .errors import InputError
from .files import read_arrays, write_filled

_FIELDS = {  # fields of the file, and their dtype kinds
    "frame": "U",
    "lower": "f",
    "step": "f",
    "flyable": "b",
    "bound": "f",
    "ids": "i",
    "positions": "f",
    "planar": "b",
}
_REMEDY = "make one with `plan ... --volume`"


@dataclass(frozen=True)
class FlyableVolume:
    """A box of cells, each flyable or not, in the world frame of its anchors.

    Attributes
    ----------
    lower : (3,) corner of the first cell, m, world
    step : (3,) size of a cell, m
    flyable : (nx, ny, nz) bool
    bound : (nx, ny, nz) m, the smallest position error that one round of TDOAs allows: root of the
        summed variances along x, y and, unless planar, z; inf where the position is undetermined
    ids, positions : (N,) and (N, 3) m, the anchors
    frame : name of the world frame
    planar : True if the height of the tag is known and does not matter here; then nz is 1
    """

    lower: np.ndarray
    step: np.ndarray
    flyable: np.ndarray
    bound: np.ndarray
    ids: np.ndarray
    positions: np.ndarray
    frame: str = "map"
    planar: bool = False

    def __post_init__(self) -> None:
        kinds = {
            "lower": float,
            "step": float,
            "flyable": bool,
            "bound": np.float32,
            "ids": int,
            "positions": float,
        }
        for name, kind in kinds.items():
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=kind))
        shapes = (
            self.lower.shape,
            self.step.shape,
            self.flyable.ndim,
            self.ids.ndim,
            self.positions.shape,
        )
        fits = (
            shapes == ((3,), (3,), 3, 1, (self.ids.size, 3))
            and self.bound.shape == self.flyable.shape
        )
        if not (fits and self.flyable.size):
            raise InputError(
                "flyable volume: lower, step, flyable, bound, ids and positions do not fit "
                "together."
            )
        finite = all(np.isfinite(array).all() for array in (self.lower, self.step, self.positions))
        if not (finite and (self.step > 0.0).all() and (self.bound >= 0.0).all()):
            raise InputError(
                "flyable volume: it holds a number that is not finite, a step that is not "
                "above 0 or a bound below 0."
            )

    def contains(self, p: ArrayLike) -> np.ndarray:
        """Return whether positions p (..., 3), m, world, are flyable: (...) bool.

        Positions outside of the box and positions that are not finite are not flyable.
        """
        inside, cell = self._cells(p)
        return inside & self.flyable[cell]

    def bound_at(self, p: ArrayLike) -> np.ndarray:
        """Return the bound at positions p (..., 3), m, world: (...) m, NaN outside of the box."""
        inside, cell = self._cells(p)
        return np.where(inside, self.bound[cell], np.nan)

    def _cells(self, p: ArrayLike) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Return whether positions are inside of the box, and the indexes of their cells."""
        p = np.asarray(p, dtype=float)
        at = np.where(np.isfinite(p), (p - self.lower) / self.step, -1.0)
        if self.planar:
            at[..., 2] = 0.0
        cell = np.floor(np.clip(at, -1.0, self.flyable.shape)).astype(int)
        inside = ((cell >= 0) & (cell < self.flyable.shape)).all(axis=-1)
        return inside, tuple(np.moveaxis(np.where(inside[..., None], cell, 0), -1, 0))

    def belongs_to(self, anchors: Anchors) -> bool:
        """Return whether the volume was computed for these Anchors."""
        return anchors.stand_at(self.ids, self.positions, self.frame)

    def save(self, path: str | Path) -> None:
        """Write a numpy .npz file that `load` reads."""
        fields = {name: getattr(self, name) for name in _FIELDS}
        write_filled(path, lambda file: np.savez_compressed(file, **fields))

    @classmethod
    def load(cls, path: str | Path) -> FlyableVolume:
        """Read a file that `save` wrote; raises InputError."""
        fields = read_arrays(path, _FIELDS, "flyable volume", _REMEDY)
        try:
            given: dict[str, Any] = {
                **fields,
                "frame": str(fields["frame"]),
                "planar": bool(fields["planar"]),
            }
            return cls(**given)
        except (TypeError, ValueError, OverflowError) as error:  # InputError is a ValueError
            raise InputError(f"{path}: is no flyable volume ({error}); {_REMEDY}.") from error
