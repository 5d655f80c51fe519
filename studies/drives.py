# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""drives: compare filter configurations with different sensors of a simulated rover on wheels."""

import numpy as np
from rovers import HEIGHT, Errors, drive, late

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline


def add_options(add):
    """The options of the study: none."""


def run(args):
    """Print a row for each way to use the sensors: root mean squares over drives that no test uses,
    and the largest step.
    """
    planar, bare = {"planar": True, "fixed_height": HEIGHT}, {"use_imu": False}
    matched = {"tdoa_std": 0.14, "gyro_noise": 0.001, "accel_noise": 0.02}
    rows = {
        "wheels, IMU, planar": (planar, (), False),
        "wheels, planar": (planar | bare, (), False),
        "wheels": (bare, (), False),
        "IMU, planar": (planar, ("velocity",), False),
        "TDOA alone, planar": (planar | bare, ("velocity",), False),
        "TDOA alone": (bare, ("velocity",), False),
        "two late anchors: wheels, IMU, planar": (planar, (), True),
        "two late anchors: wheels, planar": (planar | bare, (), True),
    }
    rows |= {
        f"{name}; noise as it is": (rows[name][0] | matched, *rows[name][1:])
        for name in list(rows)[:2]
    }
    flights = [drive(seed) for seed in range(100, 120)]
    print(
        "| | xy, m | largest, m | yaw, degrees | stated, degrees | NEES of xy, of height, of "
        "yaw | largest step, m |"
    )
    for name, (parameters, without, lies) in rows.items():
        found = []
        for seed, flight in enumerate(flights):
            rng = np.random.default_rng(seed)
            flight = (
                late(flight, rng.choice(6, 2, replace=False), rng.uniform(30.0, 50.0))
                if lies
                else flight
            )
            errors = Errors(
                flight,
                run_offline(flight.without(*without), FilterConfig(**parameters)).odometry,
                15.0,
            )
            nees = [np.mean(some) for some in (errors.nees_xy, errors.nees_z, errors.nees_yaw)]
            squares = np.mean(errors.xy**2), np.mean(errors.yaw**2), np.mean(errors.yaw_std**2)
            found.append([*squares, errors.xy.max(), errors.steps.max(), *nees])
        found = np.array(found)
        xy, yaw, stated = np.sqrt(found[:, :3].mean(axis=0)) * [1.0, 57.3, 57.3]
        of_xy, of_z, of_yaw = found[:, 5:].mean(axis=0)
        largest, step = found[:, 3:5].max(axis=0)
        numbers = (
            f"{xy:.3f} | {largest:.2f} | {yaw:.1f} | {stated:.1f} | {of_xy:.2f}, {of_z:.2f}, "
            f"{of_yaw:.2f} | {step:.2f}"
        )
        print(f"| {name} | {numbers} |", flush=True)
