# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated flights: a room with anchors, a path, an inertial sensor, and the TDOAs of a UWB tag.

from uwb_tdoa_tools.simulation import SimulationConfig, simulate
flight = simulate(SimulationConfig(trajectory="circle", protocol="tdoa3", seed=3))
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.flight import Flight, Truth

from . import sensors
from .config import NO_IMU_ERRORS, ImuErrors, SimulationConfig
from .vehicles import VEHICLES, Flyable

__all__ = ["NO_IMU_ERRORS", "ImuErrors", "SimulationConfig", "simulate"]


def simulate(config: SimulationConfig, trajectory: Flyable | None = None) -> Flight:
    """Simulate a Flight with exact ground truth.

    Parameters
    ----------
    trajectory : vehicle to use instead of the config's, see Flyable.

    Returns
    -------
    Flight, with these additions.
    extra["tdoa_truth"] : t s, and bias, multipath, noise, outlier m: the errors of each TDOA.
    extra["state_truth"] : at the stamps of the truth. vx, vy, vz m/s, world frame; gyro_bias_x ...
    rad/s; accel_bias_x ... m/s^2.
    meta : source, format, protocol, config, and in "parameters" the constants of the errors.

    Raises InputError if the parts of the config contradict each other.
    """
    filled, room = config.complete()
    flown: Flyable = trajectory or VEHICLES[filled.vehicle](
        filled, room, filled.random("trajectory")
    )
    t_imu = np.arange(1, int(filled.duration * filled.imu_rate) + 1) / filled.imu_rate
    samples, gyro_bias, accel_bias = sensors.measure_imu(
        t_imu, flown, filled.imu_errors, filled.random
    )
    t_truth = np.arange(1, int(filled.duration * filled.truth_rate) + 1) / filled.truth_rate
    motion = flown.motion(t_truth)
    tdoa, tdoa_truth, parameters = sensors.measure_tdoas(filled, room, flown)

    newest = np.maximum(np.searchsorted(t_imu, t_truth + 1e-9) - 1, 0)
    state = {"t": t_truth}
    for name, values in (
        ("v", motion.v),
        ("gyro_bias_", gyro_bias[newest]),
        ("accel_bias_", accel_bias[newest]),
    ):
        state.update({name + axis: values[:, k] for k, axis in enumerate("xyz")})
    parameters |= {name: getattr(flown, name, None) for name in ("take_off", "landing")}
    kind = "" if config.vehicle == "quadrotor" else f"{config.vehicle}-"
    path = config.path or config.poses
    room_name = config.constellation if config.anchors is None else "anchors"
    return Flight(
        name=f"sim-{kind}{'path' if path else config.trajectory}-{config.protocol}-{room_name}-{config.seed}",
        anchors=filled.anchors,
        tdoa=tdoa,
        imu=samples,
        truth=Truth(t_truth, motion.p, motion.q),
        extra={"tdoa_truth": tdoa_truth, "state_truth": state},
        meta={
            "source": "simulation",
            "format": "simulation",
            "protocol": config.protocol,
            "config": filled.as_dict(),
            "parameters": parameters,
        },
    ).replaced(**sensors.measure_sensors(filled, room, flown))
