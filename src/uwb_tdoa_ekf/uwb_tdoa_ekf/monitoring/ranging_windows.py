# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Count the values of a TDOA stream over windows of 1 s and compute the statistics of a window."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

from .stamp_rules import (
    LAST,
    StampWindow,
    complete,
    count_stamp,
    new_stamps,
    restart_stamps,
    stamp_window,
)

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors

ABSURD = 1e15  # no radio returns this, in any unit
FOLLOWING = 0.1  # s between two TDOAs of a pair below which they are successive
LEAP = 0.5  # m between successive TDOAs of a pair that no flying tag reaches in that time
# m by which a TDOA may exceed the distance of its anchors before it is impossible
BEYOND = 1.0
# m, resolutions to which a driver might round; the radio's tick is 4.69 mm
GRIDS = np.array([1.0, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01])
ON_GRID = 1e-6  # m, largest distance from a multiple
# capacity for pairs of anchors, enough for all that a tag hears in 1 min; number of places for a
# pair, whose oldest entry is replaced
PAIRS, PROBES = 4096, 16
# s before the end of a window; TDOAs within it belong together, because no tag moves far in that
# time
FRESH = 0.3
STEPS = 64  # jumps of a window whose size is stored

# places in the counters; the grids follow
(
    KNOWN,
    UNKNOWN,
    SELF,
    INVALID,
    IMPOSSIBLE,
    DUPLICATES,
    SUCCESSIVE,
    REPEATED,
    LEAPS,
    RETURNS,
    OPPOSED,
    EVEN,
    SUM,
    HIGH,
    HIGH_HITS,
) = range(15)
GRID = 15


class TdoaCounters(NamedTuple):
    """Store the counters of the current window.

    The arrays of pairs are kept between windows.

    Attributes
    ----------
    stamps : (20,) array
        Counters of stamp_rules.
    counts : array
        Counters of this module.
    heard : (N,) array
        Number of TDOAs per anchor.
    steps : (STEPS,) array
        Sizes of the latest jumps, in m.
    pair : (PAIRS,) int array
        Number of each pair of anchors heard lately.
    d, before, t : (PAIRS,) array
        Last value and the value before, in m, and last stamp, in s, of each pair.
    positions : (N, 3) array
        Anchor positions in the world frame, in m.
    """

    stamps: np.ndarray
    counts: np.ndarray
    heard: np.ndarray
    steps: np.ndarray
    pair: np.ndarray
    d: np.ndarray
    before: np.ndarray
    t: np.ndarray
    positions: np.ndarray


class TdoaWindow(NamedTuple):
    """Store the statistics of one window of TDOAs; integers are numbers of TDOAs.

    Attributes
    ----------
    stamps : StampWindow
        Statistics of the stamps.
    known : int
        Finite and between two known anchors.
    unknown : int
        With an anchor that is not in the survey.
    of_one : int
        From an anchor to itself.
    invalid : int
        Not finite.
    impossible : int
        Longer than the distance of the anchors by more than BEYOND.
    duplicates : int
        With pair, stamp and value equal to those before.
    successive : int
        Within FOLLOWING of the last one of the pair.
    repeated : int
        Successive, with an equal value.
    leaps : int
        Successive, with a jump of more than LEAP.
    returns : int
        Jumps back to the value before.
    opposed : int
        TDOAs longer than LEAP whose pair came in the other order less than FOLLOWING before.
    even : int
        Opposed, with equal signs in both orders.
    size : float
        Mean |d|, in m.
    ceiling, hits : float, int
        Largest |d|, in m, and how many TDOAs have it.
    grids : (7,) array
        Share of the values that are multiples of GRIDS.
    heard : (N,) array
        Number of TDOAs of each anchor.
    steps : (k,) array
        Sizes of jumps, in m.
    latest : (k, 3) array
        Rows of both anchors and value, in m, of the last TDOA of each pair whose stamp is within FRESH
        of the stamp that arrived last.
    """

    stamps: StampWindow
    known: int
    unknown: int
    of_one: int
    invalid: int
    impossible: int
    duplicates: int
    successive: int
    repeated: int
    leaps: int
    returns: int
    opposed: int
    even: int
    size: float
    ceiling: float
    hits: int
    grids: np.ndarray
    heard: np.ndarray
    steps: np.ndarray
    latest: np.ndarray


def new_tdoa(anchors: Anchors) -> TdoaCounters:
    """Return the TdoaCounters of a stream without messages, for some Anchors."""
    d, before, t = np.full((3, PAIRS), np.nan)
    counts, heard = np.zeros(GRID + len(GRIDS)), np.zeros(len(anchors))
    return TdoaCounters(
        new_stamps(),
        counts,
        heard,
        np.zeros(STEPS),
        np.full(PAIRS, -1),
        d,
        before,
        t,
        np.array(anchors.positions),
    )


@compiled
def restart_tdoa(counters: TdoaCounters) -> None:
    """Reset the counters for a new window."""
    restart_stamps(counters.stamps)
    counters.counts[:] = 0.0
    counters.heard[:] = 0.0


@compiled
def count_tdoa(counters: TdoaCounters, t: float, arrival: float, a: int, b: int, d: float) -> bool:
    """Count one TDOA and return whether the window is complete.

    Parameters
    ----------
    counters : TdoaCounters
        Changed in place.
    t, arrival : float
        Stamp and arrival time, in s; NaN if unknown.
    a, b : int
        Rows of the anchors, negative if unknown.
    d : float
        Value as received.
    """
    count_stamp(counters.stamps, t, arrival)
    _count(counters, t, a, b, d)
    return complete(counters.stamps)


@compiled
def _count(counters: TdoaCounters, t: float, a: int, b: int, d: float) -> None:
    # Count one TDOA, see count_tdoa. Unusable TDOAs count as their kind only.
    c = counters.counts
    if a < 0 or b < 0:
        c[UNKNOWN] += 1.0
        return
    if a == b:
        c[SELF] += 1.0
        return
    if not abs(d) < ABSURD:
        c[INVALID] += 1.0
        return
    c[KNOWN] += 1.0
    c[SUM] += abs(d)
    counters.heard[a] += 1.0
    counters.heard[b] += 1.0
    square = 0.0
    for k in range(3):
        square += (counters.positions[a, k] - counters.positions[b, k]) ** 2
    if abs(d) > math.sqrt(square) + BEYOND:
        c[IMPOSSIBLE] += 1.0
    if abs(d) > c[HIGH]:
        c[HIGH], c[HIGH_HITS] = abs(d), 1.0
    elif abs(d) == c[HIGH]:
        c[HIGH_HITS] += 1.0
    for k in range(len(GRIDS)):
        if abs(d - GRIDS[k] * round(d / GRIDS[k])) < ON_GRID:
            c[GRID + k] += 1.0
    _compare(counters, t, a, b, d)


@compiled
def _compare(counters: TdoaCounters, t: float, a: int, b: int, d: float) -> None:
    """Compare a TDOA with the last TDOA of its pair, and with the pair in the other order."""
    c, pair, other = counters.counts, _place(counters, a, b), _find(counters, b, a)
    since = t - counters.t[pair]
    if since == 0.0 and d == counters.d[pair]:
        c[DUPLICATES] += 1.0
        return
    if 0.0 <= since < FOLLOWING:
        c[SUCCESSIVE] += 1.0
        if d == counters.d[pair]:
            c[REPEATED] += 1.0
        if abs(d - counters.d[pair]) > LEAP:
            counters.steps[int(c[LEAPS]) % STEPS] = abs(d - counters.d[pair])
            c[LEAPS] += 1.0
            if abs(d - counters.before[pair]) < 0.5 * LEAP:
                c[RETURNS] += 1.0
    if other >= 0 and 0.0 <= t - counters.t[other] < FOLLOWING and abs(d) > LEAP:
        c[OPPOSED] += 1.0
        if abs(d - counters.d[other]) < abs(d + counters.d[other]):
            c[EVEN] += 1.0
    counters.before[pair] = counters.d[pair]
    counters.d[pair], counters.t[pair] = d, t


@compiled
def _slot(number: int, probe: int) -> int:
    # Return the place number `probe` of a pair in the hash table (multiplicative hash).
    return ((number * 2654435761) % 4294967296 // (4294967296 // PAIRS) + probe) % PAIRS


@compiled
def _find(counters: TdoaCounters, a: int, b: int) -> int:
    """Return the place of a pair of rows, or -1 if the pair is not stored."""
    number = a * len(counters.heard) + b
    for probe in range(PROBES):
        if counters.pair[_slot(number, probe)] == number:
            return _slot(number, probe)
    return -1


@compiled
def _place(counters: TdoaCounters, a: int, b: int) -> int:
    """Return the place of a pair of rows; a new pair replaces the oldest pair."""
    place = _find(counters, a, b)
    if place >= 0:
        return place
    number = a * len(counters.heard) + b
    place = _slot(number, 0)
    for probe in range(PROBES):
        other = _slot(number, probe)
        if counters.pair[other] < 0:
            place = other
            break
        if counters.t[other] < counters.t[place]:
            place = other
    counters.pair[place] = number
    counters.d[place] = counters.before[place] = counters.t[place] = np.nan
    return place


@compiled
def feed_tdoa(
    counters: TdoaCounters,
    t: np.ndarray,
    arrival: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    d: np.ndarray,
    first: int,
) -> tuple[int, bool]:
    """Count rows of arrays from `first` on until a window is complete.

    Returns
    -------
    row : int
        Row after the last counted one.
    complete : bool
        Whether the window is complete.
    """
    for i in range(first, len(t)):
        if count_tdoa(counters, t[i], arrival[i], a[i], b[i], d[i]):
            return i + 1, True
    return len(t), False


def tdoa_window(counters: TdoaCounters) -> TdoaWindow:
    """Return the TdoaWindow of the TDOAs since the window began."""
    c = counters.counts
    known = max(c[KNOWN], 1.0)
    whole = dict(zip(TdoaWindow._fields[1 : 1 + SUM], (int(value) for value in c[:SUM])))
    return TdoaWindow(
        stamp_window(counters.stamps),
        **whole,
        size=float(c[SUM] / known),
        ceiling=float(c[HIGH]),
        hits=int(c[HIGH_HITS]),
        grids=c[GRID:] / known,
        heard=counters.heard.copy(),
        steps=counters.steps[: min(int(c[LEAPS]), STEPS)].copy(),
        latest=_latest(counters),
    )


def _latest(counters: TdoaCounters) -> np.ndarray:
    # Return TdoaWindow.latest.
    kept = np.flatnonzero(
        (counters.pair >= 0) & (np.abs(counters.stamps[LAST] - counters.t) < FRESH)
    )
    a, b = np.divmod(counters.pair[kept], len(counters.heard))
    return np.column_stack([a, b, counters.d[kept]])
