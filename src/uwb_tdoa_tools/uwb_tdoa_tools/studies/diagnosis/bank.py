"""The bank of simulated flights with known effects."""

import numpy as np
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_bias.foundation.flight import AIDS

from ...scoring.evaluation import evaluate
from ...simulation import ImuErrors, SimulationConfig, simulate
from ...diagnosis import diagnose
from ...diagnosis.attribution import attribute
from ...diagnosis.findings import usable
from ...diagnosis.references import GroundTruth, Nothing

PATHS = ("sines", "rising_circle", "square", "sines", "rising_circle")
# Without effects: white noise, outliers within the nominal 2 %, an inertial sensor without bias.
CLEAN = {"bias": False, "multipath": False, "imu_errors": ImuErrors(gyro_bias=0.0, accel_bias=0.0)}

# {effect: (small, large)}: parameters; N is the number of some anchor, P of some pair.
SIZES = {
    "anchor_delay": ({"N": 0.05}, {"N": 0.3}),
    "pair_offset": ({"P": 0.05}, {"P": 0.3}),
    "anchor_position": ({"N.x": 0.08}, {"N.x": 0.3, "N.y": -0.2, "N.z": 0.2}),
    "tag_lever_arm": ({"z": 0.05}, {"x": 0.1, "y": -0.1, "z": 0.2}),
    "tdoa_time_offset": ({"offset": 0.01}, {"offset": 0.05}),
    "truth_time_offset": ({"offset": 0.01}, {"offset": 0.05}),
    "truth_frame": ({"z": 0.04}, {"x": 0.1, "y": 0.1, "z": 0.1, "roll": 0.02, "pitch": 0.02, "yaw": 0.05}),
    "range_scale": ({"scale": 0.01}, {"scale": 0.05}),
    "range_bias": ({"quadratic": 0.002}, {"quadratic": 0.01}),
    "received_power_bias": ({"scale": 0.5}, {"scale": 2.0}),
    "antenna_pattern": ({"tag": 0.08}, {"tag": 0.3, "anchor": 0.3}),
    "anchor_clock_drift": ({"N": 0.0015}, {"N": 0.01}),
    "nlos": ({"N.delay": 0.15, "N.start": 20.0, "N.end": 32.0}, {"N.delay": 0.6, "N.start": 20.0, "N.end": 32.0}),
    "floor_multipath": (
        {"0.delay": 0.8, "2.delay": 0.8, "0.height": 0.15, "2.height": 0.15},
        {"0.delay": 3.3, "2.delay": 2.8, "5.delay": 3.6, "7.delay": 3.3, **{f"{i}.height": 0.15 for i in (0, 2, 5, 7)}},
    ),
    "gyro_bias": ({"z": 0.005}, {"x": 0.03, "y": -0.03, "z": 0.05}),
    "gyro_scale": ({"z": 0.03}, {"z": 0.1}),
    "accel_bias": ({"x": 0.08}, {"x": 0.3, "y": -0.3, "z": 0.2}),
    "accel_scale": ({"z": 0.01}, {"z": 0.05}),
    "imu_misalignment": ({"x": 0.01}, {"x": 0.05, "y": -0.05, "z": 0.05}),
    "imu_gravity": ({"excess": 0.06}, {"excess": 0.3}),
    "noise_level": ({"P": 0.1}, {"P": 0.3}),
    "noise_correlation": ({"std": 0.08, "time": 0.5}, {"std": 0.2, "time": 0.5}),
    "outlier_rate": ({"share": 0.05}, {"share": 0.15}),
    "height_offset": ({"offset": 0.02}, {"offset": 0.1}),
    "height_scale": ({"scale": 0.02}, {"scale": 0.1}),
    "floor_step": (
        {"1.height": 0.1, "1.start": 20.0, "1.end": 32.0}, {"1.height": 0.5, "1.start": 20.0, "1.end": 32.0},
    ),
    "barometer_drift": ({"rate": 0.01}, {"rate": 0.05}),
    "velocity_scale": ({"scale": 0.03}, {"scale": 0.15}),
    "velocity_misalignment": ({"yaw": 0.03}, {"yaw": 0.3}),
    "velocity_delay": ({"offset": 0.04}, {"offset": 0.15}),
    "velocity_slip": (
        {"1.share": 0.3, "1.start": 20.0, "1.end": 26.0}, {"1.share": 1.0, "1.start": 20.0, "1.end": 26.0},
    ),
}  # fmt: skip
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
# Without ground truth an error of the position explains these as well, or nothing else is measured on their channel.
INVISIBLE = (
    "tag_lever_arm",
    "tdoa_time_offset",
    "truth_time_offset",
    "truth_frame",
    "gyro_scale",
    "accel_bias",
    "accel_scale",
    "imu_misalignment",
    "imu_gravity",
)
WORSE = 1.03  # ratio of errors beyond which a case counts as made worse
AIDED = tuple(name for name in SIZES if set(EFFECTS[name].channels) <= set(AIDS))  # effects on height, pressure, velocity
NOISES = {"height_noise": 0.01, "pressure_noise": 0.1, "velocity_noise": 0.05}


def clean_flight(seed, duration=50.0, aided=False):
    """A simulated flight without any effect. aided : with height, pressure and velocity."""
    return simulate(
        SimulationConfig(
            seed=seed,
            duration=duration,
            trajectory=PATHS[seed % 5],
            yaw=("along_track", "rotating")[seed % 2],
            protocol=("tdoa2", "tdoa3")[seed // 2 % 2],
            **CLEAN,
            **(NOISES if aided else {}),
        )
    )


def effect_of(name, large, seed):
    """The effect at a size, on an anchor or pair that the seed chooses."""
    rng = np.random.default_rng([seed, len(name)])
    anchor = int(rng.integers(8))
    pair = f"{anchor}-{(anchor + 1) % 8}"  # is heard in both protocols
    values = SIZES[name][int(large)]
    return EFFECTS[name]({key.replace("N", str(anchor)).replace("P", pair): value for key, value in values.items()})


def names_found(attribution):
    """Names of effects, the most certain first, functions without a name as channel/covariate."""
    findings = attribution.findings()
    declared = sorted(
        (finding for finding in findings if finding.declared),
        key=lambda f: -f.evidence.get("held_out_gain", f.evidence.get("standard_errors", 0.0)),
    )
    unnamed = [finding.effect for finding in findings if not finding.declared]
    return [f.effect.name for f in declared] + [f"{effect.channel}/{effect.covariate}" for effect in unnamed]


def diagnose_case(effects, seed, aided=False):
    """dict of one case: what was put in, found, how near the parameters, and the errors of the filter on a second
    flight with the same effects: before, corrected as found, corrected as it is."""
    flight, other = _flown(effects, seed, aided)
    reference = GroundTruth()
    attribution = attribute([reference.prepare(flight)], reference)
    case = _case(effects, seed, attribution)
    for name, model in (("before", EffectSet()), ("found_rmse", usable(attribution.effects)), ("told_rmse", EffectSet(tuple(effects)))):
        case[name] = _rmse(other, model)
    return case


def case_without_truth(effects, seed):
    """dict of one case diagnosed without ground truth: what was put in, found, said to be unobservable, and applied; and the
    errors of the filter on a second flight with the same effects, before and after that."""
    flight, other = _flown(effects, seed)
    result = diagnose([flight], reference=Nothing())
    case = _case(effects, seed, result.attribution)
    case["unobservable"] = sorted({item.effect for item in result.unobservable})
    case["applied"] = [effect.name for effect in result.effects.effects]
    case["before"] = _rmse(other, EffectSet())
    case["after"] = _rmse(other, result.effects) if case["applied"] else case["before"]
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
    ambiguous = {other.effect for f in attribution.findings() for other in f.alternatives if other.gap is not None}
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
    """Whether every injected parameter was found within 10 % or 3 standard errors; limits of time and place are not
    judged."""
    found = {effect.name: effect for effect in attribution.effects}
    for effect in effects:
        other = found.get(effect.name)
        if other is None:
            return False
        for key, value in effect.values.items():
            if effect.name == "outlier_rate":
                value = value + (1.0 - value) * SimulationConfig.outlier_probability  # on top of what is nominal
            limits = (".start", ".end", ".height") if effect.name == "floor_multipath" else (".start", ".end")
            if key.endswith(limits):
                continue
            error = abs(other.values.get(key, 0.0) - value)
            if error > max(0.1 * abs(value), 3.0 * other.std.get(key, 0.0)):
                return False
    return True


def cases(seeds, aided=False, first=0):
    """[(kind, effects, seed)] of the whole bank: small, large, pair, clean. aided : of effects on height, pressure and
    velocity, for flights that have these; first : of the seeds."""
    out = []
    for name in (name for name in SIZES if (name in AIDED) == aided):
        out += [
            ("small" if not large else "large", (effect_of(name, large, s),), 100 + s)
            for large in (False, True)
            for s in range(first, first + seeds)
        ]
    out += [
        ("pair", (effect_of(a, True, s), effect_of(b, True, s + 1)), 200 + s)
        for a, b in (() if aided else PAIRS)
        for s in range(first, first + min(seeds, 2))
    ]
    out += [("clean", (), 300 + s) for s in range(8 * first, 8 * (first + seeds))]
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


def figures_without_truth(results):
    """Figures of several `case_without_truth`, with "kind"."""
    put_in = [r for r in results if r["put_in"]]
    seen, hidden = ([r for r in put_in if (r["put_in"][0] in INVISIBLE) is unseen] for unseen in (False, True))
    harmed = [r for r in results if r["after"] > WORSE * r["before"]]
    return {
        "observable": len(seen),
        "right first": share(r["found"][:1] == r["put_in"] for r in seen),
        "not observable": len(hidden),
        "named as such, and nothing found": share(r["put_in"][0] in r["unobservable"] and not r["found"] for r in hidden),
        "clean": len(results) - len(put_in),
        "false alarms": sum(bool(r["found"]) for r in results if not r["put_in"]),
        "applied": sum(bool(r["applied"]) for r in results),
        "after over before, where applied": share(r["after"] / r["before"] for r in results if r["applied"]),
        "worse by 3 % on another flight": [(r["put_in"], r["seed"], r["before"], r["after"]) for r in harmed],
    }


def share(values):
    """Mean of truth values, or of ratios; None of none."""
    values = list(values)
    return round(float(np.mean(values)), 3) if values else None
