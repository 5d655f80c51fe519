# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute realistic standard deviations of anchor parameters fitted with ground truth.

The covariance of a fit assumes a correct model. Positions and delays of anchors absorb other
systematic errors. These errors are equal at each place, so no scatter between blocks of time shows
them. A second fit uses the information that remains if errors last as long as the flight. It
marginalizes parameters that can replace anchor errors. One kind is a smooth function of the place
for each anchor, such as an antenna's directional error. The other kind are coordinates and delays
that the fit sets to 0. The evidence selects the size of the functions. Unfitted coordinates have
standard deviations COORDINATE_STDS, weighted by evidence; delays have UNSAID. The difference
between both fits counts as an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import softmax

from uwb_tdoa_bias.effects.samples import RADIO
from uwb_tdoa_ekf.evidence import DELAY, OF_ANCHORS, POSITION, Part, eliminated

from .regression.algebra import beside_each_other, counts, each_times, product, weighted
from .regression.fit import Fit, in_common, prior_sizes, refit
from .regression.select import Selection
from .regression.table import RegressionTable
from .regression.terms import Column
from .self_calibration.equations import features
from .self_calibration.prior import FUNCTION_STDS, Solution, posterior

# m, length scale of functions of the place; the error of an anchor shift varies equally slowly
LENGTH = 4.0
# m, prior standard deviation of coordinates and delays if the fit has none of that kind
UNSAID = 0.03
# m, the same for coordinates; the evidence weights them
COORDINATE_STDS = 0.001, 0.003, 0.01, UNSAID
SAME = 1e-4  # m, prior standard deviation of the mean of the delays
# effects that absorb errors as long as the flight
LASTS = (*OF_ANCHORS, "tag_lever_arm")
# factor on the excess inflation: errors correlated within a block last longer than blocks show
LASTING = 14.0


def with_deviations(selection: Selection) -> Selection:
    """Return the Selection with realistic standard deviations of anchors and of the lever arm.

    It stays unchanged without such parameters, or if the path is unknown.
    """
    table, model = selection.table, selection.fit
    places = [k for k, column in enumerate(model.columns) if column.effect[0] in LASTS]
    if not places or any(part.innovations is not None for part in table.radio_parts):
        return selection
    others, covariance = _beside_others(table, model)
    apart = np.eye(len(others)) - in_common(table, model.columns)
    # values that are applied have a tighter prior, and are nearer to the others
    several = model.beta, refit(table, model.columns, model).beta
    away = np.max([np.abs(apart @ (others - beta)) for beta in several], axis=0)
    fitted, std = np.sqrt(np.diag(model.cov)), np.sqrt(np.diag(apart @ covariance @ apart))
    grow = np.ones(len(fitted))
    grow[places] = (np.maximum(fitted, np.hypot(std, away)) / fitted)[places]
    return replace(selection, fit=replace(model, cov=model.cov * np.outer(grow, grow)))


def _beside_others(table: RegressionTable, model: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return other values of the columns of a Fit (k,), and their covariance (k, k).

    Parameters that can replace anchor errors are marginalized.
    """
    rows = table.radio_rows
    known = {column.effect for column in model.columns}
    near = _heard_with(table, model)
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
    if table.sparse:  # other rows do not depend on these anchors
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
    shares = softmax([one.evidence for one in several])
    steps = np.stack([one.step for one in several])
    covariances = np.stack([one.covariance for one in several])
    step = shares @ steps
    spread = (steps - step).T @ (shares[:, None] * (steps - step))
    return step, np.tensordot(shares, covariances, axes=1) + spread


def _common_delay(table: RegressionTable, columns: Sequence[Column], n: int) -> np.ndarray:
    """Return the row that gives the mean of the unfitted delays, (k,).

    A fitted delay is the difference from this mean. The row is 0 if the fit has no delay, or all
    delays. It is also 0 if a common delay does not cancel.

    columns : k Columns; n : number of fitted ones, which come first
    """
    late = np.array([column.effect == (DELAY,) for column in columns])
    beyond = late & (np.arange(len(columns)) >= n)
    some = late[:n].any() and beyond.any() and in_common(table, columns)[late].any()
    return beyond / max(beyond.sum(), 1) * some


def _anchor(column: Column) -> str:
    """Return the id, as text, of the anchor of a position or delay."""
    return column.key.partition(".")[0]


def _heard_with(table: RegressionTable, model: Fit) -> set[str] | None:
    """Return ids of anchors with fitted positions or delays, and of anchors in the same blocks.

    None means all anchors: with few anchors, or several installations.
    """
    parts = table.radio_parts
    ids = parts[0].samples.anchors.ids
    if not table.sparse or not all(np.array_equal(part.samples.anchors.ids, ids) for part in parts):
        return None
    known = {_anchor(column) for column in model.columns if column.effect[0] in OF_ANCHORS}
    rows, names = table.radio_rows, ids.astype(str)
    ends, block = np.stack(parts[0].arrivals(table.series[rows])), table.block[rows]
    mine = np.isin(names, list(known))[ends].any(axis=0)
    return known | set(names[np.unique(ends[:, np.isin(block, block[mine])])].tolist())
