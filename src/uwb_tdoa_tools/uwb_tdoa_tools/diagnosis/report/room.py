# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Collect quantities over the place: position errors, anchor shifts, and blocked regions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects.base import Region, Shift

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from ...scoring.metrics import Score
    from ..channels import ChannelResiduals
    from ..result import Diagnosis

VIEWS = ([0, 1], [0, 2])  # x and y from above, x and z from the side
CELL = 1.0  # m, size of a cell of mean errors
FEWEST = 0.5  # s, shortest time in a cell with a mean error


@dataclass(frozen=True)
class Flown:
    """A judged run, where its estimate is finite.

    t : (n,) s in the air; p : (n, 3) m, true position, world; error : (n, 3) m, estimate minus
        truth
    """

    t: np.ndarray
    p: np.ndarray
    error: np.ndarray

    @property
    def distance(self) -> np.ndarray:
        """Return the 3D position errors, (n,) m."""
        return np.linalg.norm(self.error, axis=1)


def flown(scores: Iterable[Score]) -> list[Flown]:
    """Return the Flown of Scores; Scores without an estimate are left out."""
    out = []
    for score in scores:
        known = np.isfinite(score.error).all(axis=1)
        if known.sum() > 1:
            out.append(Flown(score.t[known] - score.first, score.p[known], score.error[known]))
    return out


def mean_errors(runs: Sequence[Flown], view: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean errors of runs in cells of CELL m.

    view : the two axes that are drawn
    returns : true places (k, 2) m, mean errors (k, 2) m
    """
    if not runs:
        return np.empty((0, 2)), np.empty((0, 2))
    p, error = (
        np.concatenate([getattr(run, name)[:, view] for run in runs]) for name in ("p", "error")
    )
    label = np.unique(np.floor(p / CELL), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(label)
    means = [
        np.stack([np.bincount(label, values[:, k]) / count for k in range(2)], axis=1)
        for values in (p, error)
    ]
    filled = count * np.median([np.median(np.diff(run.t)) for run in runs]) >= FEWEST
    return means[0][filled], means[1][filled]


def shifts_and_regions(
    diagnosis: Diagnosis,
) -> tuple[dict[int, tuple[np.ndarray, np.ndarray]], list[Region]]:
    """Return shifts and blocked regions of the flights' anchors in the written model.

    returns : {anchor id: (shift (3,) m, std (3,) m)}, [Region]
    """
    anchors = diagnosis.flights[0].anchors
    shifts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    regions = []
    for mark in (mark for effect in diagnosis.effects.effects for mark in effect.marks(anchors)):
        if mark.anchor not in anchors.ids:
            continue
        if isinstance(mark, Region):
            regions.append(mark)
        elif isinstance(mark, Shift):
            by, std = shifts.get(mark.anchor, (np.zeros(3), np.zeros(3)))
            shifts[mark.anchor] = by + mark.by, np.hypot(std, mark.std)
    return shifts, regions


def changed(diagnosis: Diagnosis) -> bool:
    """Return whether errors in the air differ between before and after.

    They do if an effect was added that acts above the floor.
    """
    return any(finding.added and not finding.on_floor for finding in diagnosis.findings)


def estimated(flight: ChannelResiduals) -> np.ndarray:
    """Return the estimated path in the air, (n, 3) m, of {channel: ChannelResidual}.

    It is used without ground truth.
    """
    rows = next(iter(flight.values())).rows()
    return rows.place[np.argsort(rows.t, kind="stable")]
