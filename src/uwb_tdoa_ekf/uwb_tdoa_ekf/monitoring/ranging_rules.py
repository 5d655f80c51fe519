# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check windows of a TDOA stream for wrong values.

A rule takes windows and yields Findings.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT, TICK

from .finding import ERROR, NOTE, WARNING, Finding, Limit
from .stamp_rules import median, share_of, total
from .windows import GRIDS, TdoaWindow

LARGE = 0.2  # share of TDOAs longer than the distance of their anchors; healthy 0.008 at most
OUTLIERS = 0.05  # the same, from which on many TDOAs count as outliers
DUPLICATES = 0.02  # share of TDOAs that come twice; healthy 0
# share of TDOAs that repeat the value of their pair, healthy 0.03; the same in one window, healthy
# 0.09, from which on the values stand still
REPEATS, FROZEN = (0.15, 0.95)
# share of TDOAs that jump by more than 0.5 m and back, healthy 0.04 at most; fewest of these
RETURNS, ENOUGH = 0.08, 100
# The same of pairs heard after 0.1 to 1 s, where these are more than SLOW times those heard
# sooner: at low rates. Healthy 0.016 at most; two tags with 14 TDOAs/s each 0.035 at least, but for
# one of 32 pairs of flights.
LATER_RETURNS, SLOW = 0.03, 1.75
EVEN = 0.6  # share of the pairs, heard in both orders, with equal signs; healthy 0.1
ON_GRID = 0.95  # share of TDOAs on a grid; healthy 0.005
# share and number of TDOAs of a window at its largest value; healthy 0.011, and 3
CLIPPED, HITS = (0.02, 4)
# m, median jump; share of jumps that differ from it by less than NEAR, in m; number of jumps
STEP, ALIKE, NEAR, FEWEST = (5.0, 0.6, 0.5, 10)
WRAPS = {
    f"2^{bits} ticks of a DW1000": 2.0**bits * TICK for bits in (8, 16, 24, 31, 32, 39, 40)
} | {f"2^{bits} ns": 2.0**bits * SPEED_OF_LIGHT / 1e9 for bits in (16, 31, 32)}
FEW = 4  # anchors: three differences of distances determine a position


def fixed_step(windows: list[TdoaWindow]) -> Iterator[Finding]:
    """Yield a Finding if jumps have one size, because a time stamp wraps or is truncated."""
    steps = np.concatenate([w.steps for w in windows])
    step = float(np.median(steps)) if len(steps) >= FEWEST else 0.0
    if step < STEP:
        return
    alike = float(np.mean(np.abs(steps - step) < NEAR))
    share = share_of(windows, "impossible", "known")
    if alike >= ALIKE and share >= 0.5 * OUTLIERS:
        wraps = [name for name, size in WRAPS.items() if abs(size - step) < max(NEAR, 1e-5 * size)]
        how = f"wraps at {wraps[0]}" if wraps else "wraps or loses its upper bits"
        yield Finding(
            "tdoa_wraps",
            WARNING,
            cause=f"TDOAs are off by a fixed step of {step:.8g} m: a time stamp {how}",
            evidence=(
                f"{100.0 * share:.0f} % of the TDOAs; {100.0 * alike:.0f} % of the leaps have this "
                "size"
            ),
            remedy=(
                "d = (d + step / 2) % step - step / 2  # step as above; or subtract the time "
                "stamps "
                "with all their bits, modulo their range"
            ),
            value=step,
        )


def share_beside_known(windows: list[TdoaWindow], field: str) -> float:
    """Return the share of unusable TDOAs of one kind among these and the known TDOAs, 0 to 1."""
    count = total(windows, field)
    return count / max(count + total(windows, "known"), 1)


def impossible(windows: list[TdoaWindow]) -> Iterator[Finding]:
    share = share_of(windows, "impossible", "known")
    size = median(w.size for w in windows)
    evidence = (
        f"{100.0 * share:.1f} % are longer than their anchors are apart, mean size {size:.3g}"
    )
    if share > LARGE:
        yield Finding(
            "tdoa_large",
            ERROR,
            cause="TDOAs are impossibly large: not in metres, or of another room",
            evidence=evidence,
            remedy=(
                "message.distance_difference = ...  # metres: seconds times 299792458, DW1000 "
                "ticks "
                "times 0.0046918"
            ),
            value=share,
        )
    elif share > OUTLIERS:
        yield Finding(
            "tdoa_outliers",
            WARNING,
            cause="many TDOAs are outliers",
            evidence=evidence,
            remedy=(
                "keep radio and anchors clear of metal; drop TDOAs that the radio marks as doubtful"
            ),
            value=share,
        )


def _twice(windows: list[TdoaWindow]) -> float:
    """Return the share of TDOAs that come twice; stamps that stand are another mistake."""
    return share_of(
        [w for w in windows if w.stamps.same < 0.9 * w.stamps.count], "duplicates", "known"
    )


def _even(windows: list[TdoaWindow]) -> float:
    """Return the share of pairs, heard in both orders, with equal signs; 0 for few of them."""
    return share_of(windows, "even", "opposed") if total(windows, "opposed") > 20 else 0.0


def _frozen(windows: list[TdoaWindow]) -> float:
    """Return the largest share of TDOAs of a window that repeat the value of their pair.

    TDOAs at the largest value are left out: clipped TDOAs repeat it.
    """
    others = ((w.repeated - w.hits, w.successive - w.hits) for w in windows)
    return max((same / count for same, count in others if count >= FEWEST), default=0.0)


SHARES = (
    Limit(
        "tdoa_of_one",
        ERROR,
        "TDOAs name one anchor twice",
        "{:.1f} %",
        "message.anchor_a, message.anchor_b = ...  # the two anchors of the difference",
        1e-3,
        lambda windows: share_beside_known(windows, "of_one"),
    ),
    Limit(
        "tdoa_invalid",
        WARNING,
        "TDOAs are not finite",
        "{:.1f} %",
        "do not publish what is not finite",
        1e-3,
        lambda windows: share_beside_known(windows, "invalid"),
    ),
    Limit(
        "tdoa_twice",
        ERROR,
        "TDOAs are published twice",
        "{:.0f} % come twice with stamp and value",
        "ros2 topic info --verbose uwb/tdoa  # one publisher only",
        DUPLICATES,
        _twice,
    ),
    Limit(
        "tdoa_repeated",
        WARNING,
        "TDOAs are sampled faster than they are measured",
        "{:.0f} % have the value that their pair had before",
        "publish a TDOA when there is a new one, not by a timer",
        REPEATS,
        lambda windows: share_of(windows, "repeated", "successive"),
    ),
    Limit(
        "tdoa_frozen",
        ERROR,
        "the values of TDOAs stand still",
        "{:.0f} % have the value that their pair had before",
        "publish a TDOA only when the radio has measured it; restart its driver",
        FROZEN,
        _frozen,
    ),
    Limit(
        "tdoa_one_sign",
        ERROR,
        "the sign of the TDOAs does not follow the order of the anchors",
        "{:.0f} % of the pairs that come as (a, b) and (b, a) have the same sign",
        "message.distance_difference = distance_b - distance_a  # for the anchors in this order",
        EVEN,
        _even,
    ),
)


def two_tags(windows: list[TdoaWindow]) -> Iterator[Finding]:
    """Yield a Finding if TDOAs of pairs jump from one tag to another and back, soon or later."""
    soon, later, successive = 0.0, 0.0, total(windows, "successive")
    if successive >= ENOUGH:
        soon = share_of(windows, "returns", "successive")
    if total(windows, "later") >= max(ENOUGH, SLOW * successive):
        later = share_of(windows, "later_returns", "later")
    if soon > RETURNS or later > LATER_RETURNS:
        yield Finding(
            "two_tags",
            ERROR,
            cause="two tags share uwb/tdoa",
            evidence=(
                f"{100.0 * soon:.0f} % leap by more than 0.5 m and back within 0.1 s, "
                f"{100.0 * later:.0f} % farther than a tag moves within 1 s"
            ),
            remedy=(
                "give each tag a namespace of its own: start its driver with --ros-args -r "
                "__ns:=/tag2"
            ),
            value=max(soon, later),
        )


def rounded(windows: list[TdoaWindow]) -> Iterator[Finding]:
    shares = np.median([w.grids for w in windows], axis=0)
    on = np.flatnonzero(shares > ON_GRID)
    if len(on) and total(windows, "known") >= 100:
        grid = float(GRIDS[on[0]])
        yield Finding(
            "tdoa_rounded",
            WARNING if grid >= 0.05 else NOTE,
            cause="TDOAs are rounded",
            evidence=f"{100.0 * shares[on[0]]:.0f} % are multiples of {grid:g} m",
            remedy="publish them as float64, as measured",
            value=grid,
        )


def clipped(windows: list[TdoaWindow]) -> Iterator[Finding]:
    window = max(windows, key=lambda window: window.hits)
    share = window.hits / max(window.known, 1)
    if share > CLIPPED and window.hits >= HITS and window.ceiling > 0.0:
        yield Finding(
            "tdoa_clipped",
            ERROR,
            cause="TDOAs are clipped",
            evidence=f"{100.0 * share:.0f} % are {window.ceiling:.3f} m or its negative",
            remedy="widen the limit of the driver",
            value=window.ceiling,
        )


def heard(windows: list[TdoaWindow]) -> Iterator[Finding]:
    """Yield a Finding if too few anchors are heard in a window."""
    count = median(np.count_nonzero(w.heard) for w in windows)
    if count < FEW:
        yield Finding(
            "few_anchors",
            ERROR,
            cause="too few anchors are heard for a position",
            evidence=f"{count:.0f} anchors in a second; four are needed, five or more are good",
            remedy="switch on more anchors, or bring the tag among them",
            value=count,
        )


RULES = (
    fixed_step,
    impossible,
    *SHARES,
    two_tags,
    rounded,
    clipped,
    heard,
)
