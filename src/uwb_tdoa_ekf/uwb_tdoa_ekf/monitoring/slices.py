# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reduce the residuals of half a second to one delay for each anchor.

A TDOA has anchors with the delays delay_a and delay_b. Its prediction uses a position with the
error e. Its innovation is delay_b - delay_a + (u_b - u_a) e. Here u is the unit vector from an
anchor to the tag. The position error is marginalized. The result contains the combinations of
delays that no position error explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges

LENGTH = 0.5  # s of stamps of one slice
CLIP = 1.5  # m; larger innovations are clipped to this
FEWEST = 10  # fewest TDOAs of a slice that show an exchange, or signs that turn
TDOA_VARIANCE = 0.02  # m^2, noise variance of one TDOA without its constant errors
PLACE_STD = 0.5  # m, standard deviation of the position of the filter
DELAY_STD = (
    0.15  # m, prior standard deviation of a delay, without its part that depends on the place
)
# largest number of anchors in a slice; the anchors with the fewest TDOAs are left out
MOST = 100


@dataclass(frozen=True)
class Slice:
    """Store the delays of all anchors that are heard in half a second.

    Attributes
    ----------
    t : float
        Stamp of the middle, in s.
    p : (3,) array
        Position of the filter in the world frame, in m.
    rows : (H,) int array
        Rows of the anchors, at most MOST.
    delays : (H,) array
        Minimum mean square error estimate of their delays, in m.
    response : (H, H) array
        Change of the estimate (row) per metre of delay of each anchor (column).
    information : (H, H) array
        Information of the TDOAs alone on the delays, with the position marginalized, in 1/m^2.
    vector : (H,) array
        Information vector, in 1/m.
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
    """Return the Slice of TDOAs.

    Parameters
    ----------
    t : float
        Stamp of the middle, in s.
    p : (3,) array
        Position of the filter in the world frame, in m.
    positions : (N, 3) array
        Anchor positions in the world frame, in m.
    a, b : (n,) int array
        Rows of the anchors of each TDOA.
    innovation : (n,) array
        Innovations, in m.
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
    """Return the anchors with the most TDOAs, at most MOST, and the TDOAs between them.

    Returns
    -------
    rows : (H,) int array
        Rows of the anchors.
    a, b : (k,) int array
        Anchors of each TDOA as places in `rows`.
    value : (k,) array
        Innovations, in m.
    """
    rows, both = np.unique(np.concatenate([a, b]), return_inverse=True)
    often = np.sort(np.argsort(-np.bincount(both, minlength=len(rows)), kind="stable")[:MOST])
    place = np.full(len(rows), -1)
    place[often] = np.arange(len(often))
    a, b = place[both[: len(a)]], place[both[len(a) :]]
    kept = (a >= 0) & (b >= 0)
    return rows[often], a[kept], b[kept], value[kept]


TURNED = 0.75  # m, change of a TDOA with its sign below which it shows nothing
OTHER_LEAVES = 0.35  # largest share of that change that the other sign may leave
# Shares of the significant TDOAs: smallest share that the other sign must explain, and largest
# share that the present sign may explain. After a flip these were 0.66 to 1.0 and 0.0 in simulated
# flights. Near a floor, where anchors are metres late, they were 0.67 and 0.3.
SHARE, PRESENT = 0.6, 0.1


def turned(innovation: np.ndarray, predicted: np.ndarray) -> bool:
    """Return whether the other sign explains the innovations of a slice.

    All TDOAs far from zero count, including those that the filter explains. If a few anchors are
    late, as near a floor, most TDOAs therefore contradict a flip.

    Parameters
    ----------
    innovation : (n,) array
        Innovations, in m.
    predicted : (n,) array
        TDOAs predicted at the position of the filter, in m.
    """
    change = np.abs(2.0 * predicted)
    asked = change > TURNED
    if np.count_nonzero(asked) < FEWEST:
        return False
    small = OTHER_LEAVES * change[asked]
    left = np.abs(2.0 * predicted[asked] + innovation[asked])  # -(-d - predicted) for a measured d
    return bool(
        np.mean(left < small) > SHARE and np.mean(np.abs(innovation[asked]) < small) < PRESENT
    )
