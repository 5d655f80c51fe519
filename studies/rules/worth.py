# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Changes that a variant causes, row by row."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
import math

import numpy as np

NOTICED = 0.02  # share by which a figure must change to count
MARGIN = 2.0  # times what a row changes by anything, by which it must change to count
LEAST = (0.002, 0.02, 0.05, 0.005, 0.05)  # m, NEES, s, rad, s: changes that never count
HONEST = 3.0  # NEES of an honest filter

# loss, in so many rows, and mean loss: it is worth it
CLEAR, CLEAR_ROWS, CLEAR_MEAN = (0.05, 3, 0.01)


@dataclass
class Worth:
    """The changes that a variant causes.

    rows : number of rows that were run
    changes : {row: largest change} of rows that change by more than NOTICED
    lost : number of rows that are worse by more than CLEAR
    worse, better : (share, row), the largest loss and the largest gain
    mean : share, of the 3D RMSE over all spans
    nees : of the mean excess over HONEST
    """

    rows: int = 0
    changes: dict[str, float] = field(default_factory=dict)
    lost: int = 0
    same: bool = True
    worse: tuple[float, str] = (0.0, "")
    better: tuple[float, str] = (0.0, "")
    logs: list[float] = field(default_factory=list)
    excess: list[float] = field(default_factory=list)

    @property
    def clear(self) -> bool:
        """Whether the filter is clearly worse: more rows need not be run."""
        return self.lost >= CLEAR_ROWS and self.mean > CLEAR_MEAN

    @property
    def changed(self) -> int:
        """How many rows change by more than NOTICED."""
        return len(self.changes)

    @property
    def mean(self) -> float:
        """Share by which the 3D RMSE grows, geometric mean over all spans."""
        return float(np.expm1(np.mean(self.logs))) if self.logs else 0.0

    @property
    def nees(self) -> float:
        """By how much the NEES beyond HONEST grows, mean over all spans."""
        return float(np.mean(self.excess)) if self.excess else 0.0


def worth(base: dict, variant: dict, noise: dict[str, float] | None = None) -> Worth:
    """Worth of a variant, of {row: {span: figures}}. noise : by how much rows change by anything."""
    out = Worth()
    for row, spans in variant.items():
        if row not in base:
            continue
        out.rows += 1
        changes = []
        for span, new in spans.items():
            old = base[row][span]
            out.same &= new == old
            is_time = span == "again"
            for k, (before, after) in enumerate(zip(old, new)):
                changes.append(_change(before, after, LEAST[4 if is_time else k], k == 1))
            if not is_time and old[0] and new[0]:
                out.logs.append(math.log(new[0] / old[0]))
            if not is_time and old[1] and new[1]:
                out.excess.append(max(new[1] - HONEST, 0.0) - max(old[1] - HONEST, 0.0))
        largest, smallest = max(changes), min(changes)
        out.lost += largest > CLEAR
        if max(largest, -smallest) > max(NOTICED, MARGIN * (noise or {}).get(row, 0.0)):
            out.changes[row] = max(largest, smallest, key=abs)
        out.worse = max(out.worse, (largest, row))
        out.better = min(out.better, (smallest, row))
    return out


def noise_of(base: dict, nudged: Iterable[dict]) -> dict[str, float]:
    """{row: the largest share by which it changes, if all constants change a little}."""
    noise: dict[str, float] = {}
    for variant in nudged:
        for row, change in worth(base, variant).changes.items():
            noise[row] = max(noise.get(row, 0.0), abs(change))
    return noise


def _change(before: float | None, after: float | None, least: float, is_nees: bool) -> float:
    """Share by which a figure grows, 0 where that does not count; of the NEES beyond HONEST only."""
    if before is None or after is None:
        return 0.0 if before == after else (math.inf if after is None else -math.inf)
    if is_nees:
        before, after = max(before, HONEST), max(after, HONEST)
    if abs(after - before) < least:
        return 0.0
    return (after - before) / max(abs(before), least)
