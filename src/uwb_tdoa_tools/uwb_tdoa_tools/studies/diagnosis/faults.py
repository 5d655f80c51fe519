"""Faults of numbers, drawn and put into flights: are they named?"""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.flight import Truth

from ...checking.numbers import numbers
from . import measured
from .bank import share
from .blind import LEAST_COST, rmse


def _pair(flight, rng):
    """Rows of a pair that is often heard: (n,) int."""
    of = flight.tdoa
    heard, count = np.unique(np.column_stack([of.a, of.b]), axis=0, return_counts=True)
    a, b = heard[rng.choice(np.flatnonzero(count >= 0.8 * np.median(count)))]
    return np.flatnonzero((of.a == a) & (of.b == b))


def _of_pair(change):
    """A fault of the values of one pair: change(values, rng) -> values."""

    def fault(flight, rng):
        rows, d = _pair(flight, rng), flight.tdoa.d.copy()
        d[rows] = change(d[rows], rng)
        return replace(flight, tdoa=replace(flight.tdoa, d=d))

    return fault


def _stands(d, rng):
    first = int(rng.uniform(0.3, 0.5) * len(d))
    last = first + int(rng.uniform(0.15, 0.35) * len(d))
    return np.concatenate([d[:first], np.full(last - first, d[first]), d[last:]])


def _rounds(d, rng):
    grid = rng.choice([0.1, 0.2, 0.25, 0.5])
    return np.round(d / grid) * grid


def _clips(d, rng):
    limit = np.quantile(np.abs(d), rng.uniform(0.5, 0.8))
    return np.clip(d, -limit, limit)


def _interpolates(d, rng):
    out = d.copy()
    out[1:-1:2] = 0.5 * (d[:-2:2] + d[2::2])
    return out


def _exchanges(flight, rng):
    one, two = rng.choice(flight.anchors.ids, 2, replace=False)
    table = {one: two, two: one}
    a, b = (np.array([table.get(i, i) for i in ids.tolist()]) for ids in (flight.tdoa.a, flight.tdoa.b))
    return replace(flight, tdoa=replace(flight.tdoa, a=a, b=b))


def _turns_gyro(flight, rng):
    order, signs = np.arange(3), np.ones(3)
    while (order == np.arange(3)).all() and (signs == 1.0).all():
        order, signs = rng.permutation(3), rng.choice([-1.0, 1.0], 3)
    return replace(flight, imu=replace(flight.imu, gyro=flight.imu.gyro[:, order] * signs))


def _repeats_imu(flight, rng):
    rows = np.arange(len(flight.imu)) // 4 * 4
    return replace(flight, imu=replace(flight.imu, gyro=flight.imu.gyro[rows], accel=flight.imu.accel[rows]))


def _repeats_tdoa(flight, rng):
    twice = np.repeat(np.arange(len(flight.tdoa)), 2)
    of = flight.tdoa
    return replace(flight, tdoa=replace(of, t=of.t[twice], a=of.a[twice], b=of.b[twice], d=of.d[twice]))


def _middle(flight, rng):
    t = flight.truth.t[flight.truth.p[:, 2] > 0.5]
    return t[0] + rng.uniform(0.3, 0.6) * (t[-1] - t[0])


def _hides_truth(flight, rng):
    of, first = flight.truth, _middle(flight, rng)
    seen = (of.t < first) | (of.t > first + rng.uniform(2.0, 4.0))
    return replace(flight, truth=Truth(of.t[seen], of.p[seen], of.q[seen]))


def _moves_truth(flight, rng):
    of, first = flight.truth, _middle(flight, rng)
    moved = (of.t >= first) & (of.t < first + rng.uniform(1.0, 5.0))
    shift = rng.standard_normal(3)
    return replace(flight, truth=Truth(of.t, of.p + moved[:, None] * shift / np.linalg.norm(shift), of.q))


# {rule that names it: flight, rng -> flight}
FAULTS = {
    "pair_sign": _of_pair(lambda d, rng: -d),
    "pair_frozen": _of_pair(_stands),
    "pair_rounded": _of_pair(_rounds),
    "pair_clipped": _of_pair(_clips),
    "pair_between": _of_pair(_interpolates),
    "pair_late": _of_pair(lambda d, rng: np.roll(d, rng.integers(1, 3))),
    "ids_exchanged": _exchanges,
    "gyro_axes": _turns_gyro,
    "imu_repeated": _repeats_imu,
    "tdoa_twice": _repeats_tdoa,
    "truth_hole": _hides_truth,
    "truth_leap": _moves_truth,
}


def cases(number):
    """[(fault, path of a measured flight, seed)]."""
    paths = list(dict.fromkeys(path for sides in measured.SPLITS.values() for side in sides for path in side))
    out = []
    for seed in range(number):
        rng = np.random.default_rng([seed, 55])
        fault = list(FAULTS)[seed % len(FAULTS)]
        known = [path for path in paths if path.startswith("flights") or fault not in ("gyro_axes", "imu_repeated")]
        out.append((fault, known[rng.integers(len(known))], seed))
    return out


def run(data, fault, path, seed):
    """dict of one case. cost : m of the filter's 3D RMSE; None for a fault of the truth."""
    flight = measured.load(data, [path])[0]
    faulty = FAULTS[fault](flight, np.random.default_rng([seed, 66]))
    named = [finding.rule for finding in numbers(faulty)]
    of_truth = fault.startswith("truth")
    cost = None if of_truth else rmse(faulty, EffectSet()) - rmse(flight, EffectSet())
    return {"fault": fault, "flight": flight.name, "named": named, "cost": cost}


def figures(results):
    """Figures of the cases: of all, and of those that cost the filter something or spoil the truth."""
    costly = [r for r in results if r["cost"] is None or r["cost"] >= LEAST_COST]
    return {
        "cases": len(results),
        "named": share(r["fault"] in r["named"] for r in results),
        "that cost 2 cm, or are of the truth": len(costly),
        "of these named": share(r["fault"] in r["named"] for r in costly),
        "by fault": {
            fault: f"{sum(fault in r['named'] for r in results if r['fault'] == fault)} of "
            f"{sum(r['fault'] == fault for r in results)}, costly {sum(fault in r['named'] for r in costly if r['fault'] == fault)} "
            f"of {sum(r['fault'] == fault for r in costly)}"
            for fault in FAULTS
        },
    }
