# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit a RegressionTable robustly, and compute the likelihood of a fit.

Noise is Student's t with NU degrees of freedom. The fit uses iteratively re-weighted least squares
(Lange, Little and Taylor, JASA 1989). Rows are not independent. Each axis of a channel has its
scale. The information of each channel is divided by an inflation, measured on residuals of blocks
of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from uwb_tdoa_ekf.evidence import POSITION

from .algebra import counts, dense, product, sums_by, weighted
from .table import AXES, RegressionTable
from .terms import Column

CANCELS = 1e-9  # smallest sum of regressors of an effect that does not cancel, in the unit of a row
NU = 4.0  # degrees of freedom of Student's t
ITERATIONS = 12  # largest number of re-weighted least squares
MIN_BLOCKS = 6  # fewest blocks for a sandwich covariance and for the correlation within blocks
LONGEST_MEMORY = 3.0  # s, longest lag of the autocorrelation of a series
# m, largest prior standard deviation of a coordinate of an anchor in a model that is applied:
# positions absorb errors that other flights have elsewhere
APPLIED_STD = 0.08
# share of rows in which a column is not 0; fewer do not show correlation between blocks
LASTING = 0.1


@dataclass(frozen=True, eq=False)
class Fit:
    """A robust linear fit.

    columns : k Columns; beta : (k,) their values, in the units of the parameters
    cov : (k, k) sandwich covariance over blocks of time, at least the covariance of the model
    residual : (n,) in the unit of each row; weight : (n,) robust weight, 0 to 1.25
    scale : (groups,) scale of Student's t of a row; inflation : (groups,) variance inflation, 1 for
        independent rows
    size : (groups,) effective number of rows
    """

    columns: tuple[Column, ...]
    beta: np.ndarray
    cov: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    scale: np.ndarray
    inflation: np.ndarray
    size: np.ndarray

    def information(self, table: RegressionTable) -> np.ndarray:
        """Return the information of each row of the RegressionTable, (n,).

        It is the number of independent rows per squared unit of the row.
        """
        return self.weight / (self.scale**2 * self.inflation)[table.group]

    def likelihood(self, table: RegressionTable) -> float:
        """Return twice the log-posterior of the fit, up to a constant.

        It is Student's t likelihood of the rows and the Gaussian prior of beta. Each row counts as
        1 / inflation independent rows.
        """
        scale = self.scale[table.group]
        rows = 2.0 * np.log(scale) + (NU + 1.0) * np.log1p((self.residual / scale) ** 2 / NU)
        return -float(
            np.sum(rows / self.inflation[table.group])
            + np.sum((self.beta / prior_sizes(self.columns)) ** 2)
        )

    def values(self, columns: Sequence[Column]) -> np.ndarray:
        """Return beta of some Columns, (k,)."""
        place = {column: k for k, column in enumerate(self.columns)}
        return self.beta[[place[column] for column in columns]]


def solve(
    gram: np.ndarray, vector: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Solve normal equations with a Gaussian prior of mean 0.

    A direction that the data do not determine stays at 0.

    gram : (k, k) information; vector : (k,); sizes : (k,) standard deviations of the prior
    returns : beta (k,), covariance (k, k), and the effective number of parameters (trace of the
        resolution matrix)
    """
    if len(vector) == 0:
        return vector, np.zeros((0, 0)), 0.0
    scaled = gram * np.outer(sizes, sizes) + np.eye(len(vector))
    inverse = np.linalg.inv(scaled)
    cov = inverse * np.outer(sizes, sizes)
    return cov @ vector, cov, float(len(vector) - np.trace(inverse))


def _solution(gram: np.ndarray, vector: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return beta of `solve` by a Cholesky factor, in a third of the time."""
    return sizes * cho_solve(
        cho_factor(
            gram * np.outer(sizes, sizes) + np.eye(len(vector)),
            overwrite_a=True,
            check_finite=False,
        ),
        sizes * vector,
    )


def prior_sizes(columns: Sequence[Column]) -> np.ndarray:
    """Return the standard deviations of the priors of Columns, (k,), in their units."""
    return np.array([column.typical for column in columns])


def fit(
    table: RegressionTable,
    columns: Sequence[Column],
    inflation: np.ndarray | None = None,
    covariance: bool = True,
    near: Fit | None = None,
) -> Fit:
    """Fit some Columns to a RegressionTable by iteratively re-weighted least squares.

    inflation : (groups,) variance inflation; None measures it on the residual of this fit
    covariance : whether to compute the covariance
    near : Fit of nearly the same Columns; a sparse fit starts at its residual
    """
    x, group, sizes = table.matrix(columns), table.group, prior_sizes(columns)
    weight, beta = np.ones(len(table.y)), np.zeros(len(columns))
    residual = table.y.copy() if near is None or not table.sparse else near.residual.copy()
    for step in range(ITERATIONS):
        scale = _scales(table, residual)
        # Weights of Student's t likelihood (Lange, Little and Taylor 1989).
        weight = (NU + 1.0) / (NU + (residual / scale[group]) ** 2)
        if not columns:
            if step:
                break
            continue
        root = weight / scale[group] ** 2
        root /= 1.0 if inflation is None else inflation[group]
        beta = _solution(product(weighted(x, root), x), x.T @ (root * table.y), sizes)
        change = residual - (table.y - x @ beta)
        residual = residual - change
        if np.all(np.abs(change) < 0.01 * scale[group]):
            break
    if inflation is None:
        inflation = _median_of_axes(
            table, measure_inflation(table, residual, weight, scale, columns)
        )
    root = weight / (scale[group] ** 2 * inflation[group])
    cov = (
        _covariance(table, columns, residual, root) if columns and covariance else np.zeros((0, 0))
    )
    size = np.bincount(group, minlength=len(scale)) / inflation
    return Fit(tuple(columns), beta, cov, residual, weight, scale, inflation, np.maximum(size, 1.0))


def refit(
    table: RegressionTable,
    columns: Sequence[Column],
    model: Fit,
    rows: np.ndarray | None = None,
    share: float | None = None,
) -> Fit:
    """Fit some Columns with the weights and scales of another Fit.

    rows : (n,) bool, rows that determine beta; None for all. With rows, the covariance is the
        covariance of the model.
    share : of the values that is applied, fitted with a prior of APPLIED_STD for positions of
        anchors; None for the values of the search
    """
    x, sizes, root = table.matrix(columns), prior_sizes(columns), model.information(table)
    if share is not None:
        moved = [column.effect == (POSITION,) for column in columns]
        sizes = np.where(moved, np.minimum(sizes, APPLIED_STD), sizes)
    some = slice(None) if rows is None else rows
    xw = weighted(x[some], root[some])
    beta, cov, _ = solve(product(xw, x[some]), xw.T @ table.y[some], sizes)
    beta = beta if share is None else share * beta
    residual = table.y - x @ beta
    if rows is None and columns:
        cov = _covariance(table, columns, residual, root)
    elif columns:
        apart = np.eye(len(columns)) - in_common(table, columns)
        cov = apart @ cov @ apart
    return replace(model, columns=tuple(columns), beta=beta, cov=cov, residual=residual)


def mean_of(fits: Sequence[Fit], weights: Sequence[float]) -> Fit:
    """Return the weighted sum of Fits of one RegressionTable; a Column that one lacks counts as 0.

    weights : of sum 1. The covariance is at least that of this sum.
    """
    columns = list(dict.fromkeys(column for one in fits for column in one.columns))
    beta, cov = np.zeros(len(columns)), np.zeros((len(columns), len(columns)))
    for one, weight in zip(fits, weights):
        at = [columns.index(column) for column in one.columns]
        beta[at] += weight * one.beta
        cov[np.ix_(at, at)] += abs(weight) * one.cov
    residual = np.tensordot(weights, [one.residual for one in fits], axes=1)
    return replace(fits[0], columns=tuple(columns), beta=beta, cov=cov, residual=residual)


def _scales(table: RegressionTable, residual: np.ndarray) -> np.ndarray:
    """Return the scale of Student's t per group by the fixed point of its likelihood, (groups,)."""
    out = np.ones(AXES * len(table.channels))
    for k, rows in table.groups:
        out[k] = student_scale(residual[rows])
    return out


def student_scale(r: np.ndarray) -> float:
    """Return the scale of Student's t for residuals r (n,), in their unit."""
    scale, square = max(1.4826 * np.median(np.abs(r)), 1e-9), r * r
    for _ in range(15):
        mean = (square / (NU + square / scale**2)).sum() / len(r)
        scale = max(np.sqrt((NU + 1.0) * mean), 1e-9)
    return scale


def in_common(table: RegressionTable, columns: Sequence[Column]) -> np.ndarray:
    """Return the projection onto means of parameters that cancel in every row, (k, k).

    Example: a common delay of all anchors cancels in every TDOA. The fit leaves this mean at 0, and
    its standard deviation would be the prior's. Effects without such a mean have entries 0.
    """
    out = np.zeros((len(columns), len(columns)))
    for effect in dict.fromkeys(column.effect for column in columns):
        places = [k for k, column in enumerate(columns) if column.effect == effect]
        if (
            len(places) > 1
            and np.abs(table.matrix([columns[k] for k in places]).sum(axis=1)).max() < CANCELS
        ):
            out[np.ix_(places, places)] = 1.0 / len(places)
    return out


def _covariance(
    table: RegressionTable, columns: Sequence[Column], residual: np.ndarray, root: np.ndarray
) -> np.ndarray:
    """Return the sandwich covariance over blocks of time, at least the model covariance, (k, k).

    Common means of parameters (`in_common`) are projected out.

    residual : (n,); root : (n,) information of each row
    """
    x, sizes = table.matrix(columns), prior_sizes(columns)
    _, bread, _ = solve(product(weighted(x, root), x), np.zeros(x.shape[1]), sizes)
    apart = np.eye(len(columns)) - in_common(table, columns)
    bread = apart @ bread @ apart
    blocks = int(table.block.max()) + 1
    if blocks < MIN_BLOCKS:
        return bread
    sums = sums_by(table.block, weighted(x, root * residual), blocks)
    # Few blocks underestimate the variance: blocks / (blocks - columns) corrects for that.
    half = sums @ bread * np.sqrt(blocks / max(blocks - min(x.shape[1], blocks // 2), 1))
    sandwich = half.T @ half  # a square has no negative diagonal
    informed = np.diag(sandwich) > 1e-300
    grow = np.sqrt(np.maximum(np.diag(bread) / np.where(informed, np.diag(sandwich), np.inf), 1.0))
    return np.where(np.diag(~informed), bread, sandwich * np.outer(grow, grow))


def measure_inflation(
    table: RegressionTable,
    residual: np.ndarray,
    weight: np.ndarray,
    scale: np.ndarray,
    columns: Sequence[Column],
) -> np.ndarray:
    """Return the variance inflation of each group, (groups,), at least 1.

    It is the larger of two measures. The first is 1 + 2 sum(rho) over the autocorrelation of each
    series up to 3 s. The second is the ratio of the variance of block sums of scores to independent
    rows, averaged over the columns. It includes correlation between series.

    residual : (n,) of a fit with all columns, because effects that are left count as noise
    weight : (n,) robust weights; scale : (groups,)
    """
    out = np.ones(AXES * len(table.channels))
    x = table.matrix(columns)
    for k, rows in table.groups:
        r = weight[rows] * residual[rows] / scale[k]
        raw = max(1.0, _temporal(table, rows, r), _clustered(table.block[rows], x[rows], r))
        spent = np.count_nonzero(counts(x[rows], 0)) * raw / len(r)
        # The fit absorbs part of the noise.
        raw = raw / (1.0 - min(spent, 0.6)) if raw > 1.2 else raw
        # Blocks are independent, so at most a block's rows count as one.
        out[k] = max(1.0, min(raw, len(r) / len(np.unique(table.block[rows]))))
    return out


def _median_of_axes(table: RegressionTable, inflation: np.ndarray) -> np.ndarray:
    """Return an inflation with the median of a channel for each of its axes, (groups,).

    An excess on one axis only is an effect.
    """
    out = inflation.copy()
    for name in table.present:
        axes = np.unique(table.group[table.rows_of(name)])
        out[axes] = np.median(out[axes])
    return out


def _temporal(table: RegressionTable, rows: np.ndarray | slice, r: np.ndarray) -> float:
    key, t = table.flight[rows] * (table.series.max() + 1) + table.series[rows], table.t[rows]
    order, total = np.lexsort((t, key)), 1.0
    for lag in range(1, 13):
        first, second = order[:-lag], order[lag:]
        near = (key[first] == key[second]) & (t[second] - t[first] < LONGEST_MEMORY)
        first, second = first[near], second[near]
        if len(first) < 30:
            break
        power = np.mean(r**2)
        rho = np.mean(r[first] * r[second]) / power if power else 0.0
        if rho < 2.0 / np.sqrt(len(first)):
            break
        total += 2.0 * rho
    return total


def _clustered(blocks: np.ndarray, x: np.ndarray, r: np.ndarray) -> float:
    block = np.unique(blocks, return_inverse=True)[1]
    count, ratios = block.max() + 1, []
    if count < MIN_BLOCKS:
        return 1.0
    lasting = np.flatnonzero(counts(x, 0) > LASTING * len(r))
    for column in dense(x[:, lasting]).T:
        score = column * r
        alone = np.sum(score**2)
        if alone > 0.0 and np.count_nonzero(score) > LASTING * len(score):
            sums = np.bincount(block, score, count)
            ratios.append(np.sum((sums - sums.mean()) ** 2) / alone * count / (count - 1))
    return float(np.mean(ratios)) if len(ratios) else 1.0
