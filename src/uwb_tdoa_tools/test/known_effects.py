# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated flights without effects, and effects of known size to inject into them.

Each effect has a small and a large size. Helpers return marks on the flown path and the effects
that a diagnosis finds.
"""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.common.sensors import BY_POSE, COMPARED, SENSORS
from uwb_tdoa_bias.effects import EFFECTS, Track
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.constraints import Mark
from uwb_tdoa_tools.diagnosis.deviations import with_deviations
from uwb_tdoa_tools.diagnosis.references import GroundTruth, Nothing
from uwb_tdoa_tools.scoring.metrics import scored_phase
from uwb_tdoa_tools.simulation import ImuErrors, SimulationConfig, simulate

ANCHORS_FOUND = "anchor_position", "anchor_delay"
PATHS = ("sines", "rising_circle", "square", "sines", "rising_circle")
# Without effects: white noise, outliers within the nominal 2 %, an IMU without bias.
CLEAN = {"bias": False, "multipath": False, "imu_errors": ImuErrors(gyro_bias=0.0, accel_bias=0.0)}

# {effect: (small, large)}: parameters; N is the number of an anchor, P a pair.
SIZES = {
    "anchor_delay": ({"N": 0.05}, {"N": 0.3}),
    "pair_offset": ({"P": 0.05}, {"P": 0.3}),
    "anchor_position": ({"N.x": 0.08}, {"N.x": 0.3, "N.y": -0.2, "N.z": 0.2}),
    "tag_lever_arm": ({"z": 0.05}, {"x": 0.1, "y": -0.1, "z": 0.2}),
    "tdoa_time_offset": ({"offset": 0.01}, {"offset": 0.05}),
    "truth_time_offset": ({"offset": 0.01}, {"offset": 0.05}),
    "truth_frame": (
        {"z": 0.04},
        {"x": 0.1, "y": 0.1, "z": 0.1, "roll": 0.02, "pitch": 0.02, "yaw": 0.05},
    ),
    "range_offset": ({"N": 0.05}, {"N": 0.3}),
    "range_delay": ({"offset": 0.02}, {"offset": 0.05}),
    "range_scale": ({"scale": 0.01}, {"scale": 0.05}),
    "range_bias": ({"quadratic": 0.002}, {"quadratic": 0.01}),
    "received_power_bias": ({"scale": 0.5}, {"scale": 2.0}),
    "antenna_pattern": ({"tag": 0.08}, {"tag": 0.3, "anchor": 0.3}),
    "anchor_clock_drift": ({"N": 0.0015}, {"N": 0.01}),
    "nlos": (
        {"N.delay": 0.15, "N.start": 20.0, "N.end": 32.0},
        {"N.delay": 0.6, "N.start": 20.0, "N.end": 32.0},
    ),
    "floor_multipath": (
        {"0.delay": 0.8, "2.delay": 0.8, "0.height": 0.15, "2.height": 0.15},
        {
            "0.delay": 3.3,
            "2.delay": 2.8,
            "5.delay": 3.6,
            "7.delay": 3.3,
            **{f"{i}.height": 0.15 for i in (0, 2, 5, 7)},
        },
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
        {"1.height": 0.1, "1.start": 20.0, "1.end": 32.0},
        {"1.height": 0.5, "1.start": 20.0, "1.end": 32.0},
    ),
    "barometer_drift": ({"rate": 0.01}, {"rate": 0.05}),
    "velocity_scale": ({"scale": 0.03}, {"scale": 0.15}),
    "yaw_rate_scale": ({"scale": 0.03}, {"scale": 0.15}),
    "velocity_misalignment": ({"yaw": 0.03}, {"yaw": 0.3}),
    "velocity_delay": ({"offset": 0.04}, {"offset": 0.15}),
    "velocity_slip": (
        {"1.share": 0.3, "1.start": 20.0, "1.end": 26.0},
        {"1.share": 1.0, "1.start": 20.0, "1.end": 26.0},
    ),
}
AIDED = tuple(
    name for name in SIZES if set(EFFECTS[name].channels) <= set(BY_POSE)
)  # effects on height, pressure, velocity, yaw rate
# effects on ranges only (docs/notebook/ranges.md)
RANGED = ("range_offset", "range_delay")
MARK_TIME, MARK_STD = 2.0, 0.05  # s, m
NOISES = {f"{name}_noise": 0.1 for name, sensor in SENSORS.items() if not sensor.locates}
NOISES |= {"height_noise": 0.01, "pressure_noise": 0.1, "velocity_noise": 0.05}
YAW_RATE_NOISE = 0.02  # rad/s
# Hz; fewer samples than a tag gives. Diagnoses take half of the time, and have less to find
# effects by.
SPARSE = {"tdoa_rate": 200.0, "imu_rate": 200.0, "truth_rate": 100.0}


def clean_flight(seed, duration=50.0, aided=False, ranged=False, rates=None):
    """Return a simulated flight without any effect.

    aided : with height, pressure, velocity and yaw rate
    ranged : with distances to anchors
    rates : {setting: Hz}, such as SPARSE
    """
    flight = simulate(
        SimulationConfig(
            seed=seed,
            duration=duration,
            trajectory=PATHS[seed % 5],
            yaw=("along_track", "rotating")[seed % 2],
            protocol=("tdoa2", "tdoa3")[seed // 2 % 2],
            **CLEAN,
            **(NOISES if aided else {}),
            **({"range_noise": 0.1} if ranged else {}),
            **(rates or {}),
        )
    )
    return with_yaw_rate(flight, YAW_RATE_NOISE, seed) if aided else flight


def sparse_flight(seed, duration=50.0, **sensors):
    """Return the flight of `clean_flight` with the rates of SPARSE."""
    return clean_flight(seed, duration, rates=SPARSE, **sensors)


def diagnosed():
    """Return the Diagnosis of a flight with a late and a displaced anchor, and a hold-out flight."""
    flights = [clean_flight(100, 24.0), clean_flight(101, 18.0)]
    for effect in (
        EFFECTS["anchor_delay"]({"3": 0.3}),
        EFFECTS["anchor_position"]({"6.x": 0.25, "6.z": -0.2}),
    ):
        flights = [effect.inject(flight) for flight in flights]
    return diagnose(flights[:1], flights[1:])


def late_flight():
    """Return a flight with a late anchor."""
    return EFFECTS["anchor_delay"]({"3": 0.4}).inject(sparse_flight(100, 40.0))


def diagnosed_without_truth():
    """Return the Diagnosis of `late_flight`, without ground truth."""
    return diagnose([late_flight()], reference=Nothing())


def with_yaw_rate(flight, noise, seed=0):
    """Return the Flight with yaw rates in its velocity stream.

    They are the true rates plus white noise. noise : rad/s
    """
    velocity = flight.velocity
    true = COMPARED["yaw_rate"].reading(Track(flight.truth), velocity.t)[:, 0]
    rate = true + noise * np.random.default_rng([seed, 35]).standard_normal(len(true))
    std = np.full(len(true), noise)
    return flight.replaced(velocity=replace(velocity, yaw_rate=rate, yaw_rate_std=std))


def effect_of(name, large, seed):
    """Return the effect at a size. The seed chooses the anchor or pair."""
    rng = np.random.default_rng([seed, len(name)])
    anchor = int(rng.integers(8))
    pair = f"{anchor}-{(anchor + 1) % 8}"  # measured in both protocols
    values = SIZES[name][int(large)]
    return EFFECTS[name](
        {key.replace("N", str(anchor)).replace("P", pair): value for key, value in values.items()}
    )


def marks_of(flight, count, rng):
    """Return [Mark] at ground-truth positions, evenly over the airborne part.

    Each lasts MARK_TIME, s, with errors of MARK_STD, m.
    """
    truth, (begin, end) = flight.truth, scored_phase(flight.truth)[1:]
    out = []
    for first in np.linspace(begin + MARK_TIME, end - 2.0 * MARK_TIME, count):
        inside = (truth.t >= first) & (truth.t <= first + MARK_TIME)
        place = truth.p[inside].mean(axis=0) + MARK_STD * rng.standard_normal(3)
        since = first - flight.tdoa.t[0]
        out.append(Mark(flight.name, since, since + MARK_TIME, tuple(place), MARK_STD))
    return out


def names_found(attribution):
    """Return the names of effects, the most certain first.

    Functions are named channel/covariate.
    """
    findings = attribution.findings()
    declared = sorted(
        (finding for finding in findings if finding.declared),
        key=lambda f: -f.evidence.get("held_out_gain", f.evidence.get("standard_errors", 0.0)),
    )
    unnamed = [finding.effect for finding in findings if not finding.declared]
    return [f.effect.name for f in declared] + [
        f"{effect.channel}/{effect.covariate}" for effect in unnamed
    ]


def normalised(flight, std, seed):
    """Return the normalized errors of the effects found in a Flight with displaced anchors.

    Anchors are displaced by random errors of std, m. The true shifts undo them. The true delays are
    0.

    Returns {effect: {fit: (errors (n,) m, errors over their deviations (n,))}}. The fits are "stated",
    with the values and deviations of the search, "alone", with the deviations of this fit alone, and
    "applied", with what would be applied.
    """
    off = std * np.random.default_rng(seed).standard_normal((len(flight.anchors), 3))
    shaken = replace(flight, anchors=flight.anchors.at(flight.anchors.positions + off))
    found = attribute([shaken], GroundTruth(), undeclared=False).selection
    true = {
        f"{i}.{axis}": -off[row, k]
        for row, i in enumerate(flight.anchors.ids)
        for k, axis in enumerate("xyz")
    }
    fits = {
        "stated": found.fit,
        "alone": found.only(found.chosen).fit,
        "applied": with_deviations(found.kept(found.chosen, share=1.0)).fit,
    }
    out = {}
    for kind in ANCHORS_FOUND:
        rows = [k for k, column in enumerate(found.fit.columns) if column.effect == (kind,)]
        shifts = np.array([true.get(found.fit.columns[k].key, 0.0) for k in rows])
        out[kind] = {}
        for name, fit in fits.items():
            error = fit.beta[rows] - shifts
            out[kind][name] = error, error / np.sqrt(np.diag(fit.cov))[rows]
    return out


def root(several):
    """Return the root mean square of all arrays together; NaN if there are none."""
    together = np.concatenate(several)
    return float(np.sqrt(np.mean(together**2))) if len(together) else np.nan
