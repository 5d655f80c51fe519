# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find streams that are late, drift or jump against the ground truth.

Each delay is tried, and the power of the remaining error is compared. Slow changes, as systematic
errors make them, are removed first: a mean for each pair, or axis, and block of time. Limits are
shares of the power that remains with a fault undone. The healthy values are the least of 37
measured recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uwb_tdoa_bias.common.geometry import tdoa, tdoa_jacobian
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding

from ..clock import numbered
from .pair_rules import MANY, KnownPath

LONGEST, STEP = 1.5, 0.05  # s, largest delay to both sides, and steps between the trials
DELAYS = np.arange(-LONGEST, LONGEST + 0.5 * STEP, STEP)
NONE = len(DELAYS) // 2  # place of the delay 0
BLOCK, FEWEST = 5.0, 5  # s, length of a block, and least samples of a series in it
TELLING = 30.0  # least samples, about, in such blocks for a judgement
MOST = 15000  # TDOAs that are used, evenly taken
LIMIT = 2.0  # robust standard deviations at which errors are clipped: obstacles make many


@dataclass(frozen=True)
class Delays:
    """Remaining power of series for each delay.

    Nothing is reported about series with fewer than TELLING samples.

    Attributes
    ----------
    power : (series, blocks, len(DELAYS)) array
        Sum of squares with each delay, in units of the variance of the series without delay.
    """

    power: np.ndarray

    def of_series(self, k: int) -> tuple[float, float]:
        """Compare a series with the best common delay.

        Returns
        -------
        ratio : float
            Power with the best delay of series k, over power with the best common delay.
        delay : float
            Difference of these delays, s. (1, 0) if the series has too few samples.
        """
        own, common = self.power[k].sum(axis=0), self._common
        if own[NONE] < TELLING:
            return 1.0, 0.0
        best = int(np.argmin(own))
        return float(own[best] / max(own[common], 1e-12)), float(DELAYS[best] - DELAYS[common])

    @cached_property
    def _common(self) -> int:
        """Return the place of the best common delay."""
        return int(np.argmin(self.power.sum(axis=(0, 1))))

    def constant(self) -> tuple[float, float]:
        """Return (ratio, s): power with the best common delay over power without delay, and that delay."""
        if not self._tells:
            return 1.0, 0.0
        total = self.power.sum(axis=(0, 1))
        return float(total[self._common] / total[NONE]), float(DELAYS[self._common])

    @property
    def _tells(self) -> bool:
        return bool(self.power[..., NONE].sum() >= TELLING)

    def exact(self) -> float:
        """Return the best common delay, s, interpolated by a parabola through the three best."""
        if not self._tells:
            return 0.0
        total = self.power.sum(axis=(0, 1))
        k = int(np.clip(self._common, 1, len(total) - 2))
        before, here, after = total[k - 1 : k + 2]
        bend = before - 2.0 * here + after
        shift = np.clip((before - after) / bend, -1.0, 1.0) if bend > 0.0 else 0.0
        return float(DELAYS[k] + 0.5 * STEP * shift)

    def drift(self) -> tuple[float, float]:
        """Return (ratio, s): power with a linear delay over power with a constant delay, and its change.

        The change is that from the first to the last block.
        """
        if not self._tells:
            return 1.0, 0.0
        of = self.power.sum(axis=0)
        blocks = np.arange(len(of))
        start, end = np.meshgrid(np.arange(of.shape[1]), np.arange(of.shape[1]), indexing="ij")
        share = blocks / max(len(of) - 1, 1)
        place = np.rint(start[..., None] + (end - start)[..., None] * share).astype(int)
        left = of[blocks, place].sum(axis=-1)
        best = np.unravel_index(np.argmin(left), left.shape)
        return float(left[best] / max(of.sum(axis=0).min(), 1e-12)), float(
            DELAYS[best[1]] - DELAYS[best[0]]
        )

    def jump(self) -> tuple[float, float, int]:
        """Return (ratio, s, block): power with a delay that jumps once over power with a constant delay.

        s is the size of the jump, and block the first one after it.
        """
        if not self._tells:
            return 1.0, 0.0, 0
        of = self.power.sum(axis=0)
        before = np.cumsum(of, axis=0)
        after = before[-1] - before
        left = before.min(axis=1) + after.min(axis=1)
        k = int(np.argmin(left))
        step = DELAYS[np.argmin(after[k])] - DELAYS[np.argmin(before[k])]
        return float(left[k] / max(before[-1].min(), 1e-12)), float(step), k + 1


def delays(
    series: np.ndarray,
    t: np.ndarray,
    error: Callable[[float], np.ndarray],
    count_of_series: int | None = None,
) -> Delays:
    """Return the Delays of samples of several series.

    Parameters
    ----------
    series : (n,) array of int
        Number of the series of each sample, from 0.
    t : (n,) array
        Stamps, s.
    error : callable
        error(delay) is the error of each sample, (n,).
    count_of_series : int or None
        Number of series, if the last may have no samples.
    """
    block = numbered(t, BLOCK)
    blocks = block.max() + 1
    group = series * blocks + block
    size = (count_of_series or series.max() + 1) * blocks
    count = np.bincount(group, minlength=size)
    counted = count[group] >= FEWEST
    power, scale = np.zeros((size, len(DELAYS))), None
    for k in np.roll(np.arange(len(DELAYS)), -NONE):  # as it is first
        left = error(DELAYS[k])
        left = left - (np.bincount(group, left, size) / np.maximum(count, 1))[group]
        scale = (
            _scatter(series, np.where(counted, left, np.nan))[series] if scale is None else scale
        )
        left = np.where(counted, np.clip(left / scale, -LIMIT, LIMIT), 0.0)
        power[:, k] = np.bincount(group, left**2, size)
    return Delays(power.reshape(-1, blocks, len(DELAYS)))


def _scatter(series: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the robust standard deviation of each series, without NaN; 1 for an empty series."""
    known = [np.abs(values[(series == k) & np.isfinite(values)]) for k in range(series.max() + 1)]
    return np.array([max(1.4826 * np.median(part), 1e-9) if len(part) else 1.0 for part in known])


def delays_of_tdoas(path: KnownPath) -> Delays | None:
    """Return the Delays of the pairs of a KnownPath, in their order; None without any."""
    parts = _looked_at(path)
    if not any(map(len, parts)):
        return None
    series = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    rows = np.concatenate(parts)
    t, samples = path.t[rows], path.samples
    a, b = samples.position_a[rows], samples.position_b[rows]
    return delays(
        series,
        t,
        lambda delay: path.d[rows] - tdoa(path.track.positions(t - delay), a, b),
        len(parts),
    )


def _looked_at(path: KnownPath) -> list[np.ndarray]:
    """Return about MOST rows of the pairs of a KnownPath, for each pair.

    In a room these are some of each block. In a hall, where a block has few pairs, these are all of
    some blocks.
    """
    every = max(1, sum(map(len, path.pairs.values())) // MOST)
    if len(path.ids) <= MANY:
        return [part[::every] for part in path.pairs.values()]
    chosen = ((path.t - path.start) / BLOCK).astype(int) % every == 0
    return [part[chosen[part]] for part in path.pairs.values()]


# healthy: a pair 0.557, all together 0.984, drifting 0.9953, jumping 0.993
LATE, OF_ALL, DRIFTS, JUMPS = 0.53, 0.965, 0.99, 0.985
LEAST = 0.1  # s that count
# s, and ratio of the mean square change of errors in quick to slow motion; healthy 0.09 and 1.85
SHUFFLED, MORE = 0.15, 2.2
STEP_LIMIT = 4.0  # robust standard deviations at which a change of the error is clipped
CLOCK = (
    "stamp with one clock, when it is measured; tdoa_time_offset and truth_time_offset take out "
    "what is constant"
)


def wrong_stamps(path: KnownPath) -> Iterator[Finding]:
    """Yield TDOAs that are late, for one pair or all, that drift or jump, or that are out of order."""
    of = delays_of_tdoas(path)
    if of is None:
        return
    ratio, delay = of.constant()
    found = list(drift_or_jump("tdoa", "TDOAs", of))
    if not found and ratio < OF_ALL and abs(delay) >= LEAST:
        found = [_late("tdoa_late", "the TDOAs are", ratio, delay)]
    if found:
        yield from found
        return
    for k, pair in enumerate(path.pairs):
        ratio, delay = of.of_series(k)
        if ratio < LATE and abs(delay) >= LEAST:
            yield _late(
                "pair_late", f"the TDOA of the pair ({pair[0]}, {pair[1]}) is", ratio, delay
            )
    yield from _reordered(path)


def _late(rule: str, who: str, ratio: float, delay: float) -> Finding:
    return Finding(
        rule,
        ERROR,
        cause=f"{who} {abs(delay):.2f} s {'late' if delay > 0.0 else 'early'}",
        evidence=f"{100 * (1 - ratio):.0f} % less mean square error with the geometry of that time",
        remedy="publish a TDOA when it is taken, stamped with that instant",
        value=delay,
    )


def drift_or_jump(stream: str, name: str, of: Delays) -> Iterator[Finding]:
    """Yield a drift or a jump of the stamps of a stream, "tdoa" or "imu", from its Delays."""
    (drift, by), (jump, step, _) = of.drift(), of.jump()
    jumps = jump < JUMPS and abs(step) >= LEAST
    # A jump has one more parameter, and needs a larger gain.
    if drift < DRIFTS and abs(by) >= LEAST and not (jumps and jump / JUMPS < drift / DRIFTS):
        yield Finding(
            f"{stream}_drift",
            ERROR,
            cause=f"the stamps of the {name} drift against the ground truth",
            evidence=(
                f"{by:+.2f} s over the flight; {100 * (1 - drift):.0f} % less mean square error "
                "then"
            ),
            remedy=CLOCK,
            value=by,
        )
    elif jumps:
        yield Finding(
            f"{stream}_jump",
            ERROR,
            cause=f"the stamps of the {name} jump against the ground truth",
            evidence=f"{step:+.2f} s; {100 * (1 - jump):.0f} % less mean square error then",
            remedy=CLOCK,
            value=step,
        )


def _reordered(path: KnownPath) -> Iterator[Finding]:
    """Yield a finding if TDOAs are out of order.

    Errors of successive TDOAs of a pair then differ by the motion of the tag between the two instants.
    """
    samples, error = path.samples, path.d - path.true
    change = np.sum(
        tdoa_jacobian(samples.p, samples.position_a, samples.position_b) * samples.velocity, axis=1
    )
    step = np.concatenate([np.diff(error[rows]) for rows in path.pairs.values()])
    speed = np.concatenate(
        [0.5 * np.abs(change[rows][1:] + change[rows][:-1]) for rows in path.pairs.values()]
    )
    limit = STEP_LIMIT * 1.4826 * np.median(np.abs(step))
    power = np.clip(step, -limit, limit) ** 2
    slow, quick = speed <= np.median(speed), speed >= np.quantile(speed, 0.9)
    ratio = np.mean(power[quick]) / np.mean(power[slow])
    growth = (np.mean(power[quick]) - np.mean(power[slow])) / (
        np.mean(speed[quick] ** 2) - np.mean(speed[slow] ** 2)
    )
    scatter = np.sqrt(max(growth, 0.0) / 2.0)
    if ratio > MORE and scatter > SHUFFLED:
        yield Finding(
            "tdoa_reordered",
            ERROR,
            cause="TDOAs are stamped out of their order",
            evidence=(
                f"{ratio:.1f} times the mean square difference of successive errors in quick "
                "motion: "
                f"{scatter:.2f} s out of place"
            ),
            remedy="stamp a TDOA when it is taken, not when it is passed on",
            value=scatter,
        )
