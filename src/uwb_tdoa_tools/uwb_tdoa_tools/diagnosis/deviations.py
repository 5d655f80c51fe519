"""How far anchors may be from where a fit with ground truth puts them: deviations that hold.

A fit states how well the data tell its values, if its model is the right one. Positions and delays of anchors take what other
systematic errors leave unexplained, in the same way at every place, so that no scatter between blocks of time shows it. So they
are fitted once more, with the information that errors leave which last as long as the flight, beside what can take their place: a
smooth function of the place for every anchor, as large as the evidence says, as what an antenna adds in each direction is; and
coordinates and delays of anchors that the fit takes for zero. All these are integrated out. What a value is away from that counts as its error.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .prior import DELAY, FUNCTION_STDS, POSITION, eliminated, posterior
from .regression.fit import prior_sizes
from .self_survey import features

if TYPE_CHECKING:
    from .prior import Solution
    from .regression.fit import Fit
    from .regression.select import Selection
    from .regression.table import Table

LENGTH = 4.0  # m over which functions of the place change; the shift of an anchor makes errors that change as slowly
UNSAID = 0.03  # m, that coordinates and delays may be off by, of which no anchor has any in the fit
LASTING = 14.0  # by which errors that are alike for a while are alike for longer than blocks tell
OF_ANCHORS = POSITION, DELAY


def with_deviations(selection: Selection) -> Selection:
    """The Selection with standard deviations of positions and delays of anchors that hold; as it is where there are none, or where
    the path is not known."""
    table, model = selection.table, selection.fit
    places = [k for k, column in enumerate(model.columns) if column.effect[0] in OF_ANCHORS]
    if not places or any(part.innovations is not None for part in table.tdoa_parts):
        return selection
    values, std = _beside_others(table, model)
    fitted = np.sqrt(np.diag(model.cov))
    grow = np.ones(len(fitted))
    grow[places] = (np.maximum(fitted, np.hypot(std, values - model.beta)) / fitted)[places]
    return replace(selection, fit=replace(model, cov=model.cov * np.outer(grow, grow)))


def _beside_others(table: Table, model: Fit) -> tuple[np.ndarray, np.ndarray]:
    """(values (k,), standard deviations (k,)) of the columns of a Fit, with what can take the place of anchors integrated out."""
    rows, known = table.rows_of("tdoa"), {column.effect for column in model.columns}
    others = [column for column in table.columns if column.effect in ((POSITION,), (DELAY,)) and column not in model.columns]
    sizes = [column.typical if column.effect in known else UNSAID for column in others]
    late = table.matrix([column for column in table.columns if column.effect == (DELAY,)], rows)
    functions = (late[:, :, None] * features(table.place[rows], LENGTH)[:, None, :]).reshape(len(late), -1)
    lasting = 1.0 + LASTING * (model.inflation[table.group[rows]] - 1.0)
    weight = model.information(table)[rows] * (model.inflation[table.group[rows]] / lasting)
    mine = table.matrix(model.columns, rows)
    x = np.concatenate([mine, table.matrix(others, rows), functions], axis=1)
    gram, vector, n = (x * weight[:, None]).T @ x, x.T @ (weight * table.y[rows]), mine.shape[1]
    prior = np.diag(prior_sizes(model.columns) ** 2.0)

    def beside(size: float) -> Solution:
        return posterior(*eliminated(gram, vector, n, np.append(sizes, np.full(functions.shape[1], size))), prior, np.zeros(n))

    best = max(map(beside, FUNCTION_STDS), key=lambda one: one.evidence)
    return best.step, np.sqrt(np.diag(best.covariance))
