"""What is wrong with the numbers of a flight whose ground truth is known: of single pairs, of the axes of the IMU, of the truth itself.

A rule takes a Flight and yields Findings. What holds for whole streams is in `uwb_tdoa_ekf.streams`; here the geometry says what a pair should
have measured.
"""

from itertools import combinations, permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import true_samples
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_ekf.streams import ERROR, WARNING, Finding

FEWEST = 40  # TDOAs of a pair
AIRBORNE = 0.3  # m
CONTRARY = 0.4  # of the median error that is left with the other sign, or with the ids exchanged
MOVED = 0.3  # m by which what a pair should measure varies, at least, for its sign to be told
FROZEN = 8  # TDOAs of a pair with one value
ON_GRID, GRIDS = 0.95, (1.0, 0.5, 0.25, 0.2, 0.1, 0.05)  # share of a pair's TDOAs that are multiples; m
AT_END = 0.04  # share of a pair's TDOAs at its largest or smallest value
BETWEEN = 0.2  # share of a pair's TDOAs that are the mean of their neighbours; healthy 0.02
PACKETS, LATER = 3, 0.6  # packets by which a pair may be late, and one more; of the mean square error, left then; healthy 0.74
AXES = 0.6  # of the mean square error that is left with the axes otherwise
HOLE, LEAP, LEAST_LEAP = 1.0, 20.0, 0.2  # s without ground truth in the air; m/s, and m, between two poses; healthy 0.11
RATES = 0.25  # s over which turning rates are compared


def against_truth(flight):
    """[Finding] of a Flight; none without ground truth."""
    if flight.truth is None or len(flight.truth) < 2:
        return []
    return [finding for rule in RULES for finding in rule(flight)]


class _Pairs:
    """The TDOAs of each pair in the air: {(a, b): rows}; d, true (n,) m; t (n,) s; samples."""

    def __init__(self, flight):
        samples, rows = true_samples(flight)
        flown = np.flatnonzero(samples.p[:, 2] > AIRBORNE)
        self.samples, self.t, self.d = samples, samples.t, flight.tdoa.d[rows]
        self.true = tdoa(samples.p, samples.position_a, samples.position_b)
        self.ids = samples.anchors.ids
        key = samples.a[flown] * len(self.ids) + samples.b[flown]
        order = np.argsort(key, kind="stable")
        parts = np.split(flown[order], np.flatnonzero(np.diff(key[order])) + 1)
        self.rows = {
            (int(self.ids[samples.a[part[0]]]), int(self.ids[samples.b[part[0]]])): part for part in parts if len(part) >= FEWEST
        }


def pairs(flight):
    """Single pairs with the other sign, frozen, rounded, clipped, interpolated or late by packets."""
    of = _Pairs(flight)
    for pair, rows in of.rows.items():
        d, true, name = of.d[rows], of.true[rows], f"({pair[0]}, {pair[1]})"
        for rule in (_sign, _rounded, _clipped, _frozen, _between, _late):
            found = rule(d, true, of.t[rows] - flight.tdoa.t[0])
            if found is not None:
                yield Finding(f"pair_{rule.__name__[1:]}", ERROR, f"the TDOA of the pair {name} {found[0]}", found[1], found[2], found[3])
                break


def _sign(d, true, t):
    same, other = (float(np.median(np.abs(sign * d - true))) for sign in (1.0, -1.0))
    if np.std(true) > MOVED and other < CONTRARY * same:
        return "has the wrong sign", f"median error {same:.2f} m, with the other sign {other:.2f} m", "distance_difference *= -1.0", other


def _frozen(d, true, t):
    edges = np.flatnonzero(np.concatenate([[True], np.diff(d) != 0.0, [True]]))
    k = int(np.argmax(np.diff(edges)))
    first, last = edges[k], edges[k + 1] - 1
    if last - first + 1 >= FROZEN and np.ptp(true[first : last + 1]) > 0.02:
        evidence = f"{last - first + 1} times {d[first]:.3f} m while it changes by {np.ptp(true[first : last + 1]):.2f} m"
        return f"stands still from {t[first]:.1f} to {t[last]:.1f} s", evidence, "publish a TDOA when there is a new one", t[first]


def _rounded(d, true, t):
    for grid in GRIDS:
        share = float(np.mean(np.abs(d / grid - np.round(d / grid)) < 1e-4))
        if share > ON_GRID:
            return f"is rounded to {grid:g} m", f"{100 * share:.0f} % are multiples of it", "publish it as measured", grid


def _clipped(d, true, t):
    for end in (d.max(), d.min()):
        share = float(np.mean(d == end))
        if share > AT_END and np.sum(d == end) >= 5:
            return f"is clipped at {end:.2f} m", f"{100 * share:.0f} % have this value", "widen the limit of the driver", end


def _between(d, true, t):
    if np.mean(d[1:] == d[:-1]) > 0.1:
        return None
    share = float(np.mean(np.abs(d[1:-1] - 0.5 * (d[2:] + d[:-2])) < 1e-3 * max(np.median(np.abs(np.diff(d))), 1e-9)))
    if share > BETWEEN:
        return "is interpolated", f"{100 * share:.0f} % are the mean of their neighbours", "publish only what was measured", share


def _late(d, true, t):
    """Late, or early, by whole packets: the geometry of another packet fits better."""
    limit = 6.0 * 1.4826 * np.median(np.abs(d - true - np.median(d - true)))
    power = {}
    for shift in range(-PACKETS, PACKETS + 1):
        error = d[PACKETS:-PACKETS] - np.roll(true, shift)[PACKETS:-PACKETS]
        power[shift] = float(np.mean(np.clip(error - np.median(error), -limit, limit) ** 2))
    best = min(power, key=power.get)
    if 0 < abs(best) < PACKETS and power[best] < LATER * power[0]:
        word = "late" if best > 0 else "early"
        evidence = f"{100 * (1 - power[best] / power[0]):.0f} % less mean square error with the geometry of that packet"
        return f"is {abs(best)} of its packets {word}", evidence, "stamp a TDOA when it is taken", float(best)


def ids(flight):
    """Two anchors that are each called by the name of the other."""
    of = _Pairs(flight)
    samples, best = of.samples, None
    for one, two in combinations(range(len(of.ids)), 2):
        rows = np.flatnonzero((samples.p[:, 2] > AIRBORNE) & (np.isin(samples.a, (one, two)) | np.isin(samples.b, (one, two))))
        if len(rows) < FEWEST:
            continue
        table = np.arange(len(of.ids))
        table[[one, two]] = two, one
        places = samples.anchors.positions[table]
        before = float(np.median(np.abs(of.d[rows] - of.true[rows])))
        after = float(np.median(np.abs(of.d[rows] - tdoa(samples.p[rows], places[samples.a[rows]], places[samples.b[rows]]))))
        if after < CONTRARY * before and (best is None or after / before < best[0]):
            best = after / before, before, after, int(of.ids[one]), int(of.ids[two])
    if best:
        _, before, after, one, two = best
        evidence = f"median error of their TDOAs {before:.2f} m, exchanged {after:.2f} m"
        yield Finding("ids_exchanged", ERROR, f"anchors {one} and {two} are exchanged", evidence, f"id = {{{one}: {two}, {two}: {one}}}.get(id, id)", after)


def axes(flight):
    """Axes of the gyroscope that are exchanged or mirrored against the turns of the truth."""
    imu, truth = flight.imu, flight.truth
    known = np.isfinite(truth.q).all(axis=1)
    if imu is None or known.sum() < FEWEST:
        return
    t = truth.t[known]
    edges = np.arange(max(t[0], imu.t[0]) + RATES, min(t[-1], imu.t[-1]) - RATES, RATES)
    if len(edges) < FEWEST:
        return
    turns = Rotation.from_quat(truth.q[known][np.clip(np.searchsorted(t, edges), 0, len(t) - 1)])
    true = (turns[:-1].inv() * turns[1:]).as_rotvec() / RATES
    place = np.searchsorted(imu.t, edges)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyro, axis=0)])
    measured = (total[place[1:]] - total[place[:-1]]) / np.maximum(np.diff(place), 1)[:, None]
    limit = 5.0 * np.median(np.abs(measured - true), axis=0) + 0.1

    def power(order, signs):
        return float(np.mean(np.clip(np.array(signs) * measured[:, order] - true, -limit, limit) ** 2))

    base = power([0, 1, 2], (1, 1, 1))
    best, order, signs = min((power(list(o), s), o, s) for o in permutations(range(3)) for s in product((1, -1), repeat=3))
    if best < AXES * base:
        words = ", ".join(f"{'xyz'[k]} is {'-' if s < 0 else ''}{'xyz'[o]}" for k, (o, s) in enumerate(zip(order, signs)) if (o, s) != (k, 1))
        evidence = f"{100 * (1 - best / base):.0f} % less mean square difference to the turns of the ground truth"
        yield Finding("gyro_axes", ERROR, f"axes of the gyroscope are exchanged or mirrored: {words} of what it reads", evidence, "put the driver right", best)


def truth(flight):
    """Holes and leaps of the ground truth in the air."""
    of = flight.truth
    up = np.flatnonzero(of.p[:, 2] > AIRBORNE)
    if len(up) < 2:
        return
    t, p = of.t[up[0] : up[-1] + 1], of.p[up[0] : up[-1] + 1]
    dt = np.diff(t)
    k = int(np.argmax(dt))
    if dt[k] > HOLE:
        evidence = f"{dt[k]:.1f} s without a pose from {t[k] - flight.tdoa.t[0]:.1f} s on"
        yield Finding("truth_hole", WARNING, "the ground truth has a hole", evidence, "judge on what lies before or after", float(dt[k]))
    step = np.linalg.norm(np.diff(p, axis=0), axis=1)
    speed = np.where(step > LEAST_LEAP, step / np.maximum(dt, 1e-3), 0.0)
    if (speed > LEAP).any():
        k = int(np.argmax(speed))
        evidence = f"{np.linalg.norm(p[k + 1] - p[k]):.2f} m in {dt[k]:.3f} s at {t[k] - flight.tdoa.t[0]:.1f} s"
        yield Finding("truth_leap", WARNING, "the ground truth leaps", evidence, "look for exchanged or hidden markers", float(speed[k]))


RULES = (pairs, ids, axes, truth)
