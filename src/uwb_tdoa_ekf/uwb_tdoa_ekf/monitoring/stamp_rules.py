# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Count the stamps of a stream over windows of 1 s and check the windows."""

from __future__ import annotations

import math
import statistics
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

from .finding import ERROR, NOTE, WARNING, Finding

if TYPE_CHECKING:
    from collections.abc import Iterable

LENGTH = 1.0  # s, length of a window
# s by which a stamp is ahead of its arrival, or behind the newest stamp; a late packet stays below
# this
JUMP_LIMIT = 1.0
ABSURD = 1e12  # s; no clock has this value
MINIMUM = 10  # messages of a window at least
MAXIMUM = 5000  # messages of a window at most, for streams whose stamps stand still

# places in the counters; the first three are kept between windows
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

STAMP_LINE = (
    "message.header.stamp = ...  # when the sample was measured, ROS time, in seconds and "
    "nanoseconds"
)
SLOWEST = {"imu/data": 50.0, "uwb/tdoa": 20.0}  # Hz; healthy 946 and 191 at least
# s between stamps; healthy 0.012 and 0.116 at most
LONGEST_GAP = {"imu/data": 0.1, "uwb/tdoa": 0.5}
SCATTER = 3.0  # standard deviation of the steps over their mean; healthy 1.4 at most
# share of stamps that equal the one before, healthy 0; s between different stamps
REPEATED, LEAP = (0.3, 0.01)
PACE = 0.05  # largest difference between the pace of the stamps and of the clock
# s by which arrivals of a window, or of two streams, must differ from their stamps to count
APART = 0.1
LATEST = 5.0  # s that TDOAs may be late; a larger value means another clock
DRIFT, DRIFTED = 3e-4, 0.03  # s/s, and s over the recording, above which a drift is reported
# s, default waiting times of ekf_node
LAG, REORDER = (0.25, 0.003)
UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


def median(values: Iterable[float]) -> float:
    """Return the median; NaN for no values or if any value is NaN.

    For so few values, numpy takes thirty times as long.
    """
    values = [float(value) for value in values]
    return math.nan if not values or any(map(math.isnan, values)) else statistics.median(values)


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
    """Return the counters (20,) of a stream without messages."""
    s = np.zeros(20)
    s[NEWEST], s[LAST], s[LAST_ARRIVAL] = -np.inf, np.nan, np.nan
    restart_stamps(s)
    return s


@compiled
def restart_stamps(s: np.ndarray) -> None:
    """Reset the counters for a new window."""
    s[COUNT:] = 0.0
    s[BEGIN] = s[NOW] = np.nan
    s[LATENCY_MIN], s[LATENCY_MAX] = np.inf, -np.inf


@compiled
def count_stamp(s: np.ndarray, t: float, arrival: float) -> None:
    """Count the stamp t of one message, in s, and its arrival time, in s or NaN."""
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
        # the second test is false if the arrival is unknown
        if step < -JUMP_LIMIT or step - waited > JUMP_LIMIT:
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
    """Return whether the window is LENGTH long and has enough messages."""
    return (s[COUNT] >= MINIMUM and abs(s[NOW] - s[BEGIN]) >= LENGTH) or s[COUNT] >= MAXIMUM


def stamp_window(s: np.ndarray) -> StampWindow:
    """Return the StampWindow of the messages since the window began."""
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


def total(windows: list[StampWindow], field: str) -> int:
    """Return the sum of a field of StampWindow over windows."""
    return sum(getattr(window, field) for window in windows)


def median_of(windows: list[StampWindow], field: str) -> float:
    """Return the median of the finite values of a field of StampWindow; NaN without any."""
    return median(value for window in windows if math.isfinite(value := getattr(window, field)))


def pace_of(windows: list[StampWindow]) -> float:
    """Return the seconds of stamps per second of arrival; NaN if arrivals are unknown.

    There are two estimates. The first compares the first and last message of a window, and blocks of
    messages disturb it. The second compares the smallest latencies of successive windows, and jumps
    of the stamps disturb it. The one closer to 1 is returned, so one disturbance raises no alarm.
    """
    known = [(window.end, window.latency) for window in windows if math.isfinite(window.latency)]
    ratios = [median_of(windows, "pace")]
    changes = [
        (end_2 - end, latency_2 - latency)
        for (end, latency), (end_2, latency_2) in zip(known, known[1:])
    ]
    if changes and all(elapsed > 0.0 for elapsed, _ in changes):  # else windows are out of order
        # latency = arrival - stamp, so d stamp / d arrival = 1 - d latency / d arrival
        ratios.append(1.0 - median(latency / elapsed for elapsed, latency in changes))
    return min(ratios, key=lambda ratio: abs(ratio - 1.0) if math.isfinite(ratio) else math.inf)


def orderly(windows: list[StampWindow]) -> bool:
    """Return False for stamps that make all other checks meaningless.

    Such stamps are 0, stand still, jump (once is enough), or run at another pace than the arrivals,
    as in another unit. An unknown pace, NaN without arrivals, counts as right.
    """
    count, ratio = total(windows, "count"), pace_of(windows)
    broken = (
        total(windows, "zeros") > 0.01 * count
        or total(windows, "same") > 0.98 * count
        or total(windows, "jumps") > 0
    )
    return not broken and not abs(ratio - 1.0) > PACE


def zeros(name: str, windows: list[StampWindow]) -> Finding | None:
    share = total(windows, "zeros") / total(windows, "count")
    if share > 0.01:
        evidence = f"{100.0 * share:.0f} % of the stamps are 0"
        return Finding("stamps_zero", ERROR, f"{name} is not stamped", evidence, STAMP_LINE, share)
    return None


def standing(name: str, windows: list[StampWindow]) -> Finding | None:
    """Return a Finding if many messages share one stamp, or stamps come in bursts."""
    share = total(windows, "same") / total(windows, "count")
    if total(windows, "zeros") > 0.01 * total(windows, "count"):
        return None
    if share > 0.98:
        cause = f"the stamps of {name} stand still"
        return Finding(
            "stamps_stand",
            ERROR,
            cause,
            f"{100.0 * share:.0f} % repeat the one before",
            STAMP_LINE,
            share,
        )
    scatter, step = median_of(windows, "scatter"), median_of(windows, "gap")
    packets = share > REPEATED and median_of(windows, "step") > LEAP * (1.0 - share)
    if not (packets or scatter > SCATTER):
        return None
    evidence = f"{100.0 * share:.0f} % repeat the one before, then they leap by {step:.3f} s"
    if packets:
        cause = (
            f"the stamps of {name} come in steps of {step:.3f} s: a coarse clock, or one stamp "
            "for a packet of samples"
        )
    else:
        cause = (
            f"the messages of {name} are stamped when they are read, in bursts, or nanosec holds "
            "microseconds"
        )
        evidence = (
            f"steps of {median_of(windows, 'step'):.4f} s on average scatter by {scatter:.1f} times "
            "that"
        )
    severity = ERROR if step > LAG else WARNING
    return Finding("stamps_coarse", severity, cause, evidence, STAMP_LINE, step)


def falls(name: str, windows: list[StampWindow]) -> Finding | None:
    share = total(windows, "falls") / total(windows, "count")
    depth = max(window.depth for window in windows)
    if share < 1e-3 or depth <= REORDER:
        return None
    severity = WARNING if depth < LAG else ERROR
    evidence = f"{100.0 * share:.1f} % come after a later one, by up to {depth:.3f} s"
    remedy = (
        f"-p reorder:={1.2 * depth:.3f} -p lag:={max(LAG, 2.0 * depth):.2f}  # of ekf_node, or "
        "publish them in order"
    )
    return Finding(
        "stamps_fall", severity, f"messages of {name} are out of order", evidence, remedy, depth
    )


def jumps(name: str, windows: list[StampWindow]) -> Finding | None:
    count = total(windows, "jumps")
    if not count or abs(pace_of(windows) - 1.0) > PACE:
        return None
    farthest = max((window.jump for window in windows), key=abs)
    evidence = f"{count} leaps, the farthest of {farthest:+.3f} s"
    return Finding(
        "stamps_jump", ERROR, f"the clock of {name} jumps", evidence, STAMP_LINE, farthest
    )


def gaps(name: str, windows: list[StampWindow]) -> Finding | None:
    longest, limit = max(window.gap for window in windows), LONGEST_GAP[name]
    if (
        longest <= limit
        or median_of(windows, "scatter") > SCATTER
        or median_of(windows, "step") > limit
        or not orderly(windows)
    ):
        return None
    count = sum(window.gap > limit for window in windows)
    evidence = (
        f"{count} gaps, the longest of {longest:.2f} s; more than {limit:.1f} s is coasted over"
    )
    remedy = (
        f"ros2 topic hz {name}  # check the radio, the load of the machine and the depth of the "
        "queue"
    )
    return Finding("gap", WARNING, f"{name} falls silent in between", evidence, remedy, longest)


def rate(name: str, windows: list[StampWindow]) -> Finding | None:
    """Return a Finding if the rate by stamps is too low; a very low rate indicates another unit."""
    step = median_of(windows, "step")
    if not step > 1.0 / SLOWEST[name]:
        return None
    for scale, unit in UNITS.items():
        if 1e-5 < step / scale < 1.0 / SLOWEST[name] and step > 0.5:
            line = (
                f"stamp = rclpy.time.Time(seconds=ticks / {scale:.0e}).to_msg()  # the clock "
                f"counts {unit}"
            )
            evidence = f"{step:.3g} s from one stamp to the next"
            return Finding(
                "stamps_unit", ERROR, f"the stamps of {name} are in {unit}", evidence, line, scale
            )
    evidence = f"{1.0 / step:.1f} Hz; below {SLOWEST[name]:.0f} Hz the estimate gets worse"
    return Finding(
        "rate", WARNING, f"{name} is slow", evidence, "raise the rate of the driver", 1.0 / step
    )


def pace(name: str, windows: list[StampWindow]) -> Finding | None:
    """Return a Finding if a second of stamps is not a second of arrival."""
    ratio = pace_of(windows)
    if (
        not abs(ratio - 1.0) > PACE
        or total(windows, "zeros")
        or total(windows, "same") > 0.98 * total(windows, "count")
    ):
        return None
    unit = next((unit for scale, unit in UNITS.items() if 0.5 < ratio / scale < 2.0), None)
    cause = f"the stamps of {name} " + (f"are in {unit}" if unit else "do not run with the clock")
    return Finding(
        "stamps_unit", ERROR, cause, f"{ratio:.4g} s of stamps in 1 s", STAMP_LINE, ratio
    )


def blocks(name: str, windows: list[StampWindow]) -> Finding | None:
    """Return a Finding if the latency varies strongly, because messages are sent in blocks."""
    spread = median_of(windows, "spread")
    if not spread > APART or median_of(windows, "scatter") > SCATTER or not orderly(windows):
        return None
    severity = ERROR if spread > LAG else WARNING
    cause = f"the messages of {name} arrive in blocks"
    evidence = f"the latency swings by {spread:.2f} s within a second; the nodes wait {LAG:.2f} s"
    return Finding(
        "blocks",
        severity,
        cause,
        evidence,
        f"-p lag:={1.5 * spread:.2f}  # of ekf_node; or send them one by one",
        spread,
    )


def drift(name: str, windows: list[StampWindow]) -> Finding | None:
    """Return a Finding if the clock of the stamps drifts against the clock of the arrivals.

    The drift is the Theil-Sen slope of the smallest latencies.
    """
    known = [(window.begin, window.latency) for window in windows if math.isfinite(window.latency)]
    if len(known) < 10 or not orderly(windows):
        return None
    t, latency = np.array(known[:: max(1, len(known) // 200)]).T
    i, k = np.triu_indices(len(t), len(t) // 3)
    slope = float(np.median((latency[k] - latency[i]) / (t[k] - t[i])))
    if abs(slope) < DRIFT or abs(slope) * np.ptp(t) < DRIFTED:
        return None
    evidence = f"{1e3 * slope:+.2f} ms/s, {1e3 * slope * np.ptp(t):+.0f} ms in {np.ptp(t):.0f} s"
    cause = f"the clock of {name} runs {'slow' if slope > 0.0 else 'fast'} of that of this machine"
    return Finding(
        "clock_drift",
        WARNING,
        cause,
        evidence,
        "chronyc tracking  # synchronise the clocks, or stamp on arrival",
        slope,
    )


OF_ONE = (zeros, standing, falls, jumps, gaps, rate, pace, blocks, drift)


def offset(imu: list[StampWindow], tdoa: list[StampWindow]) -> Finding | None:
    """Return a Finding if the clocks of the IMU and the TDOAs differ.

    The latencies are compared if arrivals are known. Otherwise the beginnings and ends are
    compared.
    """
    if not (orderly(imu) and orderly(tdoa)):
        return None
    by_arrival = median_of(tdoa, "latency") - median_of(imu, "latency")
    if math.isfinite(by_arrival):
        ahead, evidence = (
            by_arrival,
            f"stamp minus arrival: {-median_of(imu, 'latency'):+.3f} s of the IMU, ",
        )
        evidence += f"{-median_of(tdoa, 'latency'):+.3f} s of the TDOAs"
    else:
        begin, end = imu[0].begin - tdoa[0].begin, imu[-1].end - tdoa[-1].end
        ahead = 0.5 * (begin + end)
        evidence = f"the IMU begins {begin:+.3f} s and ends {end:+.3f} s after the TDOAs"
        # the streams do not overlap
        outside = imu[0].begin > tdoa[-1].end or imu[-1].end < tdoa[0].begin
        alike = (
            min(abs(begin), abs(end)) >= APART
            and begin * end > 0.0
            and abs(end - begin) <= 0.3 * abs(ahead)
        )
        if not (outside or alike):
            return None
    if abs(ahead) < APART:
        return None
    severity = ERROR if abs(ahead) > LAG else WARNING
    if _late(by_arrival, median_of(tdoa, "latency"), median_of(imu, "latency")):
        cause = (
            f"the TDOAs arrive {median_of(tdoa, 'latency'):.3f} s after their stamps, the IMU's "
            "samples in time"
        )
        line = (
            f"-p lag:={1.5 * by_arrival:.2f}  # of ekf_node, if the TDOAs are stamped when they "
            "are measured; else stamp them so"
        )
        return Finding("stamps_apart", severity, cause, evidence, line, ahead)
    cause = (
        f"the stamps of imu/data are {abs(ahead):.3f} s {'ahead of' if ahead > 0.0 else 'behind'} "
        "those of uwb/tdoa"
    )
    line = (
        f"t_imu {'-' if ahead > 0.0 else '+'}= {abs(ahead):.3f}  # s; or stamp both with the "
        "clock of one machine"
    )
    return Finding("stamps_apart", severity, cause, evidence, line, ahead)


def _late(by_arrival: float, tdoa: float, imu: float) -> bool:
    """Return whether TDOAs are late although both streams use the clock of the arrivals.

    Parameters
    ----------
    by_arrival : float
        Latency of the TDOAs minus latency of the IMU, in s.
    tdoa, imu : float
        Latencies, in s. With a common clock, no stamp is ahead of its arrival.
    """
    return (
        math.isfinite(by_arrival) and by_arrival > APART and -APART < imu < APART and tdoa < LATEST
    )


def other_clock(imu: list[StampWindow], tdoa: list[StampWindow]) -> Finding | None:
    """Return a Finding if both streams share a clock that differs from the recorder's."""
    latency = median_of(tdoa, "latency")
    if not (orderly(imu) and orderly(tdoa)):
        return None
    if not abs(latency) > 1.0 or abs(latency - median_of(imu, "latency")) > LAG:
        return None
    evidence = f"they arrive {latency:.3f} s after their stamps"
    line = (
        "message.header.stamp = node.get_clock().now().to_msg()  # or what you measured, on that "
        "clock"
    )
    return Finding(
        "other_clock",
        NOTE,
        "the stamps are not of the clock of the machine that records",
        evidence,
        line,
        latency,
    )


OF_BOTH = (offset, other_clock)
