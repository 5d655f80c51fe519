# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check the stamps of a stream, and of both streams of a tag.

A rule takes windows and yields Findings. Rules of one stream also take the name of its topic.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import math
import statistics
from typing import Any

import numpy as np

from .finding import ERROR, NOTE, WARNING, Finding
from .windows import StampWindow

STAMP_LINE = (
    "message.header.stamp = ...  # when the sample was measured, ROS time, in seconds and "
    "nanoseconds"
)
SLOWEST = {"imu/data": 50.0, "uwb/tdoa": 20.0}  # Hz; healthy 946 and 191 at least
ANOTHER_UNIT = 25.0  # times the longest usual step: 1.25 s between TDOAs, as of milliseconds
# s between stamps; healthy 0.012 and 0.116 at most
LONGEST_GAP = {"imu/data": 0.1, "uwb/tdoa": 0.5}
UNSTAMPED, STANDING = 0.01, 0.98  # shares of stamps that are 0, and that equal the one before
SCATTER = 3.0  # standard deviation of the steps over their mean; healthy 1.4 at most
# share of stamps that equal the one before, healthy 0; s between different stamps
REPEATED, LEAP = (0.3, 0.01)
PACE = 0.05  # largest difference between the pace of the stamps and of the clock
# s by which arrivals of a window, or of two streams, must differ from their stamps to count
APART = 0.1
LATEST = 5.0  # s that TDOAs may be late; a larger value means another clock
ENDS = 3.0  # s by which the IMU may begin later than the TDOAs, or end earlier
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


def total(windows: Sequence[Any], field: str) -> int:
    """Return the sum of a count over windows of any kind."""
    return sum(getattr(window, field) for window in windows)


def share_of(windows: Sequence[Any], field: str, among: str = "count") -> float:
    """Return the sum of one count over windows of any kind divided by the sum of another."""
    return total(windows, field) / max(total(windows, among), 1)


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
    return not (
        share_of(windows, "zeros") > UNSTAMPED
        or share_of(windows, "same") > STANDING
        or total(windows, "jumps") > 0
        or _other_pace(windows)
    )


def _other_pace(windows: list[StampWindow]) -> bool:
    return abs(pace_of(windows) - 1.0) > PACE


def zeros(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    share = share_of(windows, "zeros")
    if share > UNSTAMPED:
        yield Finding(
            "stamps_zero",
            ERROR,
            cause=f"{name} is not stamped",
            evidence=f"{100.0 * share:.0f} % of the stamps are 0",
            remedy=STAMP_LINE,
            value=share,
        )


def standing(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if many messages share one stamp, or stamps come in bursts."""
    share = share_of(windows, "same")
    if share_of(windows, "zeros") > UNSTAMPED:
        return
    if share > STANDING:
        yield Finding(
            "stamps_stand",
            ERROR,
            cause=f"the stamps of {name} stand still",
            evidence=f"{100.0 * share:.0f} % repeat the one before",
            remedy=STAMP_LINE,
            value=share,
        )
        return
    scatter, step = median_of(windows, "scatter"), median_of(windows, "gap")
    severity = ERROR if step > LAG else WARNING
    if share > REPEATED and median_of(windows, "step") > LEAP * (1.0 - share):
        yield Finding(
            "stamps_coarse",
            severity,
            cause=(
                f"the stamps of {name} come in steps of {step:.3f} s: a coarse clock, or one stamp "
                "for a packet of samples"
            ),
            evidence=f"{100.0 * share:.0f} % repeat the one before, then they leap by {step:.3f} s",
            remedy=STAMP_LINE,
            value=step,
        )
    elif scatter > SCATTER:
        yield Finding(
            "stamps_coarse",
            severity,
            cause=(
                f"the messages of {name} are stamped when they are read, in bursts, or nanosec "
                "holds microseconds"
            ),
            evidence=(
                f"steps of {median_of(windows, 'step'):.4f} s on average scatter by {scatter:.1f} "
                "times that"
            ),
            remedy=STAMP_LINE,
            value=step,
        )


def falls(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    share = share_of(windows, "falls")
    depth = max(window.depth for window in windows)
    if share >= 1e-3 and depth > REORDER:
        yield Finding(
            "stamps_fall",
            WARNING if depth < LAG else ERROR,
            cause=f"messages of {name} are out of order",
            evidence=f"{100.0 * share:.1f} % come after a later one, by up to {depth:.3f} s",
            remedy=(
                f"-p reorder:={1.2 * depth:.3f} -p lag:={max(LAG, 2.0 * depth):.2f}  # of "
                "ekf_node, "
                "or publish them in order"
            ),
            value=depth,
        )


def jumps(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    count = total(windows, "jumps")
    if count and not _other_pace(windows):
        farthest = max((window.jump for window in windows), key=abs)
        yield Finding(
            "stamps_jump",
            ERROR,
            cause=f"the clock of {name} jumps",
            evidence=f"{count} leaps, the farthest of {farthest:+.3f} s",
            remedy=STAMP_LINE,
            value=farthest,
        )


def gaps(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    longest, limit = max(window.gap for window in windows), LONGEST_GAP[name]
    if (
        longest > limit
        and not median_of(windows, "scatter") > SCATTER
        and not median_of(windows, "step") > limit
        and orderly(windows)
    ):
        count = sum(window.gap > limit for window in windows)
        yield Finding(
            "gap",
            WARNING,
            cause=f"{name} falls silent in between",
            evidence=(
                f"{count} gaps, the longest of {longest:.2f} s; more than {limit:.1f} s is coasted "
                "over"
            ),
            remedy=(
                f"ros2 topic hz {name}  # check the radio, the load of the machine and the depth "
                "of the queue"
            ),
            value=longest,
        )


def rate(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if the rate by stamps is too low; a very low rate indicates another unit."""
    step, slowest = median_of(windows, "step"), 1.0 / SLOWEST[name]
    if not step > slowest:
        return
    scale = next((scale for scale in UNITS if 1e-5 < step / scale < slowest), 0.0)
    if scale and step > ANOTHER_UNIT * slowest:
        yield Finding(
            "stamps_unit",
            ERROR,
            cause=f"the stamps of {name} are in {UNITS[scale]}",
            evidence=f"{step:.3g} s from one stamp to the next",
            remedy=(
                f"stamp = rclpy.time.Time(seconds=ticks / {scale:.0e}).to_msg()  # the clock "
                f"counts {UNITS[scale]}"
            ),
            value=scale,
        )
    else:
        yield Finding(
            "rate",
            WARNING,
            cause=f"{name} is slow",
            evidence=f"{1.0 / step:.1f} Hz; below {SLOWEST[name]:.0f} Hz the estimate gets worse",
            remedy="raise the rate of the driver",
            value=1.0 / step,
        )


def pace(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if a second of stamps is not a second of arrival."""
    ratio = pace_of(windows)
    if (
        _other_pace(windows)
        and not total(windows, "zeros")
        and share_of(windows, "same") <= STANDING
    ):
        unit = next((unit for scale, unit in UNITS.items() if 0.5 < ratio / scale < 2.0), "")
        how = f"are in {unit}" if unit else "do not run with the clock"
        yield Finding(
            "stamps_unit",
            ERROR,
            cause=f"the stamps of {name} {how}",
            evidence=f"{ratio:.4g} s of stamps in 1 s",
            remedy=STAMP_LINE,
            value=ratio,
        )


def blocks(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if the latency varies strongly, because messages are sent in blocks."""
    spread = median_of(windows, "spread")
    if spread > APART and not median_of(windows, "scatter") > SCATTER and orderly(windows):
        yield Finding(
            "blocks",
            ERROR if spread > LAG else WARNING,
            cause=f"the messages of {name} arrive in blocks",
            evidence=(
                f"the latency swings by {spread:.2f} s within a second; the nodes wait {LAG:.2f} s"
            ),
            remedy=f"-p lag:={1.5 * spread:.2f}  # of ekf_node; or send them one by one",
            value=spread,
        )


def drift(name: str, windows: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if the clock of the stamps drifts against the clock of the arrivals.

    The drift is the Theil-Sen slope of the smallest latencies.
    """
    known = [(window.begin, window.latency) for window in windows if math.isfinite(window.latency)]
    if len(known) < 10 or not orderly(windows):
        return
    t, latency = np.array(known[:: max(1, len(known) // 200)]).T
    i, k = np.triu_indices(len(t), len(t) // 3)
    slope = float(np.median((latency[k] - latency[i]) / (t[k] - t[i])))
    duration = np.ptp(t)
    if abs(slope) >= DRIFT and abs(slope) * duration >= DRIFTED:
        how = "slow" if slope > 0.0 else "fast"
        yield Finding(
            "clock_drift",
            WARNING,
            cause=f"the clock of {name} runs {how} of that of this machine",
            evidence=(
                f"{1e3 * slope:+.2f} ms/s, {1e3 * slope * duration:+.0f} ms in {duration:.0f} s"
            ),
            remedy="chronyc tracking  # synchronise the clocks, or stamp on arrival",
            value=slope,
        )


OF_ONE = (zeros, standing, falls, jumps, gaps, rate, pace, blocks, drift)


def offset(imu: list[StampWindow], tdoa: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if the clocks of the IMU and the TDOAs differ.

    The latencies are compared if arrivals are known. Otherwise the beginnings and ends are
    compared.
    """
    if not (orderly(imu) and orderly(tdoa)):
        return
    imu_late, tdoa_late = median_of(imu, "latency"), median_of(tdoa, "latency")
    by_arrival = tdoa_late - imu_late
    if math.isfinite(by_arrival):
        ahead = by_arrival
        evidence = (
            f"stamp minus arrival: {-imu_late:+.3f} s of the IMU, {-tdoa_late:+.3f} s of the TDOAs"
        )
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
            return
    if abs(ahead) < APART:
        return
    severity = ERROR if abs(ahead) > LAG else WARNING
    if _late(by_arrival, tdoa_late, imu_late):
        yield Finding(
            "stamps_apart",
            severity,
            cause=(
                f"the TDOAs arrive {tdoa_late:.3f} s after their stamps, the IMU's samples in time"
            ),
            evidence=evidence,
            remedy=(
                f"-p lag:={1.5 * by_arrival:.2f}  # of ekf_node, if the TDOAs are stamped when "
                "they "
                "are measured; else stamp them so"
            ),
            value=ahead,
        )
    else:
        where, sign = ("ahead of", "-") if ahead > 0.0 else ("behind", "+")
        yield Finding(
            "stamps_apart",
            severity,
            cause=f"the stamps of imu/data are {abs(ahead):.3f} s {where} those of uwb/tdoa",
            evidence=evidence,
            remedy=(
                f"t_imu {sign}= {abs(ahead):.3f}  # s; or stamp both with the clock of one machine"
            ),
            value=ahead,
        )


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


def other_clock(imu: list[StampWindow], tdoa: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if both streams share a clock that differs from the recorder's."""
    latency = median_of(tdoa, "latency")
    together = not abs(latency - median_of(imu, "latency")) > LAG
    if abs(latency) > 1.0 and together and orderly(imu) and orderly(tdoa):
        yield Finding(
            "other_clock",
            NOTE,
            cause="the stamps are not of the clock of the machine that records",
            evidence=f"they arrive {latency:.3f} s after their stamps",
            remedy=(
                "message.header.stamp = node.get_clock().now().to_msg()  # or what you measured, "
                "on that clock"
            ),
            value=latency,
        )


def partly(imu: list[StampWindow], tdoa: list[StampWindow]) -> Iterator[Finding]:
    """Yield a Finding if the IMU begins long after the TDOAs, or ends long before them."""
    late, early = imu[0].begin - tdoa[0].begin, tdoa[-1].end - imu[-1].end
    if max(late, early) > ENDS and min(late, early) > -ENDS and orderly(imu) and orderly(tdoa):
        yield Finding(
            "imu_partly",
            WARNING,
            cause="the IMU covers a part of the recording only",
            evidence=f"it begins {late:+.1f} s after the TDOAs, and ends {early:+.1f} s before them",
            remedy="ros2 topic hz imu/data  # start both drivers first; look at power and load",
            value=max(late, early),
        )


OF_BOTH = (offset, other_clock, partly)
