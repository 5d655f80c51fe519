"""Anchors in a plane, of which TDOAs do not tell on which side the tag is: what `tag_side` is to
be.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.core.workspace import FLAT

if TYPE_CHECKING:
    from collections.abc import Sequence

CEILING = (
    1.5  # m above the lowest thing that is known; anchors that all hang higher are at a ceiling
)


def sides_of(positions: np.ndarray) -> tuple[str, ...]:
    """Values of `tag_side` that are possible for anchors at positions (n, 3) m: ("below",),
    ("above",), ("+x", "-x"), ("+y", "-y"), or (), where they are in no plane across an axis of the
    world, or in a line.
    """
    flat = np.ptp(positions, axis=0) < FLAT
    if np.count_nonzero(flat) != 1:
        return ()
    if flat[2]:
        return ("below",) if positions[:, 2].mean() > CEILING else ("above",)
    axis = "xy"[int(np.argmax(flat))]
    return f"+{axis}", f"-{axis}"


def to_copy(sides: Sequence[str]) -> str:
    """What to write, for some sides: a phrase."""
    lines = " or ".join(f"-p tag_side:={side}" for side in sides)
    which = (
        ""
        if len(sides) == 1
        else f", whether the tag is at {'larger or smaller ' + sides[0][1:]} than they are"
    )
    return f"tell ekf_node the side, --ros-args {lines}{which} (tag_side in a file for --config)"
