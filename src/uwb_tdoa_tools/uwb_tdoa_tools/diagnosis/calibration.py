"""Where anchors stand and how late they are, from flights of which nobody knows the path.

A model of a whole catalogue, fitted without a reference, pushes the path to where its maps make innovations small. The
installation alone, positions and delays of all anchors together, with priors, is what innovations can tell: the path is
integrated out (`uwb_tdoa_ekf/sensitivity.py`). Where something else is wrong as well, that takes the place of the shifts
and delays that it looks like, and the position gets worse. It shows in what is left: so nothing is applied then.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from .regression.fit import MIN_BLOCKS, fit
from .regression.select import Selection
from .regression.table import BLOCK, table_of
from .regression.terms import columns_of

FEWEST = 4  # TDOAs in a cell; noise of fewer hides what is slow
SYSTEMATIC = 10.0  # by which the information is divided beside what blocks tell: errors that last are no noise
LEFT = 0.055  # m that may be left of slow innovations
EXPLAINED = 0.1  # share of the slow innovations that must be explained


@dataclass(frozen=True, eq=False)
class Calibration:
    """selection : Selection of all positions and delays of anchors; left : m, scale of the slow innovations that they leave;
    explained : share of them that they explain; long_enough : whether the flights can tell."""

    selection: Selection
    left: float
    explained: float
    long_enough: bool

    @property
    def why_not(self):
        """Why it must not be applied; None if it may."""
        if not self.long_enough:
            return f"the flights are too short: {MIN_BLOCKS * BLOCK:g} s in the air are needed without ground truth"
        if self.explained < EXPLAINED:
            return f"positions and delays of anchors explain {self.explained:.0%} of what is slow in the innovations"
        if self.left > LEFT:
            return (
                f"positions and delays of anchors leave {100 * self.left:.1f} cm of what is slow in the innovations, more than "
                f"{100 * LEFT:.1f} cm: something else is wrong too, and the position would suffer; fly where it is known"
            )
        return None


def calibrate(residuals, candidates):
    """Calibration from [{channel: ChannelResidual}] that are innovations, and the declared Candidates."""
    whole = {candidate.name: candidate for candidate in reversed(candidates)}  # the first of an effect is all of it
    chosen = tuple(each for each in whole.values() if each.terms[0].effect.calibration_prior is not None)
    channel = chosen[0].channels[0]
    table = table_of(residuals).with_terms([term for candidate in candidates for term in candidate.terms])
    columns = columns_of(chosen)
    sizes = np.array([term.effect.calibration_prior for each in chosen for term in each.terms for _ in term.columns])
    crowded = _rows(table, (table.channel == table.channels.index(channel)) & (table.count >= FEWEST))
    inflation = fit(crowded, columns, sizes=sizes).inflation
    fitted = fit(crowded, columns, SYSTEMATIC * inflation, sizes)
    before, after = (np.mean(np.clip(values, -1.0, 1.0) ** 2) for values in (crowded.y, fitted.residual))
    selection = Selection(crowded, chosen, fitted, (0.0,) * len(chosen), ((),) * len(chosen))
    left = float(fitted.scale[crowded.channels.index(channel)])
    return Calibration(selection, left, float(1.0 - after / before), len(np.unique(crowded.block)) >= MIN_BLOCKS)


def _rows(table, chosen):
    """Table of some rows, (n,) bool, with the columns that it has."""
    each = ("y", "channel", "series", "block", "flight", "t", "count", "place", "x")
    return replace(table, **{field.name: getattr(table, field.name)[chosen] for field in fields(table) if field.name in each})
