# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare the TDOAs of each pair with the geometry of the ground truth: values, signs, ids, stamps.

A rule takes a KnownPath and yields Findings. Limits are shares, or the part of an error that
remains. The healthy values in comments are the extremes over the pairs of 37 measured recordings.

Streams are late, drift or jump: each delay is tried, and the power of the remaining error is
compared. Slow changes, as systematic errors make them, are removed first: a mean for each pair, or
axis, and block of time. Limits are shares of the power that remains with a fault undone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.common.geometry import tdoa, tdoa_jacobian
from uwb_tdoa_bias.effects import EffectSet, LabelEffect, Track, true_samples
from uwb_tdoa_bias.effects.anchor import AnchorIds
from uwb_tdoa_bias.effects.pair import PairSign
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding
from uwb_tdoa_ekf.monitoring.judge import exchanged

from ..clock import numbered

Fault = tuple[str, str, str, float]  # fault of the pair, evidence, remedy, deciding number

AIRBORNE = 0.3  # m of z
MANY = 64  # anchors beyond which a tag hears a small part of them, as in a hall
FEWEST = 40  # least TDOAs of a pair in the air, or of a vehicle that never flies, to judge it


def least_height(truth: Truth) -> float:
    """Return the height above which measurements count, m.

    0.3, or minus infinity for a vehicle that never leaves the floor.
    """
    return AIRBORNE if (truth.p[:, 2] > AIRBORNE).any() else -np.inf


class KnownPath:
    """Usable TDOAs of a Flight beside their true values.

    Attributes
    ----------
    d, true : (n,) array
        TDOAs and their true values, m.
    t : (n,) array
        Stamps, s.
    samples : Samples
        State of the tag at each TDOA.
    ids : (N,) array
        Ids of the anchors.
    track : Track
        Ground truth.
    start : float
        Stamp of the first TDOA, s.
    flown : (k,) array of int
        Rows in the air, or all of a vehicle that never flies.
    pairs : dict
        {(a, b) ids: rows in the air} of pairs with at least FEWEST of them.
    """

    def __init__(self, flight: Flight) -> None:
        """Compare the TDOAs of a Flight with its ground truth."""
        self._flight = flight
        self.samples, rows = true_samples(flight)
        self.t, self.d = self.samples.t, flight.tdoa.d[rows]
        self.true = tdoa(self.samples.p, self.samples.position_a, self.samples.position_b)
        self.ids = self.samples.anchors.ids
        self.track = Track(flight.known_truth)
        self.start = flight.start
        self.flown = np.flatnonzero(self.samples.p[:, 2] > least_height(flight.known_truth))
        key = (self.samples.a * len(self.ids) + self.samples.b)[self.flown]
        order = np.argsort(key, kind="stable")
        parts = (
            np.split(self.flown[order], np.flatnonzero(np.diff(key[order])) + 1)
            if len(order)
            else []
        )
        self.pairs = {self._named(part[0]): part for part in parts if len(part) >= FEWEST}

    def without(self, *effects: LabelEffect) -> KnownPath:
        """Return the same without some LabelEffects."""
        return KnownPath(EffectSet(effects).correct_streams(self._flight))

    def _named(self, row: int) -> tuple[int, int]:
        return int(self.ids[self.samples.a[row]]), int(self.ids[self.samples.b[row]])


# Share of the median error with the other sign, or the ids exchanged; healthy 2.1 and 0.68 at least
CONTRARY = 0.4
MOVED = 0.3  # m, least standard deviation of the true TDOA that determines the sign
GRID, ON_GRID = 0.03, 1e-4  # m, least step of rounding (healthy 0.014 at most), and its tolerance
BETWEEN = 0.2  # share of TDOAs on the line between their neighbours; healthy 0.04
REPEATED = 0.2  # share of TDOAs that equal the previous one; healthy 0.06
FROZEN = 8  # equal TDOAs in a row; healthy 5
AT_END, HITS = 0.04, 5  # share of TDOAs at the largest or smallest value (healthy 0.03), and count
MOST = 0.5  # share of the pairs with the same fault, beyond which it is a fault of all
OFF = 3.0  # times the median error of most anchors: an anchor with more may have a wrong id
EXCHANGES = 4  # most pairs of anchors that are exchanged one after the other


def wrong_values(path: KnownPath) -> Iterator[Finding]:
    """Yield pairs with the other sign, rounded, interpolated, repeated, clipped or frozen TDOAs.

    A fault of most pairs is one finding.
    """
    found: dict[str, dict[tuple[int, int], Fault]] = {}
    for pair, rows in path.pairs.items():
        for rule in OF_PAIR:
            fault = rule(path.d[rows], path.true[rows], path.t[rows] - path.start)
            if fault is not None:
                found.setdefault(rule.__name__[1:], {})[pair] = fault
                break
    for name, of_pairs in found.items():
        if len(of_pairs) >= MOST * len(path.pairs):
            _, (what, evidence, remedy, value) = next(iter(of_pairs.items()))
            yield Finding(
                f"tdoa_{name}",
                ERROR,
                cause=f"the TDOAs of all pairs are wrong: each {what}",
                evidence=f"{len(of_pairs)} of {len(path.pairs)} pairs; of the first: {evidence}",
                remedy=remedy,
                value=value,
            )
            continue
        for pair, (what, evidence, remedy, value) in of_pairs.items():
            yield Finding(
                f"pair_{name}",
                ERROR,
                cause=f"the TDOA of the pair ({pair[0]}, {pair[1]}) {what}",
                evidence=evidence,
                remedy=remedy,
                value=value,
            )


def inverted_pairs(path: KnownPath) -> list[tuple[int, int]]:
    """Return [(a, b)] of the pairs with the wrong sign."""
    return [
        pair
        for pair, rows in path.pairs.items()
        if _sign(path.d[rows], path.true[rows], None) is not None
    ]


def _sign(d: np.ndarray, true: np.ndarray, t: np.ndarray | None) -> Fault | None:
    same, other = (float(np.median(np.abs(sign * d - true))) for sign in (1.0, -1.0))
    if np.std(true) > MOVED and other < CONTRARY * same:
        return (
            "has the wrong sign",
            f"median error {same:.2f} m, with the other sign {other:.2f} m",
            "distance_difference *= -1.0",
            other,
        )
    return None


def _rounded(d: np.ndarray, true: np.ndarray, t: np.ndarray) -> Fault | None:
    values = np.unique(d)
    if len(values) < 2 or len(values) > 0.5 * len(d):
        return None
    grid = float(np.diff(values).min())
    if grid > GRID and (np.abs(d / grid - np.round(d / grid)) < ON_GRID / grid).all():
        return (
            f"is rounded to {grid:.3g} m",
            f"{len(values)} values, all multiples of it",
            "publish it as measured",
            grid,
        )
    return None


def _interpolated(d: np.ndarray, true: np.ndarray, t: np.ndarray) -> Fault | None:
    """Test whether TDOAs lie on the line between their neighbours, over packets or over time."""
    step = np.median(np.abs(np.diff(d)))
    moving = (d[1:-1] != d[:-2]) | (d[2:] != d[1:-1])
    share = 0.0
    for place in (np.arange(len(d)), t):
        weight = (place[1:-1] - place[:-2]) / np.maximum(place[2:] - place[:-2], 1e-9)
        off = np.abs(d[1:-1] - (1.0 - weight) * d[:-2] - weight * d[2:])
        share = max(share, float(np.mean(moving & (off < 1e-3 * max(step, 1e-6)))))
    if share > BETWEEN:
        evidence = f"{100 * share:.0f} % are on the line between their neighbours"
        return "is interpolated", evidence, "publish only what was measured", share
    return None


def _repeated(d: np.ndarray, true: np.ndarray, t: np.ndarray) -> Fault | None:
    """Test for repeated TDOAs.

    The longest run may be a tag at rest, and the ends may be clipped: they do not count.
    """
    first, length = _runs(d)
    length = length[(d[first] > d.min()) & (d[first] < d.max())]
    if not len(length):
        return None
    share = float(
        (length.sum() - len(length) - (length.max() - 1)) / max(length.sum() - length.max(), 1)
    )
    if share > REPEATED:
        return (
            "is published more than once",
            f"{100 * share:.0f} % equal the one before",
            "publish a TDOA when there is a new one",
            share,
        )
    return None


def _clipped(d: np.ndarray, true: np.ndarray, t: np.ndarray) -> Fault | None:
    """Test for many TDOAs at one end.

    If they are consecutive, the geometry must be beyond that end, or the tag is at rest.
    """
    for end, outward in ((d.max(), 1.0), (d.min(), -1.0)):
        at = d == end
        together = np.sum(np.diff(np.flatnonzero(at)) > 1) == 0
        if (
            at.sum() > AT_END * len(d)
            and at.sum() >= HITS
            and not (together and np.median(outward * (true[at] - end)) < 0.0)
        ):
            evidence = f"{100 * at.mean():.0f} % have this value"
            return (
                f"is clipped at {end:.2f} m",
                evidence,
                "widen the limit of the driver",
                float(end),
            )
    return None


def _frozen(d: np.ndarray, true: np.ndarray, t: np.ndarray) -> Fault | None:
    first, length = _runs(d)
    k = int(np.argmax(length))
    rows = slice(first[k], first[k] + length[k])
    if length[k] >= FROZEN and np.ptp(true[rows]) > 0.02:
        evidence = (
            f"{length[k]} times {d[first[k]]:.3f} m while it changes by {np.ptp(true[rows]):.2f} m"
        )
        what = f"stands still from {t[rows][0]:.1f} to {t[rows][-1]:.1f} s"
        return what, evidence, "publish a TDOA when there is a new one", float(t[rows][0])
    return None


def _runs(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (first, length) of the runs of equal values, (k,) each."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(d) != 0.0, [True]]))
    return edges[:-1], np.diff(edges)


OF_PAIR = _sign, _rounded, _interpolated, _repeated, _clipped, _frozen


def exchanged_ids(path: KnownPath) -> Iterator[Finding]:
    """Yield anchors with exchanged ids."""
    table, before, after = find_exchanges(path)
    if table:
        evidence = f"median error of their TDOAs {before:.2f} m, exchanged {after:.2f} m"
        yield exchanged(table, evidence, after)


def find_exchanges(path: KnownPath) -> tuple[dict[int, int], float, float]:
    """Return exchanged ids and the median error of their TDOAs before and after the exchange.

    Returns
    -------
    table : dict
        {id as received: id of that anchor}.
    before, after : float
        Median errors, m.
    """
    rows = np.arange(len(path.ids))
    table: dict[int, int] = {}
    errors: tuple[float, ...] = (0.0, 0.0)
    doubtful: np.ndarray = rows
    if len(rows) > MANY:  # only anchors with a wrong id have large errors
        each = np.array([_median_errors(path, [row], rows)[0] for row in rows.tolist()])
        doubtful = np.flatnonzero(
            np.isfinite(each) & (each > OFF * np.median(each[np.isfinite(each)]))
        )
    for _ in range(EXCHANGES):
        best = None
        for one, two in combinations(doubtful.tolist(), 2):
            trial = rows.copy()
            trial[[one, two]] = trial[[two, one]]
            before, after = _median_errors(path, (one, two), rows, trial)
            if after < CONTRARY * before and (best is None or after / before < best[0]):
                best = after / before, trial
        if best is None:
            break
        rows = best[1]
        changed = np.flatnonzero(rows != np.arange(len(rows)))
        table = {int(path.ids[row]): int(path.ids[rows[row]]) for row in changed}
        errors = _median_errors(path, changed, np.arange(len(rows)), rows)
    before, after = errors
    return table, before, after


def _median_errors(
    path: KnownPath, anchors: Sequence[int] | np.ndarray, *tables: np.ndarray
) -> tuple[float, ...]:
    """Return the median |error| (m) in the air of the TDOAs with some anchors (rows).

    There is one value for each table of the rows of the anchors.
    """
    samples, flown = path.samples, path.flown
    a, b = samples.a[flown], samples.b[flown]
    named = np.zeros(len(path.ids), bool)
    named[list(anchors)] = True
    with_them = named[a] | named[b]
    if with_them.sum() < 40:
        return tuple(np.inf for _ in tables)
    a, b, d, p = a[with_them], b[with_them], path.d[flown][with_them], samples.p[flown][with_them]
    at = samples.anchors.positions
    return tuple(
        float(np.median(np.abs(d - tdoa(p, at[table[a]], at[table[b]])))) for table in tables
    )


SOURCE = "numbers"


def repairs(flight: Flight) -> tuple[LabelEffect, ...]:
    """Return the LabelEffects that undo wrong ids and signs of a Flight, in their order.

    () without ground truth or TDOAs.
    """
    if flight.truth is None or len(flight.truth) < 2 or not len(flight.tdoa):
        return ()
    return repairs_of(KnownPath(flight))


def repairs_of(path: KnownPath) -> tuple[LabelEffect, ...]:
    """Return the same for a KnownPath. If most signs are wrong, ids are not judged."""
    out: list[LabelEffect] = []
    signs = inverted_pairs(path)
    table = {} if len(signs) >= MOST * max(len(path.pairs), 1) else find_exchanges(path)[0]
    if table:
        out.append(AnchorIds({str(wrong): right for wrong, right in table.items()}, source=SOURCE))
        signs = inverted_pairs(path.without(out[0]))
    if signs:
        out.append(PairSign({f"{a}-{b}": -1.0 for a, b in signs}, source=SOURCE))
    return tuple(out)


LONGEST, STEP = 1.5, 0.05  # s, largest delay to both sides, and steps between the trials
DELAYS = np.arange(-LONGEST, LONGEST + 0.5 * STEP, STEP)
NONE = len(DELAYS) // 2  # place of the delay 0
BLOCK, FEWEST_OF_BLOCK = 5.0, 5  # s, length of a block, and least samples of a series in it
TELLING = 30.0  # least samples, about, in such blocks for a judgement
MOST_TDOAS = 15000  # TDOAs that are used, evenly taken
CLIPPED = 2.0  # robust standard deviations at which errors are clipped: obstacles make many


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
    counted = count[group] >= FEWEST_OF_BLOCK
    power, scale = np.zeros((size, len(DELAYS))), None
    for k in np.roll(np.arange(len(DELAYS)), -NONE):  # as it is first
        left = error(DELAYS[k])
        left = left - (np.bincount(group, left, size) / np.maximum(count, 1))[group]
        scale = (
            _scatter(series, np.where(counted, left, np.nan))[series] if scale is None else scale
        )
        left = np.where(counted, np.clip(left / scale, -CLIPPED, CLIPPED), 0.0)
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
    """Return about MOST_TDOAS rows of the pairs of a KnownPath, for each pair.

    In a room these are some of each block. In a hall, where a block has few pairs, these are all of
    some blocks.
    """
    every = max(1, sum(map(len, path.pairs.values())) // MOST_TDOAS)
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
