"""Ranges that are all too long, or too short, by the same: the antenna delay of the tag, which
TDOAs do not know of. A rule takes a Recording and yields Findings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.sensors import Ranges
from uwb_tdoa_ekf.streams import NOTE, Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from uwb_tdoa_bias.foundation.anchors import Anchors

    from .recording import Recording

WINDOW = 0.25  # s in which the tag hardly moves
FEWEST_ANCHORS, FEWEST_WINDOWS, MOST_WINDOWS = 5, 10, 200
LARGE, LARGEST = 0.1, 5.0  # m: from which on it is said, and more than which no antenna makes
AGREE = 0.8  # share of the windows that say the same sign
SCALE = 0.2  # m, beyond which a range counts less
DILUTION = 5.0  # most that an error of the ranges may become in what they have in common
STEPS, DAMPING = 20, 1e-3
REMEDY = (
    "calibrate it: survey, or diagnose where there is ground truth; until then leave "
    "range_offset_std above 0.0: the filter finds it after each start"
)


def tag_delay(recording: Recording) -> Iterator[Finding]:
    """All ranges are wrong by about as much: without `range_offset_std` the position is off by more
    than that where anchors are on one side.
    """
    ranges = recording.sensors.get("range")
    offsets = (
        window_offsets(ranges, recording.anchors) if isinstance(ranges, Ranges) else np.empty(0)
    )
    if len(offsets) < FEWEST_WINDOWS:
        return
    offset = float(np.median(offsets))
    if LARGE < abs(offset) < LARGEST and np.mean(np.sign(offsets) == np.sign(offset)) > AGREE:
        cause = (
            f"all ranges are too {'long' if offset > 0.0 else 'short'} by about as much: the "
            "antenna delay of the tag"
        )
        low, high = np.quantile(offsets, [0.25, 0.75])
        evidence = (
            f"{offset:.2f} m in the median of {len(offsets)} windows of {WINDOW:g} s, {low:.2f} "
            f"to {high:.2f} m in half of them"
        )
        yield Finding("tag_delay", NOTE, cause, evidence, REMEDY, offset)


def window_offsets(ranges: Ranges, anchors: Anchors) -> np.ndarray:
    """(k,) m: what the ranges of each window have in common beside the distances from one place,
    where they tell.
    """
    row = anchors.index(ranges.anchor)
    sound = (row >= 0) & np.isfinite(ranges.d) & np.isfinite(ranges.t)
    row, d, t = row[sound], ranges.d[sound], ranges.t[sound]
    if not len(t):
        return np.empty(0)
    _, first = np.unique(np.floor((t - t.min()) / WINDOW), return_index=True)
    parts = list(zip(np.split(row, first[1:]), np.split(d, first[1:])))
    parts = [(rows, some) for rows, some in parts if len(np.unique(rows)) >= FEWEST_ANCHORS]
    chosen = np.unique(np.linspace(0, len(parts) - 1, min(len(parts), MOST_WINDOWS)).astype(int))
    found = (_offset(anchors.positions[parts[k][0]], parts[k][1]) for k in chosen)
    return np.array([one for one in found if one is not None])


def _offset(positions: np.ndarray, d: np.ndarray) -> float | None:
    """m, of ranges d (n,) m to anchors at positions (n, 3) m, by Gauss-Newton with Huber's weights;
    None where they do not determine it.
    """
    x = np.append(positions.mean(axis=0), 0.0)
    for _ in range(STEPS):
        away = x[:3] - positions
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
        error = d - distance - x[3]
        weight = np.minimum(1.0, SCALE / np.maximum(np.abs(error), 1e-9))
        jacobian = np.column_stack([away / distance[:, None], np.ones(len(d))])
        gram = jacobian.T @ (weight[:, None] * jacobian) + DAMPING * np.eye(4)
        x = x + np.linalg.solve(gram, jacobian.T @ (weight * error))
    determined = float(np.sqrt(np.linalg.inv(gram)[3, 3])) < DILUTION and bool(np.isfinite(x).all())
    return float(x[3]) if determined else None



