"""Anchors that come and go while a filter runs: each has a row of its own, and whatever is
remembered by rows stays right.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.anchors import SAME_PLACE, Anchors

from .core.memory import FilterState, Floor, new_state

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects.base import SensorFunction

# twice as many as a message may hold: after so many changes the filter starts anew
MOST_ROWS = 20_000


class AnchorTable:
    """The anchors that a filter has had so far, by rows, and which of them are there now.

    anchors : Anchors that are there; ids (M,), positions (M, 3) m: of all rows. An anchor that is
        moved gets another row, with nothing
    known of it.
    """

    def __init__(self, anchors: Anchors) -> None:
        self.anchors, self.ids, self.positions = anchors, anchors.ids, anchors.positions
        self._rows = np.arange(len(anchors))  # of `anchors`

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def present(self) -> np.ndarray:
        """Rows of those that are there: (N,)."""
        return self._rows

    def index(self, ids: np.ndarray) -> np.ndarray:
        """Row of each of some ids, -1 for those that are not there."""
        places = self.anchors.index(ids)
        return (
            places
            if len(self._rows) == len(self.ids)
            else np.where(places >= 0, self._rows[places], -1)
        )

    def stay(self, anchors: Anchors) -> np.ndarray:
        """Which of other Anchors are there already, within SAME_PLACE: (n,) bool."""
        places = self.anchors.index(anchors.ids)
        return (places >= 0) & (
            np.linalg.norm(self.positions[self._rows[places]] - anchors.positions, axis=1)
            <= SAME_PLACE
        )

    def change(self, anchors: Anchors) -> np.ndarray:
        """Go on with other Anchors; returns the rows of those that are gone, or stand elsewhere."""
        stay, before = self.stay(anchors), self._rows
        rows = self._rows[self.anchors.index(anchors.ids)]
        rows[~stay] = len(self.ids) + np.arange(np.count_nonzero(~stay))
        self.ids = np.append(self.ids, anchors.ids[~stay])
        self.positions = np.concatenate([self.positions, anchors.positions[~stay]])
        self.anchors, self._rows = anchors.at(self.positions[rows]), rows
        return np.setdiff1d(before, rows)


def new_state_of(
    anchor_table: AnchorTable, functions: Sequence[SensorFunction], floor: Floor | None
) -> FilterState:
    """`new_state` with a row for each row of AnchorTable; functions, floor : of the anchors that are
    there. No TDOA comes of the other rows.
    """
    state, places = (
        new_state(anchor_table.anchors.positions, functions, floor),
        np.zeros(len(anchor_table), int),
    )
    places[anchor_table.present] = np.arange(len(anchor_table.present))
    return state._replace(anchors=state.anchors[places])


def forget(state: FilterState, gone: np.ndarray) -> None:
    """Have the state of a filter without what was received of anchors in rows (k,), which are not
    there any more.
    """
    state.anchors["heard"][gone] = -np.inf
    ekf = state.ekf[0]
    window = ekf["window"][: ekf["kept"]]
    others = window[~(np.isin(window["a"], gone) | np.isin(window["b"], gone))]
    if len(others):  # an empty window has no stamps
        ekf["window"][: len(others)], ekf["kept"] = others, len(others)
    if ekf["ranged"]["anchor"][0] in gone:
        ekf["ranged"]["t"] = -np.inf
