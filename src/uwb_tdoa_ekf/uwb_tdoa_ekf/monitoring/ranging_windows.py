"""Counters of the values of a stream of TDOAs, and what they amount to over a window."""

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

ABSURD = 1e15  # in any unit: no number that a radio gives
FOLLOWING = 0.1  # s between two TDOAs of a pair that count as successive
LEAP = 0.5  # m between successive TDOAs of a pair that no tag flies in that time
# m by which a TDOA may exceed the distance of its anchors before it counts as impossible
BEYOND = 1.0
# m, to which a driver might round; the radio's tick is 4.69 mm
GRIDS = np.array([1.0, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01])
ON_GRID = 1e-6  # m
# Pairs that are remembered, of all that a tag hears in a minute; places that one may have, of which
# it takes the oldest
PAIRS, PROBES = 4096, 16
# s before the end of a window, whose TDOAs belong together: no tag gets far in that time
FRESH = 0.3
STEPS = 64  # leaps of a window whose size is kept

# places in the counters; those of the grids come after
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
    """stamps : see stamps.py; counts; heard (N,) per anchor; steps (STEPS,) m : sizes of the latest
    leaps; pair, d, before, t (PAIRS,) : of each pair of anchors heard lately the number, last
    value, the one before and the last stamp, which outlive a window; positions (N, 3) : m.
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
    """One window of TDOAs. Counts, unless it says otherwise.

    known : finite and between two known anchors; unknown : with an anchor that the survey does not
        have; of_one : of
    one anchor with itself; invalid : no number; impossible : longer than the anchors are apart;
    duplicates : same pair, stamp and value as the one before of its pair; successive : that follow
    one of their pair within FOLLOWING; repeated : of those, with the same value; leaps : of those,
    by more than LEAP; returns : leaps that go back to the value before; opposed : pairs that came
    in both orders, one soon after the other; even : of those, with the same sign in both; size :
    mean |d|, m; ceiling, hits : largest |d|, m, and how many have it; grids (7,) : share of the
    values on multiples of GRIDS; heard (N,) : TDOAs in which an anchor takes part; steps (k,) : m,
    sizes of leaps; latest (k, 3) : rows of the anchors and value, m, of the last TDOA of each pair,
    FRESH at most before the end.
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
    """TdoaCounters of a stream of which nothing was received; anchors : Anchors."""
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
    """Begin a new window."""
    restart_stamps(counters.stamps)
    counters.counts[:] = 0.0
    counters.heard[:] = 0.0


@compiled
def count_tdoa(counters: TdoaCounters, t: float, arrival: float, a: int, b: int, d: float) -> bool:
    """Take one TDOA: stamp and arrival, s (NaN: not known); a, b rows of its anchors, negative if
    unknown; d as received. Returns whether the window is complete.
    """
    count_stamp(counters.stamps, t, arrival)
    _count(counters, t, a, b, d)
    return complete(counters.stamps)


@compiled
def _count(counters: TdoaCounters, t: float, a: int, b: int, d: float) -> None:
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
    """Against what was received of this pair before, and of the same in the other order."""
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
    return ((number * 2654435761) % 4294967296 // (4294967296 // PAIRS) + probe) % PAIRS


@compiled
def _find(counters: TdoaCounters, a: int, b: int) -> int:
    """Place of a pair of rows, -1 if it is not remembered."""
    number = a * len(counters.heard) + b
    for probe in range(PROBES):
        if counters.pair[_slot(number, probe)] == number:
            return _slot(number, probe)
    return -1


@compiled
def _place(counters: TdoaCounters, a: int, b: int) -> int:
    """Place of a pair of rows; one that is not remembered takes that of the pair that was heard the
    longest ago.
    """
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
    """`count_tdoa` for the rows of arrays from `first` on, until a window is complete: (row after
    the last, whether it is).
    """
    for i in range(first, len(t)):
        if count_tdoa(counters, t[i], arrival[i], a[i], b[i], d[i]):
            return i + 1, True
    return len(t), False


def tdoa_window(counters: TdoaCounters) -> TdoaWindow:
    """TdoaWindow of what was counted since the window began."""
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
    kept = np.flatnonzero(
        (counters.pair >= 0) & (np.abs(counters.stamps[LAST] - counters.t) < FRESH)
    )
    a, b = np.divmod(counters.pair[kept], len(counters.heard))
    return np.column_stack([a, b, counters.d[kept]])
