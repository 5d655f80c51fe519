# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check windows of a TDOA stream for wrong values.

Each rule takes windows and returns a Finding or None.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT, TICK

from .finding import ERROR, NOTE, WARNING, Finding
from .ranging_windows import GRIDS
from .stamp_rules import median

if TYPE_CHECKING:
    from .ranging_windows import TdoaWindow

LARGE = 0.2  # share of TDOAs longer than the distance of their anchors; healthy 0.008 at most
OUTLIERS = 0.05  # the same, from which on many TDOAs count as outliers
DUPLICATES = 0.02  # share of TDOAs that come twice; healthy 0
REPEATS = 0.15  # share of TDOAs that repeat the value of their pair; healthy 0.026
RETURNS = 0.08  # share of TDOAs that jump by more than 0.5 m and back; healthy 0.04 at most
EVEN = 0.6  # share of the pairs, heard in both orders, with equal signs; healthy 0.1
ON_GRID = 0.95  # share of TDOAs on a grid; healthy 0.005
CLIPPED = 0.02  # share of TDOAs at the largest value
# m, median jump; share of jumps that differ from it by less than NEAR, in m; number of jumps
STEP, ALIKE, NEAR, FEWEST = (5.0, 0.6, 0.5, 10)
WRAPS = {
    f"2^{bits} ticks of a DW1000": 2.0**bits * TICK for bits in (8, 16, 24, 31, 32, 39, 40)
} | {f"2^{bits} ns": 2.0**bits * SPEED_OF_LIGHT / 1e9 for bits in (16, 31, 32)}
FEW = 4  # anchors: three differences of distances determine a position


def share_of(windows: list[TdoaWindow], field: str, among: str = "known") -> float:
    """Return the sum of one count over the windows divided by the sum of another."""
    return sum(getattr(w, field) for w in windows) / max(sum(getattr(w, among) for w in windows), 1)


def fixed_step(windows: list[TdoaWindow]) -> Finding | None:
    """Return a Finding if jumps have one size, because a time stamp wraps or is truncated."""
    steps = np.concatenate([w.steps for w in windows])
    step = float(np.median(steps)) if len(steps) >= FEWEST else 0.0
    if step < STEP:
        return None
    alike = float(np.mean(np.abs(steps - step) < NEAR))
    share = share_of(windows, "impossible")
    if alike < ALIKE or share < 0.5 * OUTLIERS:
        return None
    known = next(
        (name for name, size in WRAPS.items() if abs(size - step) < max(NEAR, 1e-5 * size)), None
    )
    cause = f"TDOAs are off by a fixed step of {step:.8g} m"
    cause += (
        f": a time stamp wraps at {known}"
        if known
        else ": a time stamp wraps or loses its upper bits"
    )
    evidence = (
        f"{100.0 * share:.0f} % of the TDOAs; {100.0 * alike:.0f} % of the leaps have this size"
    )
    remedy = (
        "d = (d + step / 2) % step - step / 2  # step as above; or subtract the time stamps with "
        "all their bits, modulo their range"
    )
    return Finding("tdoa_wraps", WARNING, cause, evidence, remedy, step)


def share_beside_known(windows: list[TdoaWindow], field: str) -> float:
    """Return the share of unusable TDOAs of one kind among these and the known TDOAs, 0 to 1."""
    count = sum(getattr(w, field) for w in windows)
    return count / max(count + sum(w.known for w in windows), 1)


def impossible(windows: list[TdoaWindow]) -> Finding | None:
    if fixed_step(windows):
        return None
    share = share_of(windows, "impossible")
    size = median(w.size for w in windows)
    evidence = (
        f"{100.0 * share:.1f} % are longer than their anchors are apart, mean size {size:.3g}"
    )
    if share > LARGE:
        remedy = (
            "message.distance_difference = ...  # metres: seconds times 299792458, DW1000 ticks "
            "times 0.0046918"
        )
        return Finding(
            "tdoa_large",
            ERROR,
            "TDOAs are impossibly large: not in metres, or of another room",
            evidence,
            remedy,
            share,
        )
    if share > OUTLIERS:
        remedy = (
            "keep radio and anchors clear of metal; drop TDOAs that the radio marks as doubtful"
        )
        return Finding("tdoa_outliers", WARNING, "many TDOAs are outliers", evidence, remedy, share)
    return None


def of_one(windows: list[TdoaWindow]) -> Finding | None:
    share = share_beside_known(windows, "of_one")
    if share > 1e-3:
        remedy = "message.anchor_a, message.anchor_b = ...  # the two anchors of the difference"
        return Finding(
            "tdoa_of_one",
            ERROR,
            "TDOAs name one anchor twice",
            f"{100.0 * share:.1f} %",
            remedy,
            share,
        )
    return None


def invalid(windows: list[TdoaWindow]) -> Finding | None:
    share = share_beside_known(windows, "invalid")
    if share > 1e-3:
        remedy = "do not publish what is not finite"
        return Finding(
            "tdoa_invalid", WARNING, "TDOAs are not finite", f"{100.0 * share:.1f} %", remedy, share
        )
    return None


def duplicates(windows: list[TdoaWindow]) -> Finding | None:
    share = share_of([w for w in windows if w.stamps.same < 0.9 * w.stamps.count], "duplicates")
    if share > DUPLICATES:
        evidence = f"{100.0 * share:.0f} % come twice with stamp and value"
        remedy = "ros2 topic info --verbose uwb/tdoa  # one publisher only"
        return Finding("tdoa_twice", ERROR, "TDOAs are published twice", evidence, remedy, share)
    return None


def repeated(windows: list[TdoaWindow]) -> Finding | None:
    share = share_of(windows, "repeated", "successive")
    if share > REPEATS and rounded(windows) is None and clipped(windows) is None:
        evidence = f"{100.0 * share:.0f} % have the value that their pair had before"
        remedy = "publish a TDOA when there is a new one, not by a timer"
        return Finding(
            "tdoa_repeated",
            WARNING,
            "TDOAs are sampled faster than they are measured",
            evidence,
            remedy,
            share,
        )
    return None


def two_tags(windows: list[TdoaWindow]) -> Finding | None:
    share = share_of(windows, "returns", "successive")
    if share > RETURNS and fixed_step(windows) is None:
        evidence = f"{100.0 * share:.0f} % leap by more than 0.5 m and back within 0.1 s"
        remedy = (
            "give each tag a namespace of its own: start its driver with --ros-args -r __ns:=/tag2"
        )
        return Finding("two_tags", ERROR, "two tags share uwb/tdoa", evidence, remedy, share)
    return None


def one_sign(windows: list[TdoaWindow]) -> Finding | None:
    share = share_of(windows, "even", "opposed")
    if share > EVEN and sum(w.opposed for w in windows) > 20:
        evidence = (
            f"{100.0 * share:.0f} % of the pairs that come as (a, b) and (b, a) have the same sign"
        )
        remedy = (
            "message.distance_difference = distance_b - distance_a  # for the anchors in this order"
        )
        return Finding(
            "tdoa_one_sign",
            ERROR,
            "the sign of the TDOAs does not follow the order of the anchors",
            evidence,
            remedy,
            share,
        )
    return None


def rounded(windows: list[TdoaWindow]) -> Finding | None:
    shares = np.median([w.grids for w in windows], axis=0)
    on = np.flatnonzero(shares > ON_GRID)
    if not len(on) or sum(w.known for w in windows) < 100:
        return None
    grid = float(GRIDS[on[0]])
    severity = WARNING if grid >= 0.05 else NOTE
    evidence = f"{100.0 * shares[on[0]]:.0f} % are multiples of {grid:g} m"
    return Finding(
        "tdoa_rounded",
        severity,
        "TDOAs are rounded",
        evidence,
        "publish them as float64, as measured",
        grid,
    )


def clipped(windows: list[TdoaWindow]) -> Finding | None:
    ceiling = max(w.ceiling for w in windows)
    hits = [w.hits for w in windows if w.ceiling == ceiling]
    share = sum(hits) / max(sum(w.known for w in windows), 1)
    repeats = sum(hits) > len(hits)  # the largest of few values is a large share of them
    if share > CLIPPED and repeats and rounded(windows) is None and ceiling > 0.0:
        evidence = f"{100.0 * share:.0f} % are {ceiling:.3f} m or its negative"
        return Finding(
            "tdoa_clipped",
            ERROR,
            "TDOAs are clipped",
            evidence,
            "widen the limit of the driver",
            ceiling,
        )
    return None


def heard(windows: list[TdoaWindow]) -> Finding | None:
    """Return a Finding if too few anchors are heard in a window."""
    count = median(np.count_nonzero(w.heard) for w in windows)
    if count < FEW:
        evidence = f"{count:.0f} anchors in a second; four are needed, five or more are good"
        remedy = "switch on more anchors, or bring the tag among them"
        return Finding(
            "few_anchors",
            ERROR,
            "too few anchors are heard for a position",
            evidence,
            remedy,
            count,
        )
    return None


RULES = (
    fixed_step,
    impossible,
    of_one,
    invalid,
    duplicates,
    repeated,
    two_tags,
    one_sign,
    rounded,
    clipped,
    heard,
)
