"""How far anchors may be from where a fit with ground truth puts them: deviations that hold.

A fit states how well the data tell its values, if its model is the right one. Positions and delays of anchors take what other
systematic errors leave unexplained, in the same way at every place, so that no scatter between blocks of time shows it. So they
are fitted once more, beside everything in the catalogue and a smooth function of the place for every anchor, which are integrated
out, as large as the evidence says, and with the information that errors leave which last as long as the flight. What a value is away
from that counts as its error.
"""

from dataclasses import replace

import numpy as np

from .prior import DELAY, POSITION, eliminated, posterior
from .regression.fit import prior_sizes
from .self_survey import features

SIZES = 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.0  # of plausible ones, that all others may have together: the evidence chooses
FUNCTION = 0.1  # m, plausible size of functions of the place
LASTING = 14.0  # by which errors that are alike for a while are alike for longer than blocks tell
OF_ANCHORS = POSITION, DELAY


def with_deviations(selection):
    """The Selection with standard deviations of positions and delays of anchors that hold; as it is where there are none, or where
    the path is not known."""
    table, model = selection.table, selection.fit
    places = [k for k, column in enumerate(model.columns) if column.effect[0] in OF_ANCHORS]
    if not places or any(getattr(part, "innovations", None) is not None for *_, part in table.parts):
        return selection
    values, std = _beside_all(table, model)
    fitted = np.sqrt(np.diag(model.cov))
    grow = np.ones(len(fitted))
    grow[places] = (np.maximum(fitted, np.hypot(std, values - model.beta)) / fitted)[places]
    return replace(selection, fit=replace(model, cov=model.cov * np.outer(grow, grow)))


def _beside_all(table, model):
    """(values (k,), standard deviations (k,)) of the columns of a Fit, with all else that shows on TDOAs integrated out."""
    rows = table.rows_of("tdoa")
    anchors = [column for column in table.columns if column.effect == (DELAY,)]
    others = [column for column in table.columns if len(column.effect) == 1 and column not in model.columns]
    others = [column for column in others if np.any(table.columns[column][rows])]
    mine, rest = table.matrix(model.columns, rows), table.matrix(others, rows)
    late = table.matrix(anchors, rows)
    functions = (late[:, :, None] * features(table.place[rows])[:, None, :]).reshape(len(late), -1)
    rest = np.concatenate([rest, functions], axis=1)
    sizes = np.concatenate([prior_sizes(others), np.full(functions.shape[1], FUNCTION)])
    lasting = 1.0 + LASTING * (model.inflation[table.group[rows]] - 1.0)
    weight = model.information(table)[rows] * (model.inflation[table.group[rows]] / lasting)
    x = np.concatenate([mine, rest], axis=1)
    gram, vector, n = (x * weight[:, None]).T @ x, x.T @ (weight * table.y[rows]), mine.shape[1]
    prior = np.diag(prior_sizes(model.columns) ** 2.0)
    found = [posterior(*eliminated(gram, vector, n, size * sizes), prior, np.zeros(n)) for size in SIZES]
    best = max(found, key=lambda one: one.evidence)
    return best.step, np.sqrt(np.diag(best.covariance))
