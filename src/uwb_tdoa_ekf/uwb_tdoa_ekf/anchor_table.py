# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Keep track of anchors that appear and disappear while a filter runs.

Each anchor has its own row. State that is stored by row stays valid after a change of anchors.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.anchors import SAME_PLACE, Anchors

# Twice the anchors that one message may hold. Beyond this number of rows the filter restarts.
MOST_ROWS = 20_000


class AnchorTable:
    """Store all anchors that a filter has had so far, one row each, and which are present now.

    An anchor that is moved gets a new row without any stored state.

    Attributes
    ----------
    anchors : Anchors
        Present anchors.
    ids : (M,) array
        Ids of all rows, present or not.
    positions : (M, 3) array
        Positions of all rows in the world frame, in m.
    """

    def __init__(self, anchors: Anchors) -> None:
        self.anchors, self.ids, self.positions = anchors, anchors.ids, anchors.positions
        self._rows = np.arange(len(anchors))  # row of each of `anchors`

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def present(self) -> np.ndarray:
        """Return the rows of the present anchors, (N,) int."""
        return self._rows

    def index(self, ids: np.ndarray) -> np.ndarray:
        """Return the row of each id, (n,) int; -1 for an id that is not present."""
        places = self.anchors.index(ids)
        return (
            places
            if len(self._rows) == len(self.ids)
            else np.where(places >= 0, self._rows[places], -1)
        )

    def stay(self, anchors: Anchors) -> np.ndarray:
        """Return which of other Anchors are already present within SAME_PLACE, (n,) bool."""
        places = self.anchors.index(anchors.ids)
        return (places >= 0) & (
            np.linalg.norm(self.positions[self._rows[places]] - anchors.positions, axis=1)
            <= SAME_PLACE
        )

    def change(self, anchors: Anchors) -> np.ndarray:
        """Replace the present anchors and return the rows of anchors that are gone or moved."""
        stay, before = self.stay(anchors), self._rows
        rows = self._rows[self.anchors.index(anchors.ids)]
        rows[~stay] = len(self.ids) + np.arange(np.count_nonzero(~stay))
        self.ids = np.append(self.ids, anchors.ids[~stay])
        self.positions = np.concatenate([self.positions, anchors.positions[~stay]])
        self.anchors, self._rows = anchors.at(self.positions[rows]), rows
        return np.setdiff1d(before, rows)
