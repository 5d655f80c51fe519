"""Distances between anchors, measured by laser, by tape, or by the anchors themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from ..diagnosis.constraints import Distance
from ..readers.tables import number, read_table

if TYPE_CHECKING:
    from pathlib import Path

    from uwb_tdoa_bias.foundation.anchors import Anchors

COLUMNS = "a", "b", "distance", "std"


def read_distances(path: str | Path, anchors: Anchors) -> list[Distance]:
    """[Distance] of a CSV file with the columns COLUMNS: ids, m, m.

    Raises InputError for one that cannot be of Anchors.
    """
    out, known = [], ", ".join(str(i) for i in anchors.ids)
    for line, row in read_table(path, COLUMNS):
        a, b, distance, std = (number(path, line, row, name) for name in COLUMNS)
        if a == b or (anchors.index(np.array([a, b])) < 0).any():
            raise InputError(
                f"{path}: line {line}: {a:g} and {b:g} must be two of the anchors {known}."
            )
        if not (0.0 < distance < 1e4 and 0.0 < std < 10.0):
            raise InputError(
                f"{path}: line {line}: {distance:g} +- {std:g} m is no distance; both must be "
                "above 0, in m."
            )
        out.append(Distance(int(a), int(b), distance, std))
    if not out:
        raise InputError(
            f"{path}: holds no distance; write one in each line below {','.join(COLUMNS)}."
        )
    return out
