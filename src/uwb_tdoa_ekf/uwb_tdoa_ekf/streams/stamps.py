"""Counters of the stamps of one stream, and what they amount to over a window."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

LENGTH = 1.0  # s of a window
# s by which a stamp is ahead of what the arrival allows, or behind the newest: no late packet
JUMP_LIMIT = 1.0
ABSURD = 1e12  # s; no clock says that
MINIMUM = 10  # messages of a window
MAXIMUM = 5000  # messages of a window, for streams whose stamps stand still

# places in the counters; the first three outlive a window
(
    NEWEST,
    LAST,
    LAST_ARRIVAL,
    COUNT,
    BEGIN,
    NOW,
    FALLS,
    DEPTH,
    JUMPS,
    JUMP,
    GAP,
    SAME,
    ZEROS,
    STEPS,
    STEP_SUM,
    STEP_SQUARES,
    LATENCY_MIN,
    LATENCY_MAX,
    ARRIVAL_BEGIN,
    STAMP_BEGIN,
) = range(20)


class StampWindow(NamedTuple):
    """The stamps of one window of messages, in the order of their arrival.

    count : messages; begin, end : s, arrival (or stamp, where the arrival is not known) of the
        first and the last;
    falls : messages stamped before the newest, and depth, s, by how much at most; jumps : stamps
        that leapt by more
    than JUMP_LIMIT, and jump, s, the farthest; gap : s, longest step forward; same : messages with
    the stamp of the one before; zeros : stamps of 0; step : s, mean step forward; scatter :
    standard deviation of the steps over their mean;
    latency, spread : s, smallest arrival minus stamp, and largest minus smallest, NaN where the
        arrival is not known;
    pace : seconds of stamps per second of arrival.
    """

    count: int  # type: ignore[assignment]  # hides tuple.count, which nobody asks for
    begin: float
    end: float
    falls: int
    depth: float
    jumps: int
    jump: float
    gap: float
    same: int
    zeros: int
    step: float
    scatter: float
    latency: float
    spread: float
    pace: float


def new_stamps() -> np.ndarray:
    """Counters (20,) of a stream of which nothing was received."""
    s = np.zeros(20)
    s[NEWEST], s[LAST], s[LAST_ARRIVAL] = -np.inf, np.nan, np.nan
    restart_stamps(s)
    return s


@compiled
def restart_stamps(s: np.ndarray) -> None:
    """Begin a new window."""
    s[COUNT:] = 0.0
    s[BEGIN] = s[NOW] = np.nan
    s[LATENCY_MIN], s[LATENCY_MAX] = np.inf, -np.inf


@compiled
def count_stamp(s: np.ndarray, t: float, arrival: float) -> None:
    """Take the stamp t of one message, s, and when it arrived, s, or NaN."""
    if not abs(arrival) < ABSURD:
        arrival = np.nan
    if not abs(t) < ABSURD:
        s[COUNT] += 1.0
        s[JUMPS] += 1.0
        return
    if math.isnan(s[BEGIN]):
        s[BEGIN] = t if math.isnan(arrival) else arrival
        s[ARRIVAL_BEGIN], s[STAMP_BEGIN] = arrival, t
    s[COUNT] += 1.0
    s[NOW] = t if math.isnan(arrival) else arrival
    if t == 0.0:
        s[ZEROS] += 1.0
    if t == s[LAST]:
        s[SAME] += 1.0
    if s[NEWEST] > -np.inf:
        step = t - s[NEWEST]
        waited = arrival - s[LAST_ARRIVAL]
        if step < -JUMP_LIMIT or step - waited > JUMP_LIMIT:  # never where the arrival is not known
            s[JUMPS] += 1.0
            if abs(step) > abs(s[JUMP]):
                s[JUMP] = step
            s[NEWEST] = t
        elif step < 0.0:
            s[FALLS] += 1.0
            s[DEPTH] = max(s[DEPTH], -step)
        else:
            s[GAP] = max(s[GAP], step)
            s[STEPS] += 1.0
            s[STEP_SUM] += step
            s[STEP_SQUARES] += step * step
            s[NEWEST] = t
    else:
        s[NEWEST] = t
    if not math.isnan(arrival):
        s[LATENCY_MIN], s[LATENCY_MAX] = (
            min(s[LATENCY_MIN], arrival - t),
            max(s[LATENCY_MAX], arrival - t),
        )
    s[LAST], s[LAST_ARRIVAL] = t, arrival


@compiled
def complete(s: np.ndarray) -> bool:
    """True if the window is LENGTH long, and of some messages."""
    return (s[COUNT] >= MINIMUM and abs(s[NOW] - s[BEGIN]) >= LENGTH) or s[COUNT] >= MAXIMUM


def stamp_window(s: np.ndarray) -> StampWindow:
    """StampWindow of what was counted since the window began."""
    steps = max(s[STEPS], 1.0)
    step = s[STEP_SUM] / steps
    variance = max(s[STEP_SQUARES] / steps - step * step, 0.0)
    arrived = s[LAST_ARRIVAL] - s[ARRIVAL_BEGIN]
    return StampWindow(
        count=int(s[COUNT]),
        begin=float(s[BEGIN]),
        end=float(s[NOW]),
        falls=int(s[FALLS]),
        depth=float(s[DEPTH]),
        jumps=int(s[JUMPS]),
        jump=float(s[JUMP]),
        gap=float(s[GAP]),
        same=int(s[SAME]),
        zeros=int(s[ZEROS]),
        step=float(step),
        scatter=float(math.sqrt(variance) / step) if step > 0.0 else 0.0,
        latency=float(s[LATENCY_MIN]) if math.isfinite(s[LATENCY_MIN]) else math.nan,
        spread=float(s[LATENCY_MAX] - s[LATENCY_MIN])
        if math.isfinite(s[LATENCY_MIN])
        else math.nan,
        pace=float((s[LAST] - s[STAMP_BEGIN]) / arrived) if arrived > 0.0 else math.nan,
    )
