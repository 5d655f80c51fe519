# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""List estimated positions and delays of anchors.

The values fit the data. They do not replace a survey.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.evidence import DELAY, POSITION

from .tables import Table

if TYPE_CHECKING:
    from ..result import Diagnosis

TITLE = "Values that make these data fit; measure again before you move an anchor"
HEAD = ("anchor", "x, cm", "y, cm", "z, cm", "late by, cm")
SURE = 2.0  # standard deviations of a value that is not marked with "?"


def rows(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the rows of a table, [[cell]]; [] without estimated positions or delays.

    The first row holds the entries of HEAD with values. Each further row is an anchor.
    """
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for finding in diagnosis.findings:
        if (
            finding.effect.name in (POSITION, DELAY)
            and not finding.on_floor
            and finding.flight is None
        ):
            for key, value in finding.effect.values.items():
                anchor, _, axis = key.partition(".")
                found.setdefault(anchor, {})[axis] = value, finding.effect.std.get(key, np.nan)
    cells = [
        [anchor, *(_cell(found[anchor].get(axis)) for axis in ("x", "y", "z", ""))]
        for anchor in sorted(found, key=int)
    ]
    filled = [column for column in zip(HEAD, *cells) if any(column[1:])]
    return [list(row) for row in zip(*filled)]


def _cell(known: tuple[float, float] | None) -> str:
    if known is None:
        return ""
    value, std = known
    sure = abs(value) >= SURE * std
    return f"{100.0 * value:+.0f} ± {100.0 * std:.0f}{'' if sure else ' ?'}"


def lines(diagnosis: Diagnosis) -> list[str]:
    """Return the table as lines for the screen."""
    several = rows(diagnosis)
    if not several:
        return []
    return [
        f"{TITLE} (? less than {SURE:g} standard deviations):",
        *("".join(f"{cell:>12s}" for cell in row) for row in several),
    ]


def table(diagnosis: Diagnosis) -> Table:
    """Return the table for the page."""
    several = rows(diagnosis)
    return Table(several[0], several[1:], range(1, len(several[0]))) if several else Table()
