"""Compare the TDOAs of each pair with the geometry of the ground truth: values, signs, ids.

A rule takes a KnownPath and yields Findings. Limits are shares, or the part of an error that
remains. The healthy values beside them are the extremes over the pairs of 37 measured recordings.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EffectSet, Track, true_samples
from uwb_tdoa_bias.effects.anchor_ids import AnchorIds
from uwb_tdoa_bias.effects.pair_sign import PairSign
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_ekf.streams import ERROR, Finding

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from uwb_tdoa_bias.effects import LabelEffect
    from uwb_tdoa_bias.foundation.flight import Flight, Truth

    Fault = tuple[
        str, str, str, float
    ]  # what the pair does, evidence, remedy, and the number that decided


AIRBORNE = 0.3  # m of z
# anchors, beyond which a tag hears a small part of them: a hall, most of which has nothing to do
# with any of them
MANY = 64
FEWEST = 40  # TDOAs of a pair in the air, or of a vehicle that never is, of which something is said


def least_height(truth: Truth) -> float:
    """z, m, above which what is measured beside a Truth counts: 0.3, or minus infinity for a
    vehicle that never leaves the floor.
    """
    return AIRBORNE if (truth.p[:, 2] > AIRBORNE).any() else -np.inf


class KnownPath:
    """d, true (n,) m, t (n,) s: the usable TDOAs and what they should be; samples : Samples; ids
    (N,); track : Track of the truth;
    start : s, stamp of the first TDOA; pairs {(a, b) ids: rows (k,)} of those in the air, of a
        vehicle that
    never is of all, that are often heard.
    """

    def __init__(self, flight: Flight) -> None:
        """flight : Flight with ground truth."""
        assert flight.truth is not None
        self._flight = flight
        self.samples, rows = true_samples(flight)
        self.t, self.d = self.samples.t, flight.tdoa.d[rows]
        self.true = tdoa(self.samples.p, self.samples.position_a, self.samples.position_b)
        self.ids, self.track, self.start = (
            self.samples.anchors.ids,
            Track(flight.truth),
            flight.start,
        )
        self.flown = np.flatnonzero(self.samples.p[:, 2] > least_height(flight.truth))
        key = (self.samples.a * len(self.ids) + self.samples.b)[self.flown]
        order = np.argsort(key, kind="stable")
        parts = (
            np.split(self.flown[order], np.flatnonzero(np.diff(key[order])) + 1)
            if len(order)
            else []
        )
        self.pairs = {self._named(part[0]): part for part in parts if len(part) >= FEWEST}

    def without(self, *effects: LabelEffect) -> KnownPath:
        """The same without some LabelEffects."""
        return KnownPath(EffectSet(effects).correct_streams(self._flight))

    def _named(self, row: int) -> tuple[int, int]:
        return int(self.ids[self.samples.a[row]]), int(self.ids[self.samples.b[row]])


pass


# Of the median error that is left with the other sign, or with the ids exchanged: healthy 2.1 and
# 0.68 at least.
CONTRARY = 0.4
MOVED = 0.3  # m by which what a pair should measure varies, at least, for its sign to be determined
GRID, ON_GRID = (
    0.03,
    1e-4,
)  # m: least step of what counts as rounded, healthy 0.014 at most, and how near to it values are
BETWEEN = 0.2  # share of TDOAs on the line between their neighbours; healthy 0.04
REPEATED, FROZEN = (
    0.2,
    8,
    # share of TDOAs that equal the one before, healthy 0.06; how many together with one value, healthy
    # 5
)
AT_END, HITS = (
    0.04,
    5,
)  # share of TDOAs at the largest or smallest value, healthy 0.03, and how many
MOST = 0.5  # share of the pairs with the same fault, from which on it is one of all
OFF = 3.0  # times the median error of most anchors, of one that may be exchanged with another
EXCHANGES = 4  # pairs of anchors that are exchanged one after the other


def values(path: KnownPath) -> Iterator[Finding]:
    """Pairs with the other sign, rounded, interpolated, repeated, clipped or frozen; all of them
    alike count as one finding.
    """
    found: dict[str, dict[tuple[int, int], Fault]] = {}
    for pair, rows in path.pairs.items():
        for rule in OF_PAIR:
            said = rule(path.d[rows], path.true[rows], path.t[rows] - path.start)
            if said is not None:
                found.setdefault(rule.__name__[1:], {})[pair] = said
                break
    for name, of_pairs in found.items():
        if len(of_pairs) >= MOST * len(path.pairs):
            _, (what, evidence, remedy, value) = next(iter(of_pairs.items()))
            evidence = f"{len(of_pairs)} of {len(path.pairs)} pairs; of the first: {evidence}"
            yield Finding(
                f"tdoa_{name}",
                ERROR,
                f"the TDOAs of all pairs are wrong: each {what}",
                evidence,
                remedy,
                value,
            )
            continue
        for pair, (what, evidence, remedy, value) in of_pairs.items():
            yield Finding(
                f"pair_{name}",
                ERROR,
                f"the TDOA of the pair ({pair[0]}, {pair[1]}) {what}",
                evidence,
                remedy,
                value,
            )


def contrary(path: KnownPath) -> list[tuple[int, int]]:
    """[(a, b)] of the pairs whose sign is the other one."""
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
    """On the line between its neighbours, over packets or over time."""
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
    """Beside the longest run, which may stand still, and the ends, which may be clipped."""
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
    """Many at one end; if they are all together, there where the geometry is beyond it, or it
    stands still.
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
    """(first, length) of the runs of equal values: (k,) each."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(d) != 0.0, [True]]))
    return edges[:-1], np.diff(edges)


OF_PAIR = _sign, _rounded, _interpolated, _repeated, _clipped, _frozen


def ids(path: KnownPath) -> Iterator[Finding]:
    """Anchors that are called by the names of others."""
    table, before, after = renamed(path)
    if table:
        names = ", ".join(f"{wrong} is {right}" for wrong, right in table.items())
        evidence = f"median error of their TDOAs {before:.2f} m, exchanged {after:.2f} m"
        line = (
            f"id = {{{', '.join(f'{wrong}: {right}' for wrong, right in table.items())}}}.get(id, "
            "id)"
        )
        yield Finding(
            "ids_exchanged",
            ERROR,
            f"the ids of anchors are exchanged: what is called {names}",
            evidence,
            line,
            after,
        )


def renamed(path: KnownPath) -> tuple[dict[int, int], float, float]:
    """({id as received: id of that anchor}, median error m of the TDOAs of these anchors as they
    are, and then).
    """
    rows = np.arange(len(path.ids))
    table: dict[int, int] = {}
    errors: tuple[float, ...] = (0.0, 0.0)
    doubtful: np.ndarray = rows
    if len(rows) > MANY:  # only what is called by another's name is far off
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
    """Median |error| m of the TDOAs in the air with some anchors (rows), under each table of the
    rows of the anchors.
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


pass
pass


SOURCE = "numbers"


def repairs(flight: Flight) -> tuple[LabelEffect, ...]:
    """(LabelEffect, ...) that undo wrong ids and signs of a Flight, in the order in which they are
    undone; () without ground truth or TDOAs.
    """
    return (
        ()
        if flight.truth is None or len(flight.truth) < 2 or not len(flight.tdoa)
        else repairs_of(KnownPath(flight))
    )


def repairs_of(path: KnownPath) -> tuple[LabelEffect, ...]:
    """The same of a KnownPath. Where most signs are wrong, nothing is said of ids."""
    out: list[LabelEffect] = []
    signs = contrary(path)
    table = {} if len(signs) >= MOST * max(len(path.pairs), 1) else renamed(path)[0]
    if table:
        out.append(AnchorIds({str(wrong): right for wrong, right in table.items()}, source=SOURCE))
        signs = contrary(path.without(out[0]))
    if signs:
        out.append(PairSign({f"{a}-{b}": -1.0 for a, b in signs}, source=SOURCE))
    return tuple(out)
