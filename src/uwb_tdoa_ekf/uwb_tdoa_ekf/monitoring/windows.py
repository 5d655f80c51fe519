# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Cut the streams of a tag into windows of 1 s and compute the statistics of a window.

Messages are in the order of their arrival. A window compares its messages with earlier ones, so its
columns begin with the messages of the window before. `own` is the number of these messages.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.vibration import VIBRATION_CORNER, low_pass

LENGTH = 1.0  # s, length of a window
MINIMUM = 10  # messages of a window at least
MAXIMUM = 5000  # messages of a window at most, for streams whose stamps stand still
# s by which a stamp is ahead of its arrival, or behind the newest stamp; a late packet stays below
# this
JUMP_LIMIT = 1.0
NO_STAMP = 1e12  # s; no clock has this value
NO_SAMPLE = 1e9  # no inertial sensor returns this, in any unit
NO_TDOA = 1e15  # no radio returns this, in any unit
# s between two TDOAs of a pair below which they are successive, and below which a jump shows
FOLLOWING, LATER = 0.1, 1.0
LEAP = 0.5  # m between successive TDOAs of a pair that no flying tag reaches in that time
FASTEST = 3.0  # m/s, change of a TDOA beyond which later ones jump
# m by which a TDOA may exceed the distance of its anchors before it is impossible
BEYOND = 1.0
# m, resolutions to which a driver might round; the radio's tick is 4.69 mm
GRIDS = np.array([1.0, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01])
ON_MULTIPLE = 1e-6  # m, largest distance from a multiple
# s before the end of a window; TDOAs within it belong together, because no tag moves far in that
# time
FRESH = 0.3


class Cutter:
    """Cut a stream into windows.

    A window lasts LENGTH, by arrival or by stamps if the arrival is unknown. It has MINIMUM to
    MAXIMUM messages.
    """

    def __init__(self) -> None:
        # columns of the window before and of the messages that are in no window yet
        self._columns: list[np.ndarray] = []
        self._before = 0  # messages of the window before

    def cut(self, *columns: np.ndarray) -> list[tuple[list[np.ndarray], int]]:
        """Add messages and return (columns, own) of each window that is complete.

        Parameters
        ----------
        columns : (n,) or (n, k) arrays
            Stamps and arrival times, in s, NaN if unknown; then any values.
        """
        if self._columns:
            self._columns = [np.concatenate(both) for both in zip(self._columns, columns)]
        else:
            self._columns = list(columns)
        time = _times(self._columns[0], self._columns[1])
        windows = []
        before, first = 0, self._before
        end = _end(time, first)
        while end:
            windows.append(([column[before:end] for column in self._columns], first - before))
            before, first = first, end
            end = _end(time, first)
        self._columns = [column[before:] for column in self._columns]
        self._before = first - before
        return windows

    def rest(self) -> tuple[list[np.ndarray], int]:
        """Return (columns, own) of the messages that are in no window yet."""
        return self._columns, self._before

    def __len__(self) -> int:
        """Return the number of messages that are in no window yet."""
        return len(self._columns[0]) - self._before if self._columns else 0


def _times(t: np.ndarray, arrival: np.ndarray) -> np.ndarray:
    """Return arrival times, or stamps if the arrival is unknown: (n,) s, NaN for unusable stamps."""
    time = np.where(np.abs(arrival) < NO_STAMP, arrival, t)
    return np.where(np.abs(t) < NO_STAMP, time, np.nan)


def _end(time: np.ndarray, first: int) -> int:
    """Return the row behind the window that begins with row `first`; 0 if it is not complete."""
    here = time[first : first + MAXIMUM]
    if len(here) < MINIMUM:
        return 0
    begin = here[np.argmax(np.isfinite(here))]
    passed = np.flatnonzero(np.abs(here[MINIMUM - 1 :] - begin) >= LENGTH)
    if len(passed):
        return first + MINIMUM + int(passed[0])
    return first + MAXIMUM if len(here) == MAXIMUM else 0


class StampWindow(NamedTuple):
    """Store the statistics of the stamps in one window, in the order of arrival.

    Attributes
    ----------
    count : int
        Number of messages.
    begin, end : float
        Arrival (or stamp, if the arrival is unknown) of the first and last message, in s.
    falls, depth : int, float
        Messages older than the newest stamp, and the largest such age, in s.
    jumps, jump : int, float
        Stamps that jump by more than JUMP_LIMIT, and the largest jump, in s.
    gap : float
        Longest step forward, in s.
    same : int
        Messages with the stamp of the one before.
    zeros : int
        Messages with stamp 0.
    step : float
        Mean step forward, in s.
    scatter : float
        Standard deviation of the steps divided by their mean.
    latency : float
        Smallest arrival minus stamp, in s; NaN if the arrival is unknown.
    spread : float
        Largest minus smallest arrival minus stamp, in s; NaN if the arrival is unknown.
    pace : float
        Seconds of stamps per second of arrival.
    """

    count: int  # type: ignore[assignment]  # hides tuple.count, which is not needed
    begin: float = math.nan
    end: float = math.nan
    falls: int = 0
    depth: float = 0.0
    jumps: int = 0
    jump: float = 0.0
    gap: float = 0.0
    same: int = 0
    zeros: int = 0
    step: float = 0.0
    scatter: float = 0.0
    latency: float = math.nan
    spread: float = math.nan
    pace: float = math.nan


def stamp_window(t: np.ndarray, arrival: np.ndarray, own: int) -> StampWindow:
    """Return the StampWindow of messages.

    Parameters
    ----------
    t, arrival : (n,) array
        Stamps and arrival times, in s; NaN if unknown.
    own : int
        Number of messages of the window before.
    """
    count = len(t) - own
    usable = np.abs(t) < NO_STAMP
    before = np.count_nonzero(usable[:own])
    t = t[usable]
    arrival = np.where(np.abs(arrival) < NO_STAMP, arrival, np.nan)[usable]
    step, jumps = _steps(t, np.diff(arrival, prepend=np.nan))
    same = np.diff(t, prepend=np.nan) == 0.0
    t, arrival, step, jumps, same = (column[before:] for column in (t, arrival, step, jumps, same))
    if not len(t):
        return StampWindow(count, jumps=count)
    time = _times(t, arrival)
    behind = step[~jumps & (step < 0.0)]
    ahead = step[~jumps & (step >= 0.0)]
    mean = float(ahead.mean()) if len(ahead) else 0.0
    late = arrival - t
    late = late[np.isfinite(late)]
    elapsed = arrival[-1] - arrival[0]
    return StampWindow(
        count,
        begin=float(time[0]),
        end=float(time[-1]),
        falls=len(behind),
        depth=-float(behind.min(initial=0.0)),
        jumps=int(jumps.sum()) + count - len(t),
        jump=max(step[jumps].tolist(), key=abs, default=0.0),
        gap=float(ahead.max(initial=0.0)),
        same=int(same.sum()),
        zeros=int((t == 0.0).sum()),
        step=mean,
        scatter=float(ahead.std()) / mean if mean > 0.0 else 0.0,
        latency=float(late.min()) if len(late) else math.nan,
        spread=float(np.ptp(late)) if len(late) else math.nan,
        pace=float((t[-1] - t[0]) / elapsed) if elapsed > 0.0 else math.nan,
    )


@compiled
def _steps(t: np.ndarray, waited: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far each stamp is ahead of the newest one, in s, and whether it jumps.

    Parameters
    ----------
    t : (n,) array
        Stamps, in s. The first has no step: NaN.
    waited : (n,) array
        Time between the arrivals of successive messages, in s; NaN if unknown.
    """
    step, jumps = np.full(len(t), np.nan), np.zeros(len(t), np.bool_)
    newest = t[0] if len(t) else 0.0
    for i in range(1, len(t)):
        step[i] = t[i] - newest
        # the second test is false if the arrival is unknown
        jumps[i] = step[i] < -JUMP_LIMIT or step[i] - waited[i] > JUMP_LIMIT
        if jumps[i] or step[i] >= 0.0:
            newest = t[i]
    return step, jumps


class ImuWindow(NamedTuple):
    """Store the statistics of one window of inertial samples.

    Rates are in rad/s and the specific force in m/s^2 if the driver is correct. Arrays of 6 are
    gyroscope x y z, then accelerometer x y z.

    Attributes
    ----------
    stamps : StampWindow
        Statistics of the stamps.
    mean, deviation : (6,) array
        Mean and standard deviation.
    vibration : (6,) array
        RMS of the part faster than VIBRATION_CORNER.
    still : (6,) array
        Share of samples equal to the one before, per channel.
    repeated : float
        Share of samples in which all six channels equal the one before.
    clipped : (6,) array
        Number of samples at the farther end of the range of the channel.
    limit : (6,) array
        Value at that end.
    invalid : float
        Share of samples that are not finite.
    halves : float
        Share of samples of which one sensor is all zeros, in turns with the other.
    """

    stamps: StampWindow
    mean: np.ndarray
    deviation: np.ndarray
    vibration: np.ndarray
    still: np.ndarray
    repeated: float
    clipped: np.ndarray
    limit: np.ndarray
    invalid: float
    halves: float = 0.0


def imu_window(columns: list[np.ndarray], own: int) -> ImuWindow:
    """Return the ImuWindow of samples.

    Parameters
    ----------
    columns : list of array
        Stamps and arrival times (n,), in s; angular velocity and specific force (n, 3) as in the
        message.
    own : int
        Number of samples of the window before.
    """
    t, arrival, gyro, force = columns
    values = np.column_stack([gyro, force])
    valid = (np.abs(values) < NO_SAMPLE).all(axis=1)
    before = np.count_nonzero(valid[:own])
    elapsed = np.nan_to_num(np.diff(t, prepend=t[:1]), posinf=0.0, neginf=0.0)
    values, elapsed = values[valid], np.maximum(elapsed[valid], 0.0)
    same = np.zeros(values.shape, bool)
    same[1:] = values[1:] == values[:-1]
    fast = values - _smoothed(values, elapsed)
    values, same, fast = values[before:], same[before:], fast[before:]
    n = max(len(values), 1)
    mean = values.sum(axis=0) / n
    low = values.min(axis=0, initial=np.inf)
    high = values.max(axis=0, initial=-np.inf)
    limit = np.where(mean - low > high - mean, low, high)
    no_gyro, no_force = (values[:, :3] == 0.0).all(axis=1), (values[:, 3:] == 0.0).all(axis=1)
    halves = 2 * min(np.sum(no_gyro & ~no_force), np.sum(no_force & ~no_gyro))
    return ImuWindow(
        stamps=stamp_window(t, arrival, own),
        mean=mean,
        deviation=np.sqrt(((values - mean) ** 2).sum(axis=0) / n),
        vibration=np.sqrt((fast**2).sum(axis=0) / n),
        still=same.sum(axis=0) / n,
        repeated=float(same.all(axis=1).sum() / n),
        clipped=(values == limit).sum(axis=0),
        limit=limit,
        invalid=1.0 - len(values) / (len(t) - own),
        halves=float(halves / n),
    )


@compiled
def _smoothed(values: np.ndarray, elapsed: np.ndarray) -> np.ndarray:
    """Return samples (n, k) behind a low pass; `elapsed` (n,), in s, since the sample before."""
    slow = values.copy()
    for i in range(1, len(values)):
        for k in range(values.shape[1]):
            slow[i, k] = low_pass(slow[i - 1, k], values[i, k], elapsed[i], VIBRATION_CORNER)
    return slow


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
    returns : int
        Successive, with a jump of more than LEAP back to the value before, which came in this window
        or in the one before.
    later, later_returns : int
        The same of those within LATER of the last one of the pair, with a jump beyond FASTEST.
    opposed : int
        Pairs that are heard in both orders, with means beyond LEAP.
    even : int
        Opposed, with equal signs in both orders.
    size : float
        Mean |d|, in m.
    ceiling, hits : float, int
        Largest |d|, in m, and how many TDOAs have it if it is of several pairs.
    grids : (7,) array
        Share of the values that are multiples of GRIDS.
    heard : (N,) array
        Number of TDOAs of each anchor.
    steps : (k,) array
        Sizes of the jumps of successive TDOAs, in m.
    latest : (k, 3) array
        Rows of both anchors and value, in m, of the last TDOA of each pair whose stamp is within
        FRESH of the stamp that arrived last.
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
    returns: int
    later: int
    later_returns: int
    opposed: int
    even: int
    size: float
    ceiling: float
    hits: int
    grids: np.ndarray
    heard: np.ndarray
    steps: np.ndarray
    latest: np.ndarray


def tdoa_window(columns: list[np.ndarray], own: int, positions: np.ndarray) -> TdoaWindow:
    """Return the TdoaWindow of TDOAs.

    Parameters
    ----------
    columns : list of array
        Stamps and arrival times, in s, rows of both anchors, negative if unknown, and values as
        received, (n,) each.
    own : int
        Number of TDOAs of the window before.
    positions : (N, 3) array
        Anchor positions in the world frame, in m.
    """
    t, arrival, a, b, d = columns
    t = np.where(np.abs(t) < NO_STAMP, t, np.nan)
    unknown = (a < 0) | (b < 0)
    of_one = ~unknown & (a == b)
    invalid = ~unknown & ~of_one & ~(np.abs(d) < NO_TDOA)
    known = np.flatnonzero(~(unknown | of_one | invalid))
    mine = known[known >= own]
    size = np.abs(d[mine])
    ceiling = float(size.max(initial=0.0))
    apart = np.linalg.norm(positions[a[mine]] - positions[b[mine]], axis=1)
    off_grid = size[:, None] - GRIDS * np.round(size[:, None] / GRIDS)

    pair = a * len(positions) + b
    order, duplicates = _by_pair(known, pair, t, d)
    # each TDOA beside the last one of its pair, and the value before that
    here, last = order[1:], order[:-1]
    before_last = np.full(len(d), np.nan)
    third = pair[order[2:]] == pair[order[:-2]]
    before_last[order[2:][third]] = d[order[:-2][third]]
    since = t[here] - t[last]
    soon = (pair[here] == pair[last]) & (since >= 0.0) & (since < LATER) & (here >= own)
    here, last, since = here[soon], last[soon], since[soon]
    step, later = np.abs(d[here] - d[last]), since >= FOLLOWING
    leaps = step > LEAP + FASTEST * np.where(later, since, 0.0)
    back = np.abs(d[here] - before_last[here])
    returns = leaps & (back < 0.5 * np.where(later, step, LEAP))

    either = np.minimum(a, b) * len(positions) + np.maximum(a, b)
    opposed, even = _both_orders(either[mine], (a < b)[mine], d[mine])

    # a timer that repeats the largest value of one pair clips nothing
    at_ceiling = mine[size == ceiling]
    hits = len(at_ceiling) if len(np.unique(either[at_ceiling])) > 1 else 0

    # the TDOAs of one blink share a stamp and an anchor, and each is of another pair
    again = np.zeros(len(t), bool)
    again[order[1:]] = (pair[order[1:]] == pair[order[:-1]]) & (t[order[1:]] == t[order[:-1]])
    with_last = (np.diff(t, prepend=np.nan) == 0.0) & (
        (np.diff(a, prepend=-1) == 0) | (np.diff(b, prepend=-1) == 0)
    )
    first = np.flatnonzero(again | ~with_last)
    of_blinks = stamp_window(t[first], arrival[first], np.count_nonzero(first < own))

    latest = order[np.flatnonzero(np.diff(pair[order], append=-1))]
    newest = t[np.isfinite(t)][-1:]
    latest = latest[(np.abs(t[latest, None] - newest) < FRESH).any(axis=1)]
    return TdoaWindow(
        stamps=stamp_window(t, arrival, own)._replace(
            same=of_blinks.same, scatter=of_blinks.scatter
        ),
        known=len(mine),
        unknown=int(unknown[own:].sum()),
        of_one=int(of_one[own:].sum()),
        invalid=int(invalid[own:].sum()),
        impossible=int((size > apart + BEYOND).sum()),
        duplicates=int((duplicates >= own).sum()),
        successive=int((~later).sum()),
        repeated=int((step[~later] == 0.0).sum()),
        returns=int(returns[~later].sum()),
        later=int(later.sum()),
        later_returns=int(returns[later].sum()),
        opposed=opposed,
        even=even,
        size=float(size.mean()) if len(size) else 0.0,
        ceiling=ceiling,
        hits=hits,
        grids=(np.abs(off_grid) < ON_MULTIPLE).sum(axis=0) / max(len(mine), 1),
        heard=np.bincount(np.concatenate([a[mine], b[mine]]), minlength=len(positions)),
        steps=step[leaps & ~later],
        latest=np.column_stack([a[latest], b[latest], d[latest]]),
    )


def _by_pair(
    rows: np.ndarray, pair: np.ndarray, t: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return TDOAs pair by pair, those of a pair in the order of arrival, and the duplicates.

    Parameters
    ----------
    rows : (k,) int array
        TDOAs in the order of arrival.
    pair : (n,) int array
        Number of the pair of each TDOA.
    t, d : (n,) array
        Stamps, in s, and values, in m.
    """
    order = rows[np.argsort(pair[rows], kind="stable")]
    here, last = order[1:], order[:-1]
    twice = np.zeros(len(order), bool)
    twice[1:] = (pair[here] == pair[last]) & (t[here] == t[last]) & (d[here] == d[last])
    return order[~twice], order[twice]


def _both_orders(pair: np.ndarray, forward: np.ndarray, d: np.ndarray) -> tuple[int, int]:
    """Return how many pairs are heard in both orders, and in how many both have the same sign.

    A pair counts if its mean exceeds LEAP in both orders.

    Parameters
    ----------
    pair : (n,) int array
        Number of the pair of each TDOA, the same in both orders.
    forward : (n,) array of bool
        Whether the anchor with the lower row comes first.
    d : (n,) array
        Values, in m.
    """
    _, place = np.unique(pair, return_inverse=True)
    size = place.max(initial=-1) + 1
    means = []
    for some in (forward, ~forward):
        count = np.bincount(place[some], minlength=size)
        means.append(np.bincount(place[some], d[some], size) / np.where(count, count, np.nan))
    one, other = means
    opposed = (np.abs(one) > LEAP) & (np.abs(other) > LEAP)
    return int(opposed.sum()), int((opposed & (one * other > 0.0)).sum())
