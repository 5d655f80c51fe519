"""Robust linear fits of a RegressionTable, and what one is worth.

Noise is Student's t with NU degrees of freedom, fitted by iteratively re-weighted least squares
(Lange, Little and Taylor, JASA 1989). Rows are not independent: each axis of a channel has a scale,
and the information of every channel is divided by an inflation that is measured on the residuals of
blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .algebra import counts, dense, product, sums_by, weighted
from .table import AXES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .table import RegressionTable
    from .terms import Column

CANCELS = 1e-9  # sum of regressors of one effect, in the unit of a row, which is nothing
NU = 4.0
ITERATIONS = 12
MIN_BLOCKS = 6
LONGEST_MEMORY = 3.0  # s over which rows of a series may be alike
LASTING = 0.1  # share of the rows in which a column must be, to tell what they have in common


@dataclass(frozen=True, eq=False)
class Fit:
    """columns, beta (k,), cov (k, k): block sandwich, not below the model's; residual (n,), weight
    (n,) 0 to 1.25; scale, inflation, size (groups,): spread of a row, loss of independence,
    effective number of rows.
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
        """What each row of the RegressionTable counts for, (n,), in independent rows per squared
        unit.
        """
        return self.weight / (self.scale**2 * self.inflation)[table.group]

    def likelihood(self, table: RegressionTable) -> float:
        """Twice the log-likelihood of Student's t, in independent rows, less what the prior says of
        beta.
        """
        scale = self.scale[table.group]
        rows = 2.0 * np.log(scale) + (NU + 1.0) * np.log1p((self.residual / scale) ** 2 / NU)
        return -float(
            np.sum(rows / self.inflation[table.group])
            + np.sum((self.beta / prior_sizes(self.columns)) ** 2)
        )

    def values(self, columns: Sequence[Column]) -> np.ndarray:
        """beta of some Columns, (k,)."""
        place = {column: k for k, column in enumerate(self.columns)}
        return self.beta[[place[column] for column in columns]]


def solve(
    gram: np.ndarray, vector: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Solution of normal equations with a Gaussian prior of standard deviations `sizes`: (beta,
    covariance, number of parameters that the data determine: each counts by how little the prior
    says of it). What the data do not determine stays 0.
    """
    if len(vector) == 0:
        return vector, np.zeros((0, 0)), 0.0
    scaled = gram * np.outer(sizes, sizes) + np.eye(len(vector))
    inverse = np.linalg.inv(scaled)
    cov = inverse * np.outer(sizes, sizes)
    return cov @ vector, cov, float(len(vector) - np.trace(inverse))


def _solution(gram: np.ndarray, vector: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """The first of `solve`, in a third of the time."""
    return sizes * cho_solve(
        cho_factor(
            gram * np.outer(sizes, sizes) + np.eye(len(vector)),
            overwrite_a=True,
            check_finite=False,
        ),
        sizes * vector,
    )


def prior_sizes(columns: Sequence[Column]) -> np.ndarray:
    """Plausible sizes of Columns: (k,)."""
    return np.array([column.typical for column in columns])


def fit(
    table: RegressionTable,
    columns: Sequence[Column],
    inflation: np.ndarray | None = None,
    covariance: bool = True,
    near: Fit | None = None,
) -> Fit:
    """Fit of some Columns of a RegressionTable. inflation : (groups,), measured on this very fit if
    None; covariance : whether somebody asks for it; near : Fit of nearly the same Columns, from
    which that of a sparse RegressionTable begins.
    """
    x, group, sizes = table.matrix(columns), table.group, prior_sizes(columns)
    weight, beta = np.ones(len(table.y)), np.zeros(len(columns))
    residual = table.y.copy() if near is None or not table.sparse else near.residual.copy()
    for step in range(ITERATIONS):
        scale = _scales(table, residual)
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
        inflation = measure_inflation(table, residual, weight, scale, columns)
    root = weight / (scale[group] ** 2 * inflation[group])
    cov = (
        _covariance(table, columns, residual, root) if columns and covariance else np.zeros((0, 0))
    )
    size = np.bincount(group, minlength=len(scale)) / inflation
    return Fit(tuple(columns), beta, cov, residual, weight, scale, inflation, np.maximum(size, 1.0))


def refit(
    table: RegressionTable, columns: Sequence[Column], model: Fit, rows: np.ndarray | None = None
) -> Fit:
    """Fit of some Columns with the weights and scales of another Fit; rows : (n,) bool, those that
    it is made to alone, with the covariance of the model.
    """
    x, sizes, root = table.matrix(columns), prior_sizes(columns), model.information(table)
    some = slice(None) if rows is None else rows
    xw = weighted(x[some], root[some])
    beta, cov, _ = solve(product(xw, x[some]), xw.T @ table.y[some], sizes)
    residual = table.y - x @ beta
    if rows is None and columns:
        cov = _covariance(table, columns, residual, root)
    elif columns:
        apart = np.eye(len(columns)) - in_common(table, columns)
        cov = apart @ cov @ apart
    return replace(model, columns=tuple(columns), beta=beta, cov=cov, residual=residual)


def _scales(table: RegressionTable, residual: np.ndarray) -> np.ndarray:
    """Scale of Student's t per group, by the fixed point of its likelihood."""
    out = _one_each(table)
    for k, rows in table.groups:
        out[k] = student_scale(residual[rows])
    return out


def _one_each(table: RegressionTable) -> np.ndarray:
    """(groups,) of 1, of all channels whether they have rows or not."""
    return np.ones(AXES * len(table.channels))


def student_scale(r: np.ndarray) -> float:
    """Scale of Student's t for residuals r (n,)."""
    scale = max(1.4826 * np.median(np.abs(r)), 1e-9)
    for _ in range(15):
        w = (NU + 1.0) / (NU + (r / scale) ** 2)
        scale = max(np.sqrt(np.mean(w * r**2)), 1e-9)
    return scale


def in_common(table: RegressionTable, columns: Sequence[Column]) -> np.ndarray:
    """(k, k), what makes of the values of one effect among some Columns the mean of all, where that
    cancels in every row, as that of the delays of all anchors does in TDOAs; 0 elsewhere. A fit
    leaves that mean at 0, and its deviation would be that of the prior.
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
    """Sandwich over blocks, at least the model's own; of delays apart from what all have
    `in_common`.
    """
    x, sizes = table.matrix(columns), prior_sizes(columns)
    _, bread, _ = solve(product(weighted(x, root), x), np.zeros(x.shape[1]), sizes)
    apart = np.eye(len(columns)) - in_common(table, columns)
    bread = apart @ bread @ apart
    blocks = int(table.block.max()) + 1
    if blocks < MIN_BLOCKS:
        return bread
    sums = sums_by(table.block, weighted(x, root * residual), blocks)
    half = sums @ bread * np.sqrt(blocks / max(blocks - min(x.shape[1], blocks // 2), 1))
    sandwich = half.T @ half  # squares, so that none of its diagonal is below zero
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
    """By how much fewer the independent rows of each channel are: (groups,), at least 1. Of its
    axes the median: what one has that the others have not is an effect.

    The larger of two: 1 + 2 sum(rho) over the autocorrelation of each series up to 3 s, and how
    much larger sums of scores over blocks are than those of independent rows would be, averaged
    over the columns. The second sees what series have in common. The residual should be that of a
    fit with all columns, or effects count as noise.
    """
    out = _one_each(table)
    x = table.matrix(columns)
    for k, rows in table.groups:
        r = weight[rows] * residual[rows] / scale[k]
        raw = max(1.0, _temporal(table, rows, r), _clustered(table.block[rows], x[rows], r))
        spent = np.count_nonzero(counts(x[rows], 0)) * raw / len(r)
        # the fit has followed some of the noise
        raw = raw / (1.0 - min(spent, 0.6)) if raw > 1.2 else raw
        # blocks are independent
        out[k] = max(1.0, min(raw, len(r) / len(np.unique(table.block[rows]))))
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
