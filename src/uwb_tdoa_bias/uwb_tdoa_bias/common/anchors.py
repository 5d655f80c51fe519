# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors of an installation: ids, positions and orientations of the fixed radios."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
import yaml

from .errors import InputError
from .files import write_text
from .text import written_by

SAME_PLACE = 0.01  # m; a smaller change of a repeated anchor is no change
# m. Data made for other anchors, e.g. a flyable volume, hold only if every anchor moved less.
CONSTELLATION = 0.1
MOST = 10_000  # anchors, limit of a message
# m along each axis. Grid coordinates of a country fit, and their squares do not overflow.
FARTHEST = 1e8


@dataclass(frozen=True)
class Anchors:
    """The fixed radios of one installation, in one world frame.

    Attributes
    ----------
    ids : (N,) int array, each id once, 0 ... 65535
    positions : (N, 3) float array, antenna centres, m, world
    orientations : (N, 4) float array, quaternions x y z w, antenna to world, normalised;
        a row of NaN if the orientation was not surveyed
    frame : name of the world frame
    """

    ids: np.ndarray
    positions: np.ndarray
    orientations: np.ndarray
    frame: str = "map"

    def __post_init__(self) -> None:
        ids = _whole(self.ids)
        positions = np.array(self.positions, dtype=float, order="C")
        orientations = np.array(self.orientations, dtype=float)
        n = len(ids)
        if n == 0:
            raise InputError("anchors: the list is empty; give at least two anchors.")
        if n > MOST:
            raise InputError(
                f"anchors: there are {n}; give at most {MOST}, e.g. those of one hall."
            )
        if positions.shape != (n, 3) or orientations.shape != (n, 4):
            raise InputError(
                f"anchors: {n} ids need positions of shape ({n}, 3) and orientations of shape "
                f"({n}, 4), "
                f"got {positions.shape} and {orientations.shape}."
            )
        values, counts = np.unique(ids, return_counts=True)
        if (counts > 1).any():
            raise InputError(
                f"anchors: id {values[counts > 1][0]} is given twice; every anchor needs its "
                "own id."
            )
        bad = ~(np.abs(positions) <= FARTHEST).all(axis=1)
        if bad.any():
            raise InputError(
                f"anchors: position of anchor {ids[bad][0]} is {positions[bad][0]}; it must "
                "be finite metres, at most "
                f"{FARTHEST:g} from the origin."
            )
        bad = ~np.isfinite(orientations).all(axis=1) & ~np.isnan(orientations).all(axis=1)
        bad |= np.abs(np.nan_to_num(orientations)).max(axis=1) > 1e6
        if bad.any():
            raise InputError(
                f"anchors: orientation of anchor {ids[bad][0]} is {orientations[bad][0]}; "
                "give a quaternion x, y, z, w."
            )
        norm = np.linalg.norm(orientations, axis=1, keepdims=True)
        orientations = np.where(
            norm > 1e-9, orientations / np.where(norm > 1e-9, norm, 1.0), np.nan
        )
        for name, value in (("ids", ids), ("positions", positions), ("orientations", orientations)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        rows = np.full(ids.max() + 3, -1)  # one entry per id from -1 to one beyond the largest
        rows[ids + 1] = np.arange(n)
        object.__setattr__(self, "_rows", rows)

    def __len__(self) -> int:
        return len(self.ids)

    def row(self, anchor: int) -> int:
        """Return the row of one id, -1 for an unknown id."""
        return int(self.index(anchor))

    def index(self, ids: ArrayLike) -> np.ndarray:
        """Return the rows of some ids: int array of the shape of `ids`, -1 for an unknown id."""
        rows = self._rows  # type: ignore[attr-defined]  # set by __post_init__, no field
        return rows.take(np.asarray(ids, dtype=np.int64) + 1, mode="clip")

    def stand_at(self, ids: np.ndarray, positions: np.ndarray, frame: str) -> bool:
        """Return whether these anchors stand at some positions, each within CONSTELLATION.

        Parameters
        ----------
        ids : (n,) anchor ids; all ids of this object and no other
        positions : (n, 3) m, world
        frame : name of the world frame; it must be the same
        """
        rows = self.index(ids)
        if frame != self.frame or len(ids) != len(self) or (rows < 0).any():
            return False
        return bool(
            (np.linalg.norm(self.positions[rows] - positions, axis=1) <= CONSTELLATION).all()
        )

    def at(self, positions: np.ndarray) -> Anchors:
        """Return these Anchors at other positions, (N, 3) m, world."""
        return Anchors(self.ids, positions, self.orientations, self.frame)

    def only(self, rows: np.ndarray) -> Anchors:
        """Return the Anchors of some rows."""
        return Anchors(self.ids[rows], self.positions[rows], self.orientations[rows], self.frame)

    @classmethod
    def from_positions(
        cls, positions: ArrayLike, ids: ArrayLike | None = None, frame: str = "map"
    ) -> Anchors:
        """Return Anchors without orientations at (N, 3) positions, m, world.

        Default ids: 0 ... N-1.
        """
        positions = np.asarray(positions, dtype=float)
        ids = np.arange(len(positions)) if ids is None else np.asarray(ids)
        return cls(ids, positions, np.full((len(positions), 4), np.nan), frame)

    @classmethod
    def from_message(cls, message: Any) -> Anchors:
        """Return the Anchors of a uwb_tdoa_msgs/AnchorArray, from rclpy or from a bag.

        The orientation (0, 0, 0, 0) means unknown. An empty frame_id means "map". Raises InputError.
        """
        positions = [anchor.pose.position for anchor in message.anchors]
        orientations = [anchor.pose.orientation for anchor in message.anchors]
        return cls(
            np.array([anchor.id for anchor in message.anchors]),
            np.array([[p.x, p.y, p.z] for p in positions]).reshape(-1, 3),
            np.array([[q.x, q.y, q.z, q.w] for q in orientations]).reshape(-1, 4),
            message.header.frame_id or "map",
        )

    def to_yaml(self, path: str | Path) -> None:
        """Write a YAML file that `read_survey` reads."""
        entries = {}
        for i, p, q in zip(self.ids.tolist(), self.positions.tolist(), self.orientations.tolist()):
            entries[i] = {"position": p, **({"orientation": q} if np.isfinite(q).all() else {})}
        text = yaml.safe_dump(
            {"frame": self.frame, "anchors": entries}, sort_keys=False, default_flow_style=None
        )
        write_text(path, f"# {written_by()}\n{text}")


def _whole(ids: ArrayLike) -> np.ndarray:
    """Return ids as (N,) int64; raise InputError unless all are whole numbers 0 ... 65535."""
    values = np.asarray(ids).reshape(-1)
    bad = [
        value
        for value in values.tolist()
        if isinstance(value, bool) or not (0 <= value <= 65535) or value % 1
    ]
    if bad:
        raise InputError(f"anchors: id {bad[0]!r} is not a whole number 0 ... 65535.")
    return values.astype(np.int64)
