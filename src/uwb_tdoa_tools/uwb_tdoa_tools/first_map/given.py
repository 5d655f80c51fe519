# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Observations of what a user gives: flights, the survey of a few anchors, and files of measurements."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError

from ..readers.names import read_survey
from ..surveying.known import read_coordinates, read_distances
from .observations import heard, observe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.flight import Flight

    from .observations import Observations

MOST = 64  # anchors of a map


def given(
    flights: Sequence[Flight],
    survey: str | Path,
    files: tuple[str | None, str | None],
    deviations: tuple[float, float],
) -> tuple[Observations, str]:
    """Return the Observations, and the name of their frame.

    survey : file of the anchors that are known
    files : coordinates, or None; distances, or None
    deviations : m, of the coordinates in the survey, and of the delay of an anchor in distances

    Raises InputError.
    """
    if Path(survey).is_dir():
        raise InputError(f"{survey}: is a folder; give the file of the anchors that are known.")
    known = read_survey(survey)
    distances = [] if files[1] is None else read_distances(files[1])
    between = [i for one in distances for i in (one.a, one.b)]
    ids = np.union1d(heard(flights), np.array(between, np.int64))
    lacking = np.setdiff1d(known.ids, ids)
    if len(lacking):
        raise InputError(
            f"{survey}: no measurement is of anchor {lacking[0]}; the data hold anchors "
            f"{', '.join(map(str, ids[:10]))}: name some of these."
        )
    if len(known) == len(ids):
        raise InputError(
            f"{survey}: holds all {len(ids)} anchors; leave out those that are unknown, or use survey."
        )
    if len(ids) > MOST:
        raise InputError(
            f"{len(ids)} anchors are too many for one map; give data of {MOST} at most."
        )
    rows = [
        (np.searchsorted(ids, i), axis, value, deviations[0])
        for i, position in zip(known.ids, known.positions)
        for axis, value in enumerate(position)
    ]
    for anchor, axis, value, std in [] if files[0] is None else read_coordinates(files[0]):
        if anchor not in ids:
            raise InputError(
                f"{files[0]}: no measurement is of anchor {anchor}; leave its lines out."
            )
        rows.append((np.searchsorted(ids, anchor), axis, value, std))
    table = [
        (np.searchsorted(ids, one.a), np.searchsorted(ids, one.b), one.distance, one.std)
        for one in distances
    ]
    seen = replace(
        observe(flights, ids),
        coordinates=np.array(rows, float),
        distances=np.array(table, float).reshape(-1, 4),
        delay_std=deviations[1],
    )
    return seen, known.frame
