# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Arms whose encoders are the ground truth, in a frame of their own.

The tool moves between random poses and holds there. The base of the arm is turned and tilted, the
antenna has a lever arm, and each anchor a delay. Two recordings are diagnosed. A third one, whose
ground truth is in the frame of the survey, judges the correction in its holds.
"""

from dataclasses import replace
import time

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.scoring.metrics import position_at

DURATION, HOLD, MOVE = 60.0, 2.0, 2.0  # s
RATE, NOISE = 100.0, 0.1  # TDOAs/s, m
REACH = np.array([0.9, 0.9, 0.6])  # m about the middle of the workspace
IMU_RATE = 100.0  # Hz, of every other arm


def _path(rng):
    """Stamps, positions and attitudes of a tool, every 5 ms."""
    number = int(DURATION / (HOLD + MOVE)) + 2
    places = [0.3, -0.2, 1.2] + rng.uniform(-1.0, 1.0, (number, 3)) * REACH
    turns = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, (number, 3)) * [0.9, 0.9, 1.5])
    t = np.arange(-0.1, DURATION + 0.1, 5e-3)
    step, share = np.divmod(np.maximum(t, 0.0) / (HOLD + MOVE), 1.0)
    s = np.clip((share * (HOLD + MOVE) - HOLD) / MOVE, 0.0, 1.0)
    way = step + s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    p = np.stack([np.interp(way, np.arange(number), column) for column in places.T], axis=1)
    return t, p, Slerp(np.arange(number), turns)(way)


def _recording(name, rng, arm, imu):
    """A Flight with its ground truth in the frame of the survey."""
    t, p, q = _path(rng)
    antenna = make_interp_spline(t, p + q.apply(arm["lever"]), k=3)
    stamps = np.sort(rng.uniform(0.0, DURATION, int(RATE * DURATION)))
    a = rng.integers(0, 8, len(stamps))
    b = (a + rng.integers(1, 8, len(stamps))) % 8
    places = np.array([(x, y, z) for z in (0.2, 2.8) for x in (-4.0, 4.0) for y in (-4.0, 4.0)])
    arrival = np.linalg.norm(antenna(stamps)[:, None] - places, axis=2) + arm["delays"]
    rows = np.arange(len(stamps))
    d = arrival[rows, b] - arrival[rows, a] + NOISE * rng.normal(size=len(stamps))
    anchors = Anchors(np.arange(8), places, np.tile([0.0, 0.0, 0.0, 1.0], (8, 1)))
    return Flight(
        name, anchors, Tdoas(stamps, a, b, d), _imu(t, p, q, rng) if imu else None,
        Truth(t[::2], p[::2], q.as_quat()[::2]),
    )  # fmt: skip


def _imu(t, p, q, rng):
    rows = np.arange(0, len(t) - 1, round(200.0 / IMU_RATE))
    gyro = (q[rows].inv() * q[rows + 1]).as_rotvec() / 5e-3 + 0.005 * rng.normal(size=3)
    force = make_interp_spline(t, p, k=5)(t, 2)[rows] + [0.0, 0.0, 9.81]
    noise = np.sqrt(IMU_RATE) * rng.normal(size=(2, len(rows), 3))
    accel = q[rows].inv().apply(force) + 0.05 * rng.normal(size=3)
    return Imu(t[rows], gyro + 0.002 * noise[0], accel + 0.02 * noise[1])


def draw(seed):
    """(two Flights with the encoders' truth, a third one, the arm) of a seed.

    arm : turn, shift of the base in the survey, lever (m, tool), delays (8,) m
    """
    rng = np.random.default_rng([seed, 779])
    turn = Rotation.from_euler("ZYX", [rng.uniform(-180, 180), *rng.uniform(-4, 4, 2)], True)
    arm = {
        "turn": turn,
        "shift": rng.uniform(-1.0, 1.0, 3) * [1.5, 1.5, 0.5],
        "lever": rng.uniform(-0.15, 0.15, 3),
        "delays": rng.normal(0.0, 0.15, 8),
    }
    flights = [_recording(f"arm-{k}", rng, arm, seed % 2 == 0) for k in range(3)]
    out = []
    for flight in flights[:2]:
        truth, back = flight.truth, turn.inv()
        q = back * Rotation.from_quat(truth.q)
        moved = replace(truth, p=back.apply(truth.p - arm["shift"]), q=q.as_quat())
        out.append(replace(flight, truth=moved))
    return out, flights[2], arm


def _in_holds(flight, effects, config):
    """3D RMSE of the filter, m, in the later half of the holds, without the first 5 s."""
    found = run_offline(flight, config, Corrector(flight.anchors, effects)).odometry
    still = (found.t % (HOLD + MOVE) < HOLD) & (found.t % (HOLD + MOVE) > 0.5 * HOLD)
    still &= (found.t > 5.0) & (found.t < DURATION)
    away = found.p[still] - position_at(found.t[still], flight.truth)
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def run(seed):
    """dict of an arm: errors of frame (degrees, cm), lever (cm) and holds (cm)."""
    flights, third, arm = draw(seed)
    config = FilterConfig(use_imu=third.imu is not None)
    started = time.process_time()
    found = diagnose(flights, config=config)
    seconds = time.process_time() - started
    recorded, moved = flights[0].truth, found.flights[0].truth
    turn = Rotation.from_quat(moved.q[0]) * Rotation.from_quat(recorded.q[0]).inv()
    shift = moved.p.mean(axis=0) - (arm["turn"].apply(recorded.p) + arm["shift"]).mean(axis=0)
    by = {} if found.truth_transform is None else found.truth_transform.values
    lever = np.array([by.get(f"lever.{key}", 0.0) for key in "xyz"])
    delays = {str(k): float(v) for k, v in enumerate(arm["delays"])}
    told = EffectSet(
        (
            EFFECTS["tag_lever_arm"](dict(zip("xyz", arm["lever"].tolist()))),
            EFFECTS["anchor_delay"](delays),
        )
    )
    sides = {"none": EffectSet(), "diagnosed": found.effects, "told": told}
    out = {
        "seed": seed,
        "seconds": seconds,
        "degrees": float(np.rad2deg((turn * arm["turn"].inv()).magnitude())),
        "level": 100.0 * float(np.linalg.norm(shift[:2])),
        "height": 100.0 * float(abs(shift[2])),
        "undetermined": found.truth_transform.undetermined if found.truth_transform else None,
        "lever": 100.0 * float(np.linalg.norm(lever - arm["lever"])),
        "applied": [effect.label for effect in found.effects],
        "promised": [side["pooled"]["rmse_3d"] for side in (found.before, found.after)],
        **{name: 100.0 * _in_holds(third, effects, config) for name, effects in sides.items()},
    }
    return out


def figures(results):
    """Medians and largest errors over arms: degrees and cm."""
    keys = "degrees", "level", "height", "lever", *("none", "diagnosed", "told"), "seconds"
    return {
        key: {
            "median": round(float(np.median([one[key] for one in results])), 2),
            "largest": round(max(one[key] for one in results), 2),
        }
        for key in keys
    }
