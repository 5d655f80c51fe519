"""Positions and delays of anchors that were found: values that make the data fit, which is not the
same as a survey.
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
SURE = 2.0  # standard deviations from which a value is marked


def rows(diagnosis: Diagnosis) -> list[list[str]]:
    """[[cell]] of a table, those of HEAD first that have any value, then a row for each anchor of
    which a position or a delay was found; [] without any.
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
    """The same for the screen."""
    several = rows(diagnosis)
    if not several:
        return []
    return [
        f"{TITLE} (? less than {SURE:g} standard deviations):",
        *("".join(f"{cell:>12s}" for cell in row) for row in several),
    ]


def table(diagnosis: Diagnosis) -> Table:
    """The same for the page."""
    several = rows(diagnosis)
    return Table(several[0], several[1:], range(1, len(several[0]))) if several else Table()
