"""Residuals of half a second, reduced to one delay for each anchor.

A TDOA whose anchors are late by delay_a and delay_b, predicted for a place that is off by e, has
the innovation delay_b - delay_a + (u_b - u_a) e, with u the directions from the anchors to the tag.
The place is solved for and thrown away: what is left are the combinations of delays that no place
explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges

LENGTH = 0.5  # s of stamps
CLIP = 1.5  # m; a larger innovation counts as this
TDOA_VARIANCE = 0.02  # m^2, noise of one TDOA about the errors that last
PLACE_STD = 0.5  # m, by which the filter may be off
DELAY_STD = 0.15  # m, of a delay, before anything is measured
# anchors of a slice; where more are heard, those that are heard least are left out of it
MOST = 100


@dataclass(frozen=True)
class Slice:
    """t : s, its middle; p : (3,) m, where the filter had the tag; rows : (H,) of the anchors that
    were heard, MOST at most;
    delays : (H,) m, their least mean square estimate; response : (H, H), what a metre of delay of
        each anchor (column) makes of
    the estimate. An anchor that was not heard has neither. information (H, H) 1/m^2, vector (H,)
    1/m : what the TDOAs alone tell of the delays, at whatever place.
    """

    t: float
    p: np.ndarray
    rows: np.ndarray
    delays: np.ndarray
    response: np.ndarray
    information: np.ndarray
    vector: np.ndarray


def reduced(
    t: float,
    p: np.ndarray,
    positions: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    innovation: np.ndarray,
) -> Slice:
    """The Slice of TDOAs between the anchors (rows) a and b (n,), with innovations (n,) m;
    positions : (N, 3) m.
    """
    value = np.clip(innovation, -CLIP, CLIP)
    rows, a, b, value = _heard_most(a, b, value)
    n = len(rows)
    heard = np.bincount(a, minlength=n) + np.bincount(b, minlength=n)
    both = np.bincount(a * n + b, minlength=n * n).reshape(n, n)
    information = (np.diag(heard) - both - both.T) / TDOA_VARIANCE
    vector = (np.bincount(b, value, n) - np.bincount(a, value, n)) / TDOA_VARIANCE
    direction = ranges(p, positions[rows])[1]
    of_place = information @ direction
    gain = np.linalg.solve(direction.T @ of_place + np.eye(3) / PLACE_STD**2, of_place.T)
    information = information - of_place @ gain
    vector = vector - gain.T @ (direction.T @ vector)
    both = np.linalg.solve(
        information + np.eye(n) / DELAY_STD**2, np.column_stack([vector, information])
    )
    return Slice(t, p, rows, both[:, 0], both[:, 1:], information, vector)


def _heard_most(
    a: np.ndarray, b: np.ndarray, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(rows, a, b, value): the anchors that are heard, MOST at most, and the TDOAs between them,
    with places among these rows.
    """
    rows, both = np.unique(np.concatenate([a, b]), return_inverse=True)
    often = np.sort(np.argsort(-np.bincount(both, minlength=len(rows)), kind="stable")[:MOST])
    place = np.full(len(rows), -1)
    place[often] = np.arange(len(often))
    a, b = place[both[: len(a)]], place[both[len(a) :]]
    kept = (a >= 0) & (b >= 0)
    return rows[often], a[kept], b[kept], value[kept]
