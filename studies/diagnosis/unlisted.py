# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Errors without an entry in the catalogue. They share no code with the covariates of the search.

Two simulated flights have the error and are diagnosed. A third one judges the correction.
"""

from dataclasses import replace
import time

from known_effects import clean_flight
import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis import diagnose

from . import blind

LATE = 0.3  # s, age of the stamps of an anchor
MOCAP = 1e-3, 2e-3  # m and rad, noise of the ground truth of "noisy truth"


def _late(flight, delays):
    """The Flight with delays {anchor: (n,) m} of arrivals."""
    d = flight.tdoa.d.copy()
    for anchor, delay in delays.items():
        d += delay * (1.0 * (flight.tdoa.b == anchor) - (flight.tdoa.a == anchor))
    return replace(flight, tdoa=replace(flight.tdoa, d=d))


def _range(flight, anchor, t):
    place = flight.anchors.positions[flight.anchors.ids.tolist().index(anchor)]
    p = np.stack([np.interp(t, flight.truth.t, column) for column in flight.truth.p.T], axis=1)
    return np.linalg.norm(p - place, axis=1)


def _old_stamps(flight, rng):
    t = flight.tdoa.t
    return _late(flight, {2: _range(flight, 2, t - LATE) - _range(flight, 2, t)})


def _heading(flight, rng):
    yaw = np.unwrap(Rotation.from_quat(flight.truth.q).as_euler("ZYX")[:, 0])
    return _late(flight, {4: 0.3 * np.sin(np.interp(flight.tdoa.t, flight.truth.t, yaw))})


def _gain(flight, rng):
    d, own = flight.tdoa.d, (flight.tdoa.a == 5) | (flight.tdoa.b == 5)
    return replace(flight, tdoa=replace(flight.tdoa, d=np.where(own, 1.09, 1.0) * d))


def _saturated(flight, rng):
    return replace(flight, tdoa=replace(flight.tdoa, d=3.0 * np.tanh(flight.tdoa.d / 3.0)))


def _pulses(flight, rng):
    late = 0.49 * ((flight.tdoa.t - flight.start + rng.uniform(0.0, 9.18)) % 9.18 < 2.9)
    return _late(flight, {1: late, 4: late})


def _switching(flight, rng):
    edges = np.cumsum(rng.exponential(2.5, 200))
    return _late(flight, {3: 0.5 * (np.searchsorted(edges, flight.tdoa.t - flight.start) % 2)})


def _noisy_truth(flight, rng):
    truth, (of_p, of_q) = flight.truth, MOCAP
    turned = Rotation.from_quat(truth.q) * Rotation.from_rotvec(rng.normal(0, of_q, truth.p.shape))
    p = truth.p + rng.normal(0, of_p, truth.p.shape)
    return replace(flight, truth=replace(truth, p=p, q=turned.as_quat()))


KINDS = {
    "stamps of an anchor 0.3 s old": _old_stamps,
    "an anchor late by the heading": _heading,
    "TDOAs of an anchor 9 % too large": _gain,
    "TDOAs saturate at 3 m": _saturated,
    "two anchors late in pulses of any phase": _pulses,
    "an anchor that switches at random": _switching,
    "none, ground truth with 1 mm of noise": _noisy_truth,
}


def run(case):
    """dict of a (kind, seed): 3D RMSE of the third flight, m, the promise, and what was found."""
    kind, seed = case
    rng = np.random.default_rng([seed, 77])
    clean = [
        replace(clean_flight(number), name=f"flight-{k}")
        for k, number in enumerate(rng.integers(1000, 100000, 3).tolist())
    ]
    *fitted, third = (KINDS[kind](flight, rng) for flight in clean)
    started = time.process_time()
    found = diagnose(fitted)
    return {
        "kind": kind,
        "seconds": time.process_time() - started,
        "promised": [side["pooled"]["rmse_3d"] for side in (found.before, found.after)],
        "clean": blind.rmse(clean[-1], EffectSet()),
        "before": blind.rmse(third, EffectSet()),
        "after": blind.rmse(third, found.effects),
        "inertial": sum(one.effect.channels[0] in ("gyro", "accel") for one in found.findings),
        "applied": [effect.label for effect in found.effects],
    }


def figures(results):
    """Figures of each kind: medians of errors, m, and of seconds; the worst error after / before."""
    out = {}
    for kind in KINDS:
        mine = [result for result in results if result["kind"] == kind]
        out[kind] = {
            name: round(float(np.median([result[name] for result in mine])), 3)
            for name in ("clean", "before", "after", "seconds")
        }
        out[kind]["worst"] = max(round(one["after"] / one["before"], 2) for one in mine)
        out[kind]["inertial findings"] = sum(one["inertial"] for one in mine)
    return out
