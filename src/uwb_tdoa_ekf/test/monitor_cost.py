# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Memory, and time per slice of half a second, of the Monitor by number of anchors."""

import time
import tracemalloc

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_ekf.core.memory import USED
from uwb_tdoa_ekf.monitoring.anchor_watch import LENGTH
from uwb_tdoa_ekf.monitoring.monitor import Monitor
from uwb_tdoa_ekf.results import Odometry, Residuals

RATE = 400  # Hz, rate of TDOAs
# (installed anchors, anchors heard at a time)
CASES = ((8, 8), (100, 30), (100, 100), (1000, 30), (1000, 200))


def odometry_of(t, p, v=(1.0, 0.0, 0.0), gyro_bias=0.0):
    """Return Odometry at positions p (n, 3). `gyro_bias` is about z, (n,) or a scalar."""
    n = len(t)
    zeros = np.zeros((n, 3))
    bias = np.column_stack([np.zeros((n, 2)), np.broadcast_to(gyro_bias, n)])
    return Odometry(
        t,
        p,
        np.broadcast_to(v, (n, 3)),
        np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        zeros,
        bias,
        np.zeros((n, 9, 9)),
        np.zeros((n, 3, 3)),
    )


def residuals_of(t, a, b, innovation, verdict=USED):
    """Return Residuals of TDOAs between anchors with ids a and b."""
    one = np.ones(len(t))
    return Residuals(t, a, b, innovation, one, one, np.broadcast_to(verdict, len(t)))


def fly(monitor, anchors, heard, slices, first=0, seed=0):
    """Feed `slices` slices of a flight along a row of Anchors to a Monitor.

    The tag hears the nearest `heard` anchors.
    """
    rng, n = np.random.default_rng(seed), round(RATE * LENGTH)
    for k in range(first, first + slices):
        t = LENGTH * (k + (np.arange(n) + 0.5) / n)
        p = np.stack([2.0 * np.cos(0.6 * t) + 0.2 * t, 2.0 * np.sin(0.6 * t), np.sin(t)], axis=1)
        near = np.argsort(np.linalg.norm(anchors.positions - p[0], axis=1))[:heard]
        one_of = rng.permutation(n) % heard
        a, b = near[one_of], near[(one_of + 1 + rng.integers(heard - 1, size=n)) % heard]
        innovation = 0.1 * rng.standard_normal(n)
        monitor.add(odometry_of(t, p), residuals_of(t, anchors.ids[a], anchors.ids[b], innovation))
        monitor.update(t[-1])


def row_of(n):
    """Return n Anchors in a row. The length of the hall is proportional to n."""
    rng = np.random.default_rng(n)
    return Anchors.from_positions(
        np.column_stack([np.arange(n) * 0.5 - 4.0, rng.uniform(-6.0, 6.0, (n, 2))])
    )


def cost(n, heard, slices):
    """Return (largest memory in bytes, processor time of a slice in s) of a Monitor.

    Parameters
    ----------
    n, heard : int
        Number of anchors, and of anchors heard at a time.
    slices : int
        Number of slices before the time is measured.
    """
    anchors = row_of(n)
    tracemalloc.start()
    monitor = Monitor(anchors)
    fly(monitor, anchors, heard, slices)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    took = []
    for k in range(8):
        begin = time.process_time()
        fly(monitor, anchors, heard, 1, slices + k)
        took.append(time.process_time() - begin)
    return peak, float(np.median(took))
