"""All faults, and their draws."""

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.effects import EffectSet

from ....checking.numbers import numbers
from .. import measured
from ..bank import share
from ..blind import LEAST_COST, rmse
from . import inertial, labels, stamps, truth, values

TRIES = 8  # draws of a fault, for each that is to be costly, after which it counts as harmless


@dataclass(frozen=True)
class Fault:
    """put_in(flight, rng) -> Flight; rules : that name it; inertial : needs a flight with inertial samples; of_truth : spoils the
    ground truth, not the estimate."""

    put_in: object
    rules: tuple
    inertial: bool = False
    of_truth: bool = False


def _all_faults():
    of_values = {
        "repeated": values.REPEATED, "rounded": values.ROUNDED, "clipped": values.CLIPPED, "frozen": values.FROZEN,
        "late": values.LATE, "interpolated": values.INTERPOLATED,
    }  # fmt: skip
    for name, change in of_values.items():
        yield f"pair_{name}", Fault(values.of_pairs(change, False), (f"pair_{name}",))
        yield f"tdoa_{name}", Fault(values.of_pairs(change, True), (f"tdoa_{name}",))
    yield "ids_exchanged", Fault(labels.ids, ("ids_exchanged",))
    yield "pair_sign", Fault(labels.sign(False), ("pair_sign",))
    yield "tdoa_sign", Fault(labels.sign(True), ("tdoa_sign",))
    yield "tdoa_twice", Fault(labels.twice, ("tdoa_twice",))
    yield "tdoa_reordered", Fault(labels.reordered, ("tdoa_reordered",))
    yield "anchor_missing", Fault(labels.missing, ("anchor_missing", "anchor_silent", "anchor_rare"))
    yield "tdoa_lost", Fault(labels.lost, ("gap",))
    for stream in ("tdoa", "imu"):
        yield f"{stream}_quantised", Fault(stamps.of_stream(stream, stamps.quantised), ("stamps_coarse", "stamps_stand"), stream == "imu")
        yield f"{stream}_drift", Fault(stamps.of_stream(stream, stamps.drifting), (f"{stream}_drift",), stream == "imu")
        yield f"{stream}_jump", Fault(stamps.of_stream(stream, stamps.jumping), (f"{stream}_jump",), stream == "imu")
    yield "imu_repeated", Fault(inertial.repeated, ("imu_repeated",), True)
    for sensor in ("gyro", "accel"):
        yield f"{sensor}_axes", Fault(inertial.of_sensor(sensor, inertial.turned), (f"{sensor}_axes", "imu_turned"), True)
        yield f"{sensor}_clipped", Fault(inertial.of_sensor(sensor, inertial.saturated), ("imu_clipped",), True)
        yield f"{sensor}_filtered", Fault(inertial.of_sensor(sensor, inertial.filtered), ("imu_filtered",), True)
    yield "gyro_unit", Fault(inertial.of_sensor("gyro", inertial.in_degrees), ("imu_rate_unit",), True)
    yield "accel_unit", Fault(inertial.of_sensor("accel", inertial.in_g), ("imu_force_unit",), True)
    yield "truth_hole", Fault(truth.hole, ("truth_hole",), of_truth=True)
    yield "truth_leap", Fault(truth.leap, ("truth_leap",), of_truth=True)
    yield "truth_attitude", Fault(truth.attitude, ("truth_attitude",), True, True)


FAULTS = dict(_all_faults())


def cases(data, number, first):
    """Yields dict of each draw, of every fault until `number` of it cost the filter LEAST_COST, or spoil the truth. data : Path of
    the measured flights; first : seed of the first draw."""
    paths, known = _paths(), {}
    for place, (name, fault) in enumerate(FAULTS.items()):
        fit = [path for path in paths if path.startswith("flights") or not fault.inertial]
        costly = 0
        for seed in range(first, first + TRIES * number):
            rng = np.random.default_rng([seed, place])
            path = fit[rng.integers(len(fit))]
            if path not in known:
                flight = measured.load(data, [path])[0]
                known[path] = flight, rmse(flight, EffectSet())
            result = draw(name, fault, *known[path], rng)
            costly += counts(result)
            yield {**result, "seed": seed}
            if costly == number:
                break


def as_they_are(data):
    """{rule: [names of the flights]} of what is named in the measured flights without any fault put in."""
    said = {}
    for path in _paths():
        flight = measured.load(data, [path])[0]
        for finding in numbers(flight):
            said.setdefault(finding.rule, []).append(flight.name)
    return said


def _paths():
    return list(dict.fromkeys(path for sides in measured.SPLITS.values() for side in sides for path in side))


def draw(name, fault, flight, before, rng):
    """dict of a fault put into a flight. before : m, 3D RMSE of the filter without it; cost : m by which it grows, None where that
    says nothing."""
    faulty = fault.put_in(flight, rng)
    found = [finding.rule for finding in numbers(faulty)]
    cost = None if fault.of_truth else rmse(faulty, EffectSet()) - before
    return {"fault": name, "flight": flight.name, "said": found, "named": bool(set(found) & set(fault.rules)), "cost": cost}


def counts(result):
    """Whether a draw costs enough to count."""
    return result["cost"] is None or result["cost"] >= LEAST_COST


def figures(results):
    """Figures of the draws: of all, and of those that count."""
    costly = [r for r in results if counts(r)]
    return {
        "draws": len(results),
        "named": share(r["named"] for r in results),
        "that cost 2 cm, or are of the truth": len(costly),
        "of these named": share(r["named"] for r in costly),
        "by fault": {name: _of_fault([r for r in results if r["fault"] == name]) for name in FAULTS},
    }


def _of_fault(results):
    costly = [r for r in results if counts(r)]
    words = f"{sum(r['named'] for r in results)} of {len(results)}, costly {sum(r['named'] for r in costly)} of {len(costly)}"
    costs = sorted(r["cost"] for r in results if r["cost"] is not None)
    return words + (f", cost {100 * costs[0]:.1f} to {100 * costs[-1]:.1f} cm" if costs else "")
