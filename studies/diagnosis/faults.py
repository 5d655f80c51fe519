# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Put random numerical faults into measured flights, and count how many are named."""

from number_faults import FAULTS
import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.checking.flight_rules import judge_flight

from . import measured
from .bank import share
from .blind import LEAST_COST, rmse

TRIES = 8  # draws of a fault, for each that is to be costly, after which it counts as harmless


def cases(data, number, first):
    """Yields a dict of each draw. Each fault is drawn until `number` draws count.

    A draw counts if it costs the filter LEAST_COST, or if it is a fault of the ground truth.
    data : Path of the measured flights; first : seed of the first draw
    """
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
    """{rule: [names of the flights]}: rules reported for the unchanged measured flights."""
    said = {}
    for path in _paths():
        flight = measured.load(data, [path])[0]
        for finding in judge_flight(flight):
            said.setdefault(finding.rule, []).append(flight.name)
    return said


def _paths():
    return list(
        dict.fromkeys(path for sides in measured.SPLITS.values() for side in sides for path in side)
    )


def draw(name, fault, flight, before, rng):
    """dict of a fault put into a flight.

    before : m, 3D RMSE of the filter without it. "cost" is the increase in m, None for a fault of
    the ground truth.
    """
    faulty = fault.put_in(flight, rng)
    found = [finding.rule for finding in judge_flight(faulty)]
    cost = None if fault.judge_truth else rmse(faulty, EffectSet()) - before
    return {
        "fault": name,
        "flight": flight.name,
        "said": found,
        "named": bool(set(found) & set(fault.rules)),
        "cost": cost,
    }


def counts(result):
    """Whether a draw costs enough to count."""
    return result["cost"] is None or result["cost"] >= LEAST_COST


def figures(results):
    """Figures of all draws, and of the draws that count."""
    costly = [r for r in results if counts(r)]
    return {
        "draws": len(results),
        "named": share(r["named"] for r in results),
        "that cost 2 cm, or are of the truth": len(costly),
        "of these named": share(r["named"] for r in costly),
        "by fault": {
            name: _of_fault([r for r in results if r["fault"] == name]) for name in FAULTS
        },
    }


def _of_fault(results):
    costly = [r for r in results if counts(r)]
    words = (
        f"{sum(r['named'] for r in results)} of {len(results)}, costly "
        f"{sum(r['named'] for r in costly)} of {len(costly)}"
    )
    costs = sorted(r["cost"] for r in results if r["cost"] is not None)
    return words + (f", cost {100 * costs[0]:.1f} to {100 * costs[-1]:.1f} cm" if costs else "")
