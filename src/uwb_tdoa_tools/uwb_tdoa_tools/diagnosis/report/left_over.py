# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find pairs, times and places at which the model leaves the largest residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..regression.table import BLOCK

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..channels import ChannelResidual
    from ..result import Diagnosis

# smallest RMS residual of a named pair over BLOCK s: m, and relative to the RMS of all rows
LARGE, ABOVE = (0.15, 3.0)
NAMED = 3  # largest number of named places
NEAR = 0.999  # share of that limit above which a pair is checked exactly


def left_over(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return sentences on the largest remaining residuals; () if none stands out."""
    found: list[tuple[float, str]] = []
    for flight, residuals in zip(diagnosis.flights, diagnosis.remaining):
        for part in residuals.values():
            found += _of_part(part, f" of {flight.name}" if len(diagnosis.flights) > 1 else "")
    places = [f"{said} ({100 * size:.0f} cm)" for size, said in sorted(found, reverse=True)[:NAMED]]
    return (f"What is left is largest for {'; '.join(places)}.",) if places else ()


def _of_part(part: ChannelResidual, of: str) -> Iterator[tuple[float, str]]:
    rows = part.rows()
    block = (rows.t / BLOCK).astype(int)
    # the median of squares is 0.455 of their mean, for Gaussian noise
    usual = np.sqrt(np.median(rows.y**2) / 0.455)
    label = rows.series * (block.max() + 1) + block
    number = np.unique(label, return_inverse=True)[1]
    power = np.bincount(number, rows.y**2) / np.bincount(number)
    order, ends = np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))
    for place in np.flatnonzero(power > (NEAR * max(LARGE, ABOVE * usual)) ** 2):
        mine = order[ends[place - 1] if place else 0 : ends[place]]
        size = float(np.sqrt(np.mean(rows.y[mine] ** 2)))
        name = part.place_in_room(rows.series[mine][0])
        if name and len(mine) >= 3 and size > max(LARGE, ABOVE * usual):
            first = block[mine][0] * BLOCK
            x, y, z = rows.place[mine].mean(axis=0)
            yield (
                size,
                (
                    f"{name} from {first:.0f} to {first + BLOCK:.0f} s{of}, around ({x:.1f}, "
                    f"{y:.1f}, {z:.1f}) m"
                ),
            )
