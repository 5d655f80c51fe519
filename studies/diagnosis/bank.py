# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The bank of simulated flights with known effects."""

from known_effects import AIDED, RANGED, SIZES, clean_flight, effect_of, names_found
import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.findings import usable
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import SimulationConfig

PAIRS = (
    ("anchor_delay", "tag_lever_arm"),
    ("anchor_delay", "gyro_bias"),
    ("pair_offset", "range_scale"),
    ("anchor_position", "tdoa_time_offset"),
    ("anchor_clock_drift", "accel_bias"),
    ("nlos", "anchor_delay"),
    ("received_power_bias", "anchor_delay"),
    ("truth_frame", "imu_misalignment"),
)


def diagnosed(case, aided=False):
    """dict of a case (kind, effects, seed): the effects put in, those found, and whether their
    parameters are right.

    It also has the errors of the filter on a second flight with the same effects: without
    correction, with the effects found, and with the true effects.
    """
    kind, effects, seed = case
    flight, other = _flown(effects, seed, aided)
    reference = GroundTruth()
    attribution = attribute([reference.prepare(flight)], reference)
    case = {"kind": kind, **_case(effects, seed, attribution)}
    for name, model in (
        ("before", EffectSet()),
        ("found_rmse", usable(attribution.effects)),
        ("told_rmse", EffectSet(tuple(effects))),
    ):
        case[name] = _rmse(other, model)
    return case


def _flown(effects, seed, aided=False):
    """Two Flights with effects, of a seed and of another."""
    rng, out = np.random.default_rng([seed, 77]), []
    for number in (seed, seed + 5000):
        flight = clean_flight(number, aided=aided)
        for effect in effects:
            flight = effect.inject(flight, rng)
        out.append(flight)
    return out


def _case(effects, seed, attribution):
    ambiguous = {
        other.effect
        for f in attribution.findings()
        for other in f.alternatives
        if other.gap is not None
    }
    return {
        "put_in": [effect.name for effect in effects],
        "seed": seed,
        "found": names_found(attribution),
        "ambiguous": sorted(ambiguous),
        "parameters_right": _right(effects, attribution),
    }


def _rmse(flight, effects):
    return evaluate(flight, effects=effects)[0].row()["rmse_3d"]


def _right(effects, attribution):
    """Whether every injected parameter was found within 10 % or 3 standard errors; limits of time
    and place are not judged.
    """
    found = {effect.name: effect for effect in attribution.effects}
    for effect in effects:
        other = found.get(effect.name)
        if other is None:
            return False
        for key, value in effect.values.items():
            if effect.name == "outlier_rate":
                # in addition to the nominal outliers
                value = value + (1.0 - value) * SimulationConfig.outlier_probability
            limits = (
                (".start", ".end", ".height")
                if effect.name == "floor_multipath"
                else (".start", ".end")
            )
            if key.endswith(limits):
                continue
            error = abs(other.values.get(key, 0.0) - value)
            if error > max(0.1 * abs(value), 3.0 * other.std.get(key, 0.0)):
                return False
    return True


def cases(seeds, aided=False):
    """[(kind, effects, seed)] of the whole bank: small, large, pair, clean. aided : of effects on
    height, pressure and velocity, for flights that have these.
    """
    out = []
    for name in (name for name in SIZES if name not in RANGED and (name in AIDED) == aided):
        out += [
            ("small" if not large else "large", (effect_of(name, large, s),), 100 + s)
            for large in (False, True)
            for s in range(seeds)
        ]
    out += [
        ("pair", (effect_of(a, True, s), effect_of(b, True, s + 1)), 200 + s)
        for a, b in (() if aided else PAIRS)
        for s in range(min(seeds, 2))
    ]
    out += [("clean", (), 300 + s) for s in range(8 * seeds)]
    return out


def figures(results):
    """{kind: figures} of the cases."""
    out = {}
    for kind in ("small", "large", "pair"):
        mine = [r for r in results if r["kind"] == kind]
        exact = [sorted(r["found"]) == sorted(r["put_in"]) for r in mine]
        among = [set(r["put_in"]) <= set(r["found"]) for r in mine]
        first = [
            r["found"][:1] == r["put_in"][:1]
            or (kind == "pair" and set(r["found"][:1]) <= set(r["put_in"]) and r["found"])
            for r in mine
        ]
        near = [r["found_rmse"] <= 1.1 * r["told_rmse"] + 0.002 for r in mine if "found_rmse" in r]
        out[kind] = {
            "cases": len(mine),
            "exactly": share(exact),
            "found": share(among),
            "first": share(bool(x) for x in first),
            "parameters_right": share(r["parameters_right"] for r in mine),
            "rmse_as_if_told": share(near),
        }
    clean = [r for r in results if r["kind"] == "clean"]
    out["clean"] = {"cases": len(clean), "false_alarms": share(bool(r["found"]) for r in clean)}
    return out


def share(values):
    """Mean of truth values, or of ratios; None of none."""
    values = list(values)
    return round(float(np.mean(values)), 3) if values else None
