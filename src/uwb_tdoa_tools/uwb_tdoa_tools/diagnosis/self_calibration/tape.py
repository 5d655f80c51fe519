# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Prior uncertainty of measured anchor coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError

from ...choices import TAPE_STD, TRUSTED_STD

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors

AXES = "xyz"


@dataclass(frozen=True)
class Tape:
    """Prior standard deviations of anchor coordinates that were measured, e.g. with a tape.

    Attributes
    ----------
    std : m, of each coordinate
    height_std : m, of z; None: as `std`
    trusted : anchors ("3") or coordinates ("3.z") that are known better
    trusted_std : m, of these
    unknown : ids of anchors with unknown positions
    """

    std: float = TAPE_STD
    height_std: float | None = None
    trusted: tuple[str, ...] = ()
    trusted_std: float = TRUSTED_STD
    unknown: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("std", "height_std", "trusted_std"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value <= 5.0:
                raise InputError(
                    f"--{name.replace('_', '-')}: {value:g} must be above 0 and at most 5 m."
                )

    def position_std(self, anchors: Anchors) -> np.ndarray:
        """Return the standard deviations of the coordinates of Anchors, (N, 3) m, world.

        Raises InputError for a name that is not an anchor or axis.
        """
        out = np.full((len(anchors), 3), self.std)
        if self.height_std is not None:
            out[:, 2] = self.height_std
        for name in self.trusted:
            anchor, dot, axis = name.partition(".")
            row = self._row(anchors, anchor, f"--trusted {name}")
            if dot and axis not in tuple(AXES):
                raise InputError(
                    f"--trusted: {name!r} has no axis {axis!r}; write {anchor} or {anchor}.x, "
                    f"{anchor}.y, {anchor}.z."
                )
            out[row, AXES.index(axis) if dot else slice(None)] = self.trusted_std
        return out

    def unknown_rows(self, anchors: Anchors) -> list[int]:
        """Return the rows of the unknown anchors.

        Raises InputError if fewer than four other anchors are left.
        """
        rows = [self._row(anchors, anchor, f"--unknown {anchor}") for anchor in self.unknown]
        if len(anchors) - len(rows) < 4:
            raise InputError(
                f"--unknown: {len(anchors) - len(rows)} of {len(anchors)} anchors are left; "
                "four must be known roughly."
            )
        return rows

    @staticmethod
    def _row(anchors: Anchors, text: str, option: str) -> int:
        if text not in [str(i) for i in anchors.ids]:
            known = ", ".join(str(i) for i in anchors.ids)
            raise InputError(
                f"{option}: there is no anchor {text!r}; the survey has {known}: add it "
                "there, roughly."
            )
        return [str(i) for i in anchors.ids].index(text)
