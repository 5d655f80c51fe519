"""Where an effect sits in the room, for a map."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Shift:
    """An anchor, by its id, stands `by` (3,) m from where the survey has it, world; std (3,) m, NaN
    where unknown.
    """

    anchor: int
    by: np.ndarray
    std: np.ndarray


@dataclass(frozen=True, eq=False)
class Region:
    """An anchor, by its id, is disturbed while the tag is within `radius` m of `centre` (3,) m,
    world.
    """

    anchor: int
    centre: np.ndarray
    radius: float
