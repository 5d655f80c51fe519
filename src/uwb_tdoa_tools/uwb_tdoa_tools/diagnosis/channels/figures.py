# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of health: bias, spread and tails of residuals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .base import Figures

TAIL = 4.0  # spreads, beyond which a residual belongs to the tails


def rows_by_value(values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Return (value, its rows, rising) for every whole number in values (n,), in their order."""
    order = np.argsort(values, kind="stable")
    names, first = np.unique(values[order], return_index=True)
    return zip(names.tolist(), np.split(order, first[1:]))


def figures(r: np.ndarray) -> dict[str, Any]:
    """Return count, bias, spread and tails of residuals r (n,).

    The bias is the median, the spread 1.48 MAD, tails the share beyond 4 spreads.
    """
    bias = float(np.median(r))
    spread = float(1.4826 * np.median(np.abs(r - bias)))
    return {
        "count": len(r),
        "bias": bias,
        "spread": spread,
        "tails": float(np.mean(np.abs(r - bias) > TAIL * max(spread, 1e-12))),
    }


def health_of_pairs(ids: np.ndarray, r: np.ndarray, a: np.ndarray, b: np.ndarray) -> Figures:
    """Return {"pairs", "anchors"} of TDOA residuals r (n,), m.

    ids : of the anchors; a, b : (n,) rows of the anchors
    """
    pairs = [
        {"pair": f"{ids[label // len(ids)]}-{ids[label % len(ids)]}", **figures(r[mine])}
        for label, mine in rows_by_value(a * len(ids) + b)
    ]
    late = {
        anchor: np.concatenate([r[b == row], -r[a == row]])
        for row, anchor in enumerate(ids.tolist())
    }
    each = [{"anchor": anchor, **figures(some)} for anchor, some in late.items() if len(some)]
    return {"pairs": pairs, "anchors": each}
