# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults in the values of inertial samples."""

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

GRAVITY = 9.81  # m/s^2


def of_sensor(sensor, change):
    """Return a fault of "gyro" or "accel": change(values (n, 3), rng, t) -> values."""

    def fault(flight, rng):
        return replace(
            flight,
            imu=replace(
                flight.imu, **{sensor: change(getattr(flight.imu, sensor), rng, flight.imu.t)}
            ),
        )

    return fault


def repeated(flight, rng):
    """Repeat each sample several times."""
    times = int(rng.integers(2, 16))
    rows = np.arange(len(flight.imu)) // times * times
    return replace(
        flight, imu=replace(flight.imu, gyro=flight.imu.gyro[rows], accel=flight.imu.accel[rows])
    )


def turned(values, rng, t):
    """Exchange or mirror axes."""
    order, signs = np.arange(3), np.ones(3)
    while (order == np.arange(3)).all() and (signs == 1.0).all():
        order, signs = rng.permutation(3), rng.choice([-1.0, 1.0], 3)
    return values[:, order] * signs


def in_degrees(values, rng, t):
    """Convert to degrees/s, or convert from degrees once too often."""
    return values * rng.choice([180.0 / np.pi, np.pi / 180.0])


def in_g(values, rng, t):
    """Convert to g, or to thousandths of g."""
    return values / GRAVITY * rng.choice([1.0, 1000.0])


def saturated(values, rng, t):
    """Clip all axes at one distance from their median."""
    middle = np.median(values, axis=0)
    limit = np.quantile(np.abs(values - middle), rng.uniform(0.3, 0.95))
    return np.clip(values, middle - limit, middle + limit)


def filtered(values, rng, t):
    """Apply a first-order low pass with a time constant of 50 ms to 1 s."""
    step, constant = np.median(np.diff(t)), np.exp(rng.uniform(np.log(0.05), np.log(1.0)))
    share = step / (step + constant)
    return lfilter([share], [1.0, share - 1.0], values - values[0], axis=0) + values[0]
