"""How far anchors may be from where a fit with ground truth puts them: deviations that hold.

A fit states how well the data determine its values, if its model is the right one. Positions and
delays of anchors take what other systematic errors leave unexplained, in the same way at every
place, so that no scatter between blocks of time shows it. So they are fitted once more, with the
information that errors leave which last as long as the flight, beside what can take their place: a
smooth function of the place for every anchor, as large as the evidence says, as what an antenna
adds in each direction is; and coordinates and delays of anchors that the fit takes for zero.
Coordinates may be off by COORDINATE_STDS, each as probable as the data make it, delays by UNSAID.
All these are integrated out. What a value is away from that counts as its error.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects.samples import RADIO
from uwb_tdoa_ekf.evidence import DELAY, OF_ANCHORS, POSITION, Part, eliminated

from .regression.algebra import beside_each_other, counts, each_times, product, weighted
from .regression.fit import in_common, prior_sizes
from .self_calibration.equations import features
from .self_calibration.prior import FUNCTION_STDS, posterior

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .regression.fit import Fit
    from .regression.select import Selection
    from .regression.table import RegressionTable
    from .regression.terms import Column
    from .self_calibration.prior import Solution

# m over which functions of the place change; the shift of an anchor makes errors that change as
# slowly
LENGTH = 4.0
UNSAID = 0.03  # m, that coordinates and delays may be off by, of which no anchor has any in the fit
COORDINATE_STDS = 0.001, 0.003, 0.01, UNSAID  # m, the same of coordinates: the data show how much
SAME = 1e-4  # m, by which that mean may differ from zero
# take what other errors leave that last as long as the flight
LASTS = (*OF_ANCHORS, "tag_lever_arm")
LASTING = 14.0  # by which errors that are alike for a while are alike for longer than blocks tell


def with_deviations(selection: Selection) -> Selection:
    """The Selection with standard deviations of positions and delays of anchors, and of the place
    of the antenna, that hold; as it is where there are none, or where the path is not known.
    """
    table, model = selection.table, selection.fit
    places = [k for k, column in enumerate(model.columns) if column.effect[0] in LASTS]
    if not places or any(part.innovations is not None for part in table.radio_parts):
        return selection
    away, covariance = _beside_others(table, model)
    apart = np.eye(len(away)) - in_common(table, model.columns)
    fitted, std = np.sqrt(np.diag(model.cov)), np.sqrt(np.diag(apart @ covariance @ apart))
    grow = np.ones(len(fitted))
    grow[places] = (np.maximum(fitted, np.hypot(std, apart @ away)) / fitted)[places]
    return replace(selection, fit=replace(model, cov=model.cov * np.outer(grow, grow)))


def _beside_others(table: RegressionTable, model: Fit) -> tuple[np.ndarray, np.ndarray]:
    """(by how much the values are others (k,), their covariance (k, k)) of the columns of a Fit,
    with what can take the place of anchors integrated out.
    """
    rows, known, near = (
        table.radio_rows,
        {column.effect for column in model.columns},
        _heard_with(table, model),
    )
    mine = table.matrix(model.columns, rows)
    beside = [
        column
        for column in table.columns
        if column.effect in ((POSITION,), (DELAY,)) and (near is None or _anchor(column) in near)
    ]
    others = [column for column in beside if column not in model.columns]
    free = np.array(
        [column.effect == (POSITION,) and column.effect not in known for column in others]
    )
    sizes = np.array([column.typical if column.effect in known else UNSAID for column in others])
    late = table.matrix([column for column in beside if column.effect == (DELAY,)], rows)
    if table.sparse:  # other rows have nothing to do with these anchors
        ends = np.array([RADIO[name].ends if name in RADIO else 0 for name in table.channels])
        inside = np.flatnonzero(counts(late, 1) == ends[table.channel[rows]])
        rows, late, mine = rows[inside], late[inside], mine[inside]
    functions = each_times(late, features(table.place[rows], LENGTH))
    lasting = 1.0 + LASTING * (model.inflation[table.group[rows]] - 1.0)
    weight = model.information(table)[rows] * (model.inflation[table.group[rows]] / lasting)
    x = beside_each_other([mine, table.matrix(others, rows), functions])
    gram, vector, n = product(weighted(x, weight), x), x.T @ (weight * table.y[rows]), mine.shape[1]
    unwritten = _common_delay(table, [*model.columns, *others], n)
    gram[: len(unwritten), : len(unwritten)] += np.outer(unwritten, unwritten) / SAME**2
    prior = np.diag(prior_sizes(model.columns) ** 2.0)

    def solution(coordinate: float, function: float) -> Solution:
        std = [np.where(free, coordinate, sizes), np.full(functions.shape[1], function)]
        part = Part(*eliminated(gram, vector, n, np.concatenate(std)), function)
        return posterior(part, prior, np.zeros(n))

    several = [
        max((solution(std, size) for size in FUNCTION_STDS), key=lambda one: one.evidence)
        for std in (COORDINATE_STDS if free.any() else (UNSAID,))
    ]
    evidences = np.array([one.evidence for one in several])
    shares = np.exp(evidences - evidences.max()) / np.exp(evidences - evidences.max()).sum()
    steps, covariances = (
        np.stack([getattr(one, name) for one in several]) for name in ("step", "covariance")
    )
    step = shares @ steps
    spread = (steps - step).T @ (shares[:, None] * (steps - step))
    return step - model.beta, np.tensordot(shares, covariances, axes=1) + spread


def _common_delay(table: RegressionTable, columns: Sequence[Column], n: int) -> np.ndarray:
    """(k,), what makes of values of Columns the mean of the delays beyond the first n, those that a
    fit takes for zero; 0 where the fit has none or all delays, or where what all have in common
    does not cancel. A delay in the fit is the difference from this mean.
    """
    late = np.array([column.effect == (DELAY,) for column in columns])
    beyond = late & (np.arange(len(columns)) >= n)
    some = late[:n].any() and beyond.any() and in_common(table, columns)[late].any()
    return beyond / max(beyond.sum(), 1) * some


def _anchor(column: Column) -> str:
    """Id of the anchor that a Column of a position or a delay is of: text."""
    return column.key.partition(".")[0]


def _heard_with(table: RegressionTable, model: Fit) -> set[str] | None:
    """Ids of the anchors whose positions or delays a Fit determines, and of all that are heard in
    the same blocks as any of them: set of texts. None for all anchors: of few, or of several
    installations.
    """
    parts = table.radio_parts
    ids = parts[0].samples.anchors.ids
    if not table.sparse or not all(np.array_equal(part.samples.anchors.ids, ids) for part in parts):
        return None
    known, rows = (
        {_anchor(column) for column in model.columns if column.effect[0] in OF_ANCHORS},
        table.radio_rows,
    )
    ends, block, names = (
        np.stack(parts[0].arrivals(table.series[rows])),
        table.block[rows],
        ids.astype(str),
    )
    mine = np.isin(names, list(known))[ends].any(axis=0)
    return known | set(names[np.unique(ends[:, np.isin(block, block[mine])])].tolist())
