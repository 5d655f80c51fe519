"""What a term is worth on data that did not take part in fitting it."""

import numpy as np

from .fit import NU, prior_sizes, solve
from .select import columns_of

FOLDS = 4


def folds_of(table, by_flight):
    """(n,) fold of every row: every flight alone, or blocks dealt out in turn."""
    return table.flight if by_flight else table.block % FOLDS


def held_out(table, selection, by_flight=False):
    """[(gain, t value over blocks, share of the channel's variance explained)] of every chosen Candidate, on held-out
    rows: fitted with and without it on the other folds, with the weights and scales of the whole fit.

    gain : twice the log-likelihood, in independent rows.
    """
    now, chosen = selection.fit, selection.chosen
    folds = folds_of(table, by_flight)
    root = now.weight / (now.scale[table.channel] ** 2 * now.inflation[table.channel])
    every = columns_of(chosen)
    whole = _predictions(table, every, root, folds)
    out = []
    for k, one in enumerate(chosen):
        rest = _predictions(table, columns_of(chosen[:k] + chosen[k + 1 :]), root, folds)
        touched = np.any(table.matrix(one.columns) != 0.0, axis=1)
        gain = (_loss(table, now, rest) - _loss(table, now, whole)) / now.inflation[table.channel]
        sums = np.bincount(table.block[touched], gain[touched])
        sums = sums[np.unique(table.block[touched])] if touched.any() else np.zeros(1)
        t = sums.sum() / max(np.sqrt(len(sums)) * sums.std(), 1e-9)
        out.append((float(sums.sum()), float(t), explained(table, now, rest, whole, touched)))
    return out


def _predictions(table, names, root, folds):
    """Residuals of every row under the fit of the other folds: (n,)."""
    if not names:
        return table.y
    x = table.matrix(names)
    xw, sizes = x * root[:, None], prior_sizes(names)
    out = table.y.copy()
    for fold in np.unique(folds):
        train = folds != fold
        beta, _, _ = solve(xw[train].T @ x[train], xw[train].T @ table.y[train], sizes)
        out[~train] -= x[~train] @ beta
    return out


def _loss(table, now, residual):
    """Minus twice the log-likelihood of Student's t, row by row."""
    return (NU + 1.0) * np.log1p((residual / now.scale[table.channel]) ** 2 / NU)


def explained(table, now, before, after, rows):
    """Share of the variance, with outliers at 5 spreads, that goes from `before` to `after` in the channel that gains
    most, over the rows (n,) bool."""
    best = 0.0
    for c in range(3):
        mine = (table.channel == c) & rows
        if not mine.any():
            continue
        limit = 5.0 * max(np.median(np.abs(before[mine])) * 1.4826, now.scale[c])
        power = [np.mean(np.clip(r[mine], -limit, limit) ** 2) for r in (before, after)]
        best = max(best, 1.0 - power[1] / max(power[0], 1e-300))
    return float(best)
