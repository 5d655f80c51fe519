# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare the TDOAs of each pair with the geometry of the ground truth: values, signs, ids.

A rule takes a KnownPath and yields Findings. Limits are shares, or the part of an error that
remains. The healthy values in comments are the extremes over the pairs of 37 measured recordings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import EffectSet, LabelEffect, Track, true_samples
from uwb_tdoa_bias.effects.anchor import AnchorIds
from uwb_tdoa_bias.effects.pair import PairSign
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding
from uwb_tdoa_ekf.monitoring.judge import exchanged

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
