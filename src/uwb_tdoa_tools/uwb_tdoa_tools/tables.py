# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of results: named columns, as a DataFrame of pandas or as a structured array of numpy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from uwb_tdoa_ekf.offline import Run

from .localizing.localize import COLUMNS, trajectory_rows

AXES = {3: "xyz", 4: "xyzw"}  # names of the parts of a vector


def columns_of(part: Any) -> dict[str, np.ndarray]:
    """Return {name: (n,) array} of a Run, or of a dataclass of arrays.

    A vector gets a column for each axis, e.g. p_x. Arrays of matrices are left out.
    """
    if isinstance(part, Run):
        return dict(zip(COLUMNS, trajectory_rows(part.odometry).T))
    out: dict[str, np.ndarray] = {}
    for field in fields(part):
        values = np.asarray(getattr(part, field.name))
        if values.shape == (len(part),):
            out[field.name] = values
        elif values.ndim == 2:
            names = AXES.get(values.shape[1], range(values.shape[1]))
            out |= {f"{field.name}_{axis}": values[:, k] for k, axis in enumerate(names)}
    return out


def as_table(columns: Mapping[str, np.ndarray]) -> Any:
    """Return a DataFrame of columns where pandas is installed, else a structured array, (n,)."""
    try:
        from pandas import DataFrame
    except ImportError:
        kinds = [(name, values.dtype) for name, values in columns.items()]
        out = np.empty(len(next(iter(columns.values()))), kinds)
        for name, values in columns.items():
            out[name] = values
        return out
    return DataFrame(dict(columns))
