# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the errors of tags in halls, and the cost of a tag by number of installed anchors.

In the measurement of cost, the tag always hears the same 20 anchors.
"""

from pathlib import Path
import tempfile
import time
import tracemalloc

from driving import drive, state_for
from flights import position_at
from halls import Hall, fly
import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_ekf.core.memory import STARTUP
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.monitoring.stream_rules import StreamWatch

SPACING = 8.0  # m
TURN = 0.005  # s of stamps that a node processes at once


def judge(flight, config):
    """Return the figures of one run.

    at_2 : error 2 s after the first TDOA, in m; inf without an estimate.
    rmse : in m, from 10 s on.
    nees : mean of the position; 3 for a consistent filter.
    start : time from the first TDOA to the first odometry, in s.
    spent, stamps : number of TDOAs, and of their stamps, until then.
    """
    state = state_for(flight)
    odometry, residuals = drive(flight, config, state)
    began = residuals.verdict != STARTUP
    spent = int(np.argmax(began)) if began.any() else len(began)
    stamps = len(np.unique(flight.tdoa.t[: spent + 1]))
    if not len(odometry):
        return {
            "at_2": np.inf,
            "rmse": np.inf,
            "nees": np.inf,
            "start": np.inf,
            "spent": spent,
            "stamps": stamps,
            "odometry": None,
        }
    error = odometry.x[:, :3] - position_at(flight, odometry.t)
    off, covariance = np.linalg.norm(error, axis=1), odometry.covariance[:, :3, :3]
    since = odometry.t - flight.tdoa.t[0]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    return {
        "at_2": off[np.searchsorted(since, 2.0)] if since[-1] > 2.0 and since[0] < 2.0 else np.inf,
        "rmse": float(np.sqrt(np.mean(off[since >= 10.0] ** 2)))
        if (since >= 10.0).any()
        else np.nan,
        "nees": float(nees.mean()),
        "start": float(since[0]),
        "spent": spent,
        "stamps": stamps,
        "odometry": odometry,
        "off": off,
        "std": np.sqrt(np.trace(covariance, axis1=1, axis2=2)),
    }


def heard_at_start(flight, seconds=0.5):
    """Return the number of anchors in the TDOAs of the first seconds."""
    first = flight.tdoa.t < flight.tdoa.t[0] + seconds
    return len(np.unique(np.concatenate([flight.tdoa.a[first], flight.tdoa.b[first]])))


def after_gaps(flight, found, within=1.0, gap=1.0):
    """Return the recovery time after each silence of more than `gap` s, in s.

    This is the last time that the error exceeds `within` m in the 10 s after the silence.
    """
    t, out = flight.tdoa.t, []
    for k in np.flatnonzero(np.diff(t) > gap):
        rows = (found["odometry"].t >= t[k + 1]) & (found["odometry"].t < t[k + 1] + 10.0)
        wrong = found["odometry"].t[rows & (found["off"] > within)]
        out.append(float(wrong.max() - t[k + 1]) if len(wrong) else 0.0)
    return out


def installation(n):
    """Return n Anchors. The first 20 are the same for every n.

    A tag among them hears none of the others.
    """
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(5) * SPACING, np.arange(4) * SPACING)
    near = np.column_stack([x.ravel(), y.ravel(), rng.uniform(0.5, 6.0, 20)])
    beyond = np.arange(n - 20)
    far = np.column_stack(
        [200.0 + SPACING * (beyond % 125), SPACING * (beyond // 125), np.full(len(beyond), 4.0)]
    )
    return Anchors.from_positions(np.concatenate([near, far]))


class Tag:
    """Both nodes of a tag, without ROS: correction, filter with its monitor, and stream watch."""

    def __init__(self, anchors):
        self.corrector, self.estimator, self.watch = (
            Corrector(anchors),
            Estimator(anchors),
            StreamWatch(anchors, 0.25),
        )

    def take(self, flight):
        """Process a Flight, turn by turn. Return the Odometry of each turn."""
        imu, d, out, next_look = flight.imu, flight.tdoa, [], 1.0
        edges = np.arange(0.0, d.t[-1] + TURN, TURN)
        of_imu, of_tdoa = np.searchsorted(imu.t, edges), np.searchsorted(d.t, edges)
        rows = flight.anchors.index
        for k, end in enumerate(edges[1:]):
            i, j = slice(of_imu[k], of_imu[k + 1]), slice(of_tdoa[k], of_tdoa[k + 1])
            self.estimator.add_imu(imu.t[i], imu.gyro[i], imu.accel[i])
            self.watch.add_imu(imu.t[i], imu.t[i], imu.gyro[i], imu.accel[i])
            if j.stop > j.start:
                corrected = self.corrector.correct(
                    d.t[j], rows(d.a[j]), rows(d.b[j]), d.d[j]
                ).corrected
                self.estimator.add_tdoa(d.t[j], d.a[j], d.b[j], corrected)
                self.watch.add_tdoa(d.t[j], d.t[j], d.a[j], d.b[j], d.d[j])
            out.append(self.estimator.advance()[0])
            if end >= next_look:
                next_look += 1.0
                self.watch.findings()
        return out


def flight_among(anchors, duration):
    """Return a Flight of a tag that walks among the first 20 Anchors and hears no others.

    It does not depend on the other anchors.
    """
    few = Hall(anchors.only(np.arange(20)), (4.0 * SPACING, 3.0 * SPACING), 100.0, np.zeros(20))
    return fly(few, 0, duration)


def cost(n, duration=30.0, repeat=3):
    """Return (share of a core, memory, start, Odometry of the last turn) among n installed anchors.

    The memory of a tag is in bytes. The start from a file is in s of processor time.
    """
    anchors, shares = installation(n), []
    with tempfile.TemporaryDirectory() as folder:
        anchors.to_yaml(path := Path(folder) / "anchors.yaml")
        began = time.process_time()
        Tag(read_survey(path))
        start = time.process_time() - began
    flight = flight_among(anchors, duration)
    for _ in range(repeat):
        tag = Tag(anchors)
        began = time.process_time()
        odometry = tag.take(flight)
        shares.append((time.process_time() - began) / duration)
    tracemalloc.start()
    tag = Tag(anchors)
    tag.take(flight_among(anchors, 5.0))
    memory = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return min(shares), memory, start, odometry[-1]
