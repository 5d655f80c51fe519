# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small simulated flights for training."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_tools.simulation import SimulationConfig, simulate


def flight(seed=0, constellation="corners", **changes):
    """Return a Flight of 12 s in the air with calibrated anchors."""
    config = SimulationConfig(
        **{
            "seed": seed,
            "constellation": constellation,
            "duration": 12.0,
            "start_in_air": True,
            "imu_rate": 100.0,
            "yaw_angle": 0.5 * seed,
            "anchor_delay_std": 0.0,
            "multipath": False,
            **changes,
        }
    )
    return replace(simulate(config), name=f"{constellation}-{seed}")


def without_attitude(one):
    """Return the Flight as a CSV file holds it: no IMU, no attitude."""
    q = np.full_like(one.truth.q, np.nan)
    return replace(one, imu=None, truth=replace(one.truth, q=q), name=f"{one.name}-csv")
