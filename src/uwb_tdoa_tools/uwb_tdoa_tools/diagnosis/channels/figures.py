# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of health: bias, spread, tails and correlations of residuals, and of pairs of anchors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from .base import Figures

APART = 1e4  # s, gap between the stamps of two flights, so that they do not correlate
LAG_TIMES = (0.1, 0.5, 1.0, 2.0)  # s, lags of the autocorrelation
TAIL = 4.0  # spreads, beyond which a residual belongs to the tails
FEWEST = 20  # fewest pairs of samples for a correlation
STRONGEST = 10  # largest number of reported correlations between pairs of anchors


def rows_by_value(values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Return (value, its rows, rising) for every whole number in values (n,), in their order."""
    order = np.argsort(values, kind="stable")
    names, first = np.unique(values[order], return_index=True)
    return zip(names.tolist(), np.split(order, first[1:]))


def figures(t: np.ndarray | None, r: np.ndarray) -> dict[str, Any]:
    """Return count, bias, spread, tails and autocorrelation of residuals r (n,).

    The bias is the median, the spread 1.48 MAD, tails the share beyond 4 spreads. The
    autocorrelation at 0.1 to 2 s needs rising stamps t (n,), s.
    """
    bias = float(np.median(r))
    spread = float(1.4826 * np.median(np.abs(r - bias)))
    out: dict[str, Any] = {
        "count": len(r),
        "bias": bias,
        "spread": spread,
        "tails": float(np.mean(np.abs(r - bias) > TAIL * max(spread, 1e-12))),
    }
    if t is not None and len(t) > 50:
        out["autocorrelation"] = {f"{lag:g} s": autocorrelation(t, r, lag) for lag in LAG_TIMES}
    return out


def autocorrelation(t: np.ndarray, r: np.ndarray, lag: float) -> float | None:
    """Return the correlation of r (n,) with itself `lag` seconds later, None without such pairs.

    t : (n,) s, rising
    """
    r = r - np.median(r)
    limit = 5.0 * max(1.4826 * np.median(np.abs(r)), 1e-12)
    r = np.clip(r, -limit, limit)
    later = np.searchsorted(t, t + lag)
    inside = later < len(t)
    first, second = np.flatnonzero(inside), later[inside]
    near = np.abs(t[second] - t[first] - lag) < 0.3 * lag
    if near.sum() < FEWEST or np.mean(r**2) == 0.0:
        return None
    return float(np.mean(r[first[near]] * r[second[near]]) / np.mean(r**2))


def health_of_pairs(
    ids: np.ndarray, t: np.ndarray, r: np.ndarray, a: np.ndarray, b: np.ndarray
) -> Figures:
    """Return {"pairs", "anchors", "cross_correlation"} of TDOA residuals r (n,), m.

    ids : of the anchors; t : (n,) s, APART between flights; a, b : (n,) rows of the anchors
    """
    label = a * len(ids) + b
    pairs = [
        {"pair": _name(number, ids), **figures(t[mine], r[mine])}
        for number, mine in rows_by_value(label)
    ]
    each = []
    for row, anchor in enumerate(ids.tolist()):
        late = np.concatenate([r[b == row], -r[a == row]])
        if len(late):
            each.append({"anchor": anchor, **figures(None, late)})
    return {"pairs": pairs, "anchors": each, "cross_correlation": _crossed(t, r, label, ids)}


def _name(label: int, ids: np.ndarray) -> str:
    """Return a pair, as "1-2", by its number among anchors with these ids."""
    return "-".join(str(ids[row]) for row in divmod(label, len(ids)))


def _crossed(
    t: np.ndarray, r: np.ndarray, label: np.ndarray, anchors: np.ndarray
) -> list[dict[str, Any]]:
    """Return [{"pairs", "correlation"}], the strongest of half-second means of two pairs."""
    cell = np.unique((t * 2.0).astype(int), return_inverse=True)[1]
    together = np.unique(np.stack([label, cell]), axis=1)[0]  # pair of each pair and cell
    often, times = np.unique(together, return_counts=True)
    rows = np.isin(label, often[times > FEWEST])
    r, cell = r[rows], cell[rows]
    if not len(r):
        return []
    labels, place = np.unique(label[rows], return_inverse=True)
    shape = (cell.max() + 1, len(labels))
    at = cell * len(labels) + place
    count = np.bincount(at, minlength=shape[0] * shape[1]).reshape(shape)
    mean = np.bincount(at, r, shape[0] * shape[1]).reshape(shape) / np.maximum(count, 1)
    heard = csr_array(count > 0, dtype=float)
    together = (heard.T @ heard).tocoo()  # half seconds with both pairs
    often = np.flatnonzero((together.data > FEWEST) & (together.row > together.col))
    out: list[dict[str, Any]] = []
    for i, k in sorted(zip(together.row[often].tolist(), together.col[often].tolist())):
        both = (count[:, i] > 0) & (count[:, k] > 0)
        if mean[both, i].std() > 0.0 and mean[both, k].std() > 0.0:
            rho = float(np.corrcoef(mean[both, i], mean[both, k])[0, 1])
            names = [_name(x, anchors) for x in (labels[k], labels[i])]
            out.append({"pairs": names, "correlation": round(rho, 3)})
    return sorted(out, key=lambda item: -abs(item["correlation"]))[:STRONGEST]
