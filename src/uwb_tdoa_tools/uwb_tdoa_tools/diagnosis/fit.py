"""Robust linear fits of a Table, and what one is worth.

Noise is Student's t with NU degrees of freedom, fitted by iteratively re-weighted least squares (Lange, Little and
Taylor, JASA 1989). Rows are not independent: every channel's information is divided by an inflation that is measured
on the residuals of blocks.
"""

from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS, SmoothTerm

NU = 4.0
ITERATIONS = 12
MIN_BLOCKS = 6


@dataclass(frozen=True)
class Fit:
    """names of the columns, beta (k,), cov (k, k): block sandwich, not below the model's; residual (n,), weight (n,)
    0 to 1.25; scale, inflation, size (3,): per channel, spread of a row, loss of independence, effective number of
    rows."""

    names: tuple
    beta: np.ndarray
    cov: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    scale: np.ndarray
    inflation: np.ndarray
    size: np.ndarray


def solve(gram, vector, sizes):
    """Solution of normal equations with a Gaussian prior of standard deviations `sizes`: (beta, covariance, number of
    parameters that the data tell: each counts by how little the prior says of it). What the data do not tell stays
    0."""
    if len(vector) == 0:
        return vector, np.zeros((0, 0)), 0.0
    scaled = gram * np.outer(sizes, sizes) + np.eye(len(vector))
    inverse = np.linalg.inv(scaled)
    cov = inverse * np.outer(sizes, sizes)
    return cov @ vector, cov, float(len(vector) - np.trace(inverse))


def prior_sizes(names):
    """Plausible sizes of the columns (effect, key): (k,)."""
    kinds = {**EFFECTS, SmoothTerm.name: SmoothTerm}
    return np.array([kinds[effect.partition("#")[0]].typical_of(key) for effect, key in names])


def fit(table, names, inflation=None):
    """Fit of the columns `names` of a Table. inflation : (3,), measured on this very fit if None."""
    x, channel, sizes = table.matrix(names), table.channel, prior_sizes(names)
    size = np.array([max(np.sum(channel == c), 1) for c in range(3)], dtype=float)
    weight, beta = np.ones(len(table.y)), np.zeros(len(names))
    residual, scale = table.y.copy(), np.ones(3)
    for step in range(ITERATIONS):
        scale = _scales(residual, channel)
        weight = (NU + 1.0) / (NU + (residual / scale[channel]) ** 2)
        if not names:
            if step:
                break
            continue
        root = weight / scale[channel] ** 2
        root /= 1.0 if inflation is None else inflation[channel]
        beta, _, _ = solve((x * root[:, None]).T @ x, x.T @ (root * table.y), sizes)
        change = residual - (table.y - x @ beta)
        residual = residual - change
        if np.all(np.abs(change) < 0.01 * scale[channel]):
            break
    if inflation is None:
        inflation = measure_inflation(table, residual, weight, scale, names)
    root = weight / (scale[channel] ** 2 * inflation[channel])
    cov = _covariance(table, x, residual, root, sizes) if names else np.zeros((0, 0))
    return Fit(tuple(names), beta, cov, residual, weight, scale, inflation, size / inflation)


def _scales(residual, channel):
    """Scale of Student's t per channel, by the fixed point of its likelihood."""
    out = np.ones(3)
    for c in np.unique(channel):
        r = residual[channel == c]
        scale = max(1.4826 * np.median(np.abs(r)), 1e-9)
        for _ in range(15):
            w = (NU + 1.0) / (NU + (r / scale) ** 2)
            scale = max(np.sqrt(np.mean(w * r**2)), 1e-9)
        out[c] = scale
    return out


def _covariance(table, x, residual, root, sizes):
    """Sandwich over blocks, at least the model's own."""
    gram = (x * root[:, None]).T @ x
    _, bread, _ = solve(gram, np.zeros(x.shape[1]), sizes)
    blocks = int(table.block.max()) + 1
    score = x * (root * residual)[:, None]
    sums = np.stack([np.bincount(table.block, column, blocks) for column in score.T], axis=1)
    if blocks < MIN_BLOCKS:
        return bread
    meat = sums.T @ sums * blocks / max(blocks - min(x.shape[1], blocks // 2), 1)
    sandwich = bread @ meat @ bread
    grow = np.sqrt(np.maximum(np.diag(bread) / np.maximum(np.diag(sandwich), 1e-300), 1.0))
    return sandwich * np.outer(grow, grow)


def measure_inflation(table, residual, weight, scale, names):
    """By how much fewer the independent rows of each channel are: (3,), at least 1.

    The larger of two: 1 + 2 sum(rho) over the autocorrelation of each series up to 3 s, and how much larger sums of
    scores over blocks are than those of independent rows would be, averaged over the columns `names`. The second sees
    what series have in common. The residual should be that of a fit with all columns, or effects count as noise.
    """
    out = np.ones(3)
    for c in np.unique(table.channel):
        mine = np.flatnonzero(table.channel == c)
        r = weight[mine] * residual[mine] / scale[c]
        raw = max(1.0, _temporal(table, mine, r), _clustered(table, mine, r, names))
        spent = sum(np.any(table.columns[name][mine] != 0.0) for name in names) * raw / len(mine)
        out[c] = raw / (1.0 - min(spent, 0.6)) if raw > 1.2 else raw  # the fit has followed some of the noise
    return out


def _temporal(table, mine, r):
    key = table.flight[mine] * 100000 + table.series[mine]
    total = 1.0
    for lag in range(1, 13):
        first, second = _neighbours(key, table.t[mine], lag)
        if len(first) < 30:
            break
        rho = np.mean(r[first] * r[second]) / np.mean(r**2)
        if rho < 2.0 / np.sqrt(len(first)):
            break
        total += 2.0 * rho
    return total


def _clustered(table, mine, r, names):
    block = np.unique(table.block[mine], return_inverse=True)[1]
    count, ratios = block.max() + 1, []
    if count < MIN_BLOCKS:
        return 1.0
    for name in names:
        score = table.columns[name][mine] * r
        alone = np.sum(score**2)
        if alone > 0.0 and np.count_nonzero(score) > 0.1 * len(score):
            sums = np.bincount(block, score, count)
            ratios.append(np.sum((sums - sums.mean()) ** 2) / alone * count / (count - 1))
    return float(np.mean(ratios)) if len(ratios) else 1.0


def _neighbours(key, t, lag):
    """Places of rows of one series that follow each other by `lag` places, not more than 3 s apart."""
    order = np.lexsort((t, key))
    first, second = order[:-lag], order[lag:]
    near = (key[first] == key[second]) & (t[second] - t[first] < 3.0)
    return first[near], second[near]


def refit(table, names, now, rows):
    """Fit of the columns `names` to some rows (n,) bool alone, with the weights and scales of another Fit."""
    x, sizes = table.matrix(names), prior_sizes(names)
    root = now.weight / (now.scale[table.channel] ** 2 * now.inflation[table.channel])
    xw = x[rows] * root[rows, None]
    beta, cov, _ = solve(xw.T @ x[rows], xw.T @ table.y[rows], sizes)
    return replace(now, names=tuple(names), beta=beta, cov=cov, residual=table.y - x @ beta)
