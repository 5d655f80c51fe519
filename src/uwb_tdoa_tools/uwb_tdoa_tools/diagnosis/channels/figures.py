"""Figures of a series of residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

APART = 1e4  # s between the stamps of two flights: nothing of one is near the other
LAG_TIMES = (0.1, 0.5, 1.0, 2.0)  # s
TAIL = 4.0  # spreads
FEWEST = 20  # pairs of samples that a correlation is computed of


def rows_by_value(values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """(value, rows that have it, rising) of every whole number in values (n,), in their order."""
    order = np.argsort(values, kind="stable")
    names, first = np.unique(values[order], return_index=True)
    return zip(names.tolist(), np.split(order, first[1:]))


def figures(t: np.ndarray | None, r: np.ndarray) -> dict[str, Any]:
    """Bias (median), spread (1.48 MAD), tails (share beyond 4 spreads), count, and with rising
    stamps t (n,), s, autocorrelation at 0.1 to 2 s, of residuals r (n,): dict.
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
    """Correlation of a series r at rising stamps t with itself `lag` seconds later; None without
    such pairs.
    """
    r = np.clip(
        r - np.median(r),
        *np.array([-5.0, 5.0]) * max(1.4826 * np.median(np.abs(r - np.median(r))), 1e-12),
    )
    later = np.searchsorted(t, t + lag)
    inside = later < len(t)
    first, second = np.flatnonzero(inside), later[inside]
    near = np.abs(t[second] - t[first] - lag) < 0.3 * lag
    if near.sum() < FEWEST or np.mean(r**2) == 0.0:
        return None
    return float(np.mean(r[first[near]] * r[second[near]]) / np.mean(r**2))
