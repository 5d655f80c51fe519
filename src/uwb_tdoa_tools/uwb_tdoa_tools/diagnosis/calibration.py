"""What may be applied without a reference: positions and delays of all anchors together, or nothing.

A model of a whole catalogue, fitted without a reference, pushes the path to where its maps make innovations small. The
installation alone is what innovations can tell (`self_survey.py`). Where something else is wrong as well, that takes the
place of the shifts and delays that it looks like, and the position gets worse. It shows in what is left: so nothing is
applied then.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EffectSet

from .prior import DELAY, POSITION
from .regression.fit import MIN_BLOCKS, fit
from .regression.select import Selection
from .regression.table import BLOCK, table_of
from .regression.terms import columns_of
from .self_survey import FEWEST, survey, to_keep

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from uwb_tdoa_bias.effects import Effect
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig
    from ..parallel import MapFunction
    from .attribution import Attribution
    from .constraints import Constraint
    from .self_survey import Change

CALIBRATED = POSITION, DELAY
POSITION_STD = 0.1  # m, of the coordinates of anchors as they are given
LEFT = 0.055  # m that may be left of slow innovations
NEARER = 0.75  # share of marks, each left out once, at which the estimate must come nearer
EXPLAINED = 0.1  # share of the slow innovations that must be explained


@dataclass(frozen=True, eq=False)
class Calibration:
    """selection : Selection of all positions and delays of anchors; left : m, scale of the slow innovations that they leave;
    explained : share of them that they explain; long_enough : whether the flights can tell; marks : as of Surveyed;
    changes : (Change, ...) since the last calibration."""

    selection: Selection
    left: float
    explained: float
    long_enough: bool
    marks: tuple[float, float, float] | None = None
    changes: tuple[Change, ...] = ()

    @property
    def why_not(self) -> str | None:
        """Why it must not be applied; None if it may."""
        if not self.long_enough:
            return f"the flights are too short: {MIN_BLOCKS * BLOCK:g} s in the air are needed without ground truth"
        if self.marks:
            return why_marks_speak_against(self.marks)
        if self.left > LEFT:
            return (
                f"positions and delays of anchors leave {100 * self.left:.1f} cm of what is slow in the innovations, more than "
                f"{100 * LEFT:.1f} cm: something else is wrong too, and the position would suffer; fly where it is known"
            )
        if self.explained < EXPLAINED:
            return f"positions and delays of anchors explain {self.explained:.0%} of what is slow in the innovations"
        return None


def calibrate(
    flights: Sequence[Flight], attribution: Attribution, base: EffectSet, config: FilterConfig | None = None,
    constraints: Sequence[Constraint] = (), progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> Calibration:  # fmt: skip
    """Calibration from the innovations of prepared Flights. attribution : Attribution of them; base : EffectSet that is in the
    model, its covariance the prior; config : FilterConfig; constraints : what else is known; map_function : as of
    `attribution.attribute`."""
    candidates = attribution.candidates
    whole = {candidate.name: candidate for candidate in reversed(candidates)}  # the first of an effect is all of it
    chosen = tuple(whole[name] for name in CALIBRATED)
    table = table_of(attribution.residuals).with_terms([term for candidate in candidates for term in candidate.terms])
    table = table.rows((table.channel == table.channels.index("tdoa")) & (table.count >= FEWEST))
    anchors = flights[0].anchors
    found = survey(flights, np.full((len(anchors), 3), POSITION_STD), base, config, constraints, progress, map_function)
    columns = columns_of(chosen)
    keys = [*(f"{i}.{axis}" for i in anchors.ids for axis in "xyz"), *map(str, anchors.ids)]
    places = [keys.index(column.key) for column in columns]
    shifts = (found.anchors.positions - anchors.positions).ravel()
    beta, cov = np.concatenate([shifts, found.delays])[places], found.covariance[np.ix_(places, places)]
    fitted = replace(fit(table, columns), beta=beta, cov=cov, residual=table.y - table.matrix(columns) @ beta)
    selection = Selection(table, chosen, fitted, (0.0,) * len(chosen), ((),) * len(chosen))
    explained, long_enough = 1.0 - (found.left / found.before) ** 2, len(np.unique(table.block)) >= MIN_BLOCKS
    return Calibration(selection, found.left, explained, long_enough, found.marks, found.changes)


def why_marks_speak_against(marks: tuple[float, float, float]) -> str | None:
    """Why a survey must not be applied, after what its marks say, each left out once; None if it may: the estimate must come nearer
    to them on average, and to NEARER of them. marks : of Surveyed."""
    before, after, nearer = marks
    if after < before and nearer >= NEARER:
        return None
    return (
        f"at marks, each left out once, the estimate is off by {100 * before:.1f} cm with the anchors as given, and by {100 * after:.1f} cm with "
        f"others, and nearer at {nearer:.0%} of them: the position would suffer; measure more marks, or fly where it is known"
    )


def merged(base: EffectSet, found: Sequence[Effect], selection: Selection) -> EffectSet:
    """The EffectSet `base` with other Effects: positions and delays of anchors are added to those it has. Their covariance is
    that of the fit of a Selection, and is the prior of the next calibration."""
    effects = list(base.effects)
    for effect in found:
        same = next((k for k, one in enumerate(effects) if one.name == effect.name and effect.name in CALIBRATED), None)
        if same is None:
            effects.append(effect)
            continue
        values = {key: effects[same].values.get(key, 0.0) + value for key, value in effect.values.items()}
        known = effects[same]
        effects[same] = replace(effect, values={**known.values, **values}, std={**known.std, **effect.std})
    columns = [column for candidate in selection.chosen if candidate.name in CALIBRATED for column in candidate.columns]
    if not columns:
        return EffectSet(tuple(effects), base.covariance)
    places = [selection.fit.columns.index(column) for column in columns]
    keys = tuple((str(column.effect[0]), column.key) for column in columns)
    return EffectSet(tuple(effects), to_keep(keys, selection.fit.cov[np.ix_(places, places)]))
