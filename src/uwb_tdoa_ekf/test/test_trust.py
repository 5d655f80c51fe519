# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a fault or a recovery has spoiled is opened in the filter, and named until it is settled."""

from dataclasses import replace
import math

from flights import fly, position_at
import numpy as np
import pytest

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core.yaw_check import YAW_KNOWN
from uwb_tdoa_ekf.estimator import RECOVERY_NAMED, Estimator
from uwb_tdoa_ekf.results import rotation_std

STEP = 0.1  # s between two looks
BEGIN, END = 8.0, 12.0  # s, of a fault
QUIET = {"tdoa_std": 0.05, "accel_noise": 0.01, "gyro_noise": 0.001}


def looks(flight, at=()):
    """Yield (s, Estimator, newest Odometry) every STEP.

    at : (s, call) : call(estimator) is made at that time
    """
    estimator, calls = Estimator(flight.anchors), list(at)
    for t in np.arange(0.0, flight.imu.t[-1], STEP):
        imu, uwb = ((part.t >= t) & (part.t < t + STEP) for part in (flight.imu, flight.tdoa))
        while calls and calls[0][0] <= t:
            calls.pop(0)[1](estimator)
        estimator.add_imu(flight.imu.t[imu], flight.imu.gyro[imu], flight.imu.accel[imu])
        estimator.add_tdoa(*(getattr(flight.tdoa, name)[uwb] for name in ("t", "a", "b", "d")))
        odometry, _ = estimator.advance()
        if len(odometry):
            yield t + STEP, estimator, odometry


def yaw_std(odometry):
    return rotation_std(odometry.q, odometry.covariance)[-1, 2]


def elsewhere(flight, away):
    """Return the Flight whose TDOAs are those of a place that is `away` (3,) m, during the fault."""
    t, of = flight.tdoa.t, flight.anchors
    places = position_at(flight, t) + away
    a, b = (of.positions[of.index(ids)] for ids in (flight.tdoa.a, flight.tdoa.b))
    wrong = (t > BEGIN) & (t < END)
    return replace(
        flight, tdoa=replace(flight.tdoa, d=np.where(wrong, tdoa(places, a, b), flight.tdoa.d))
    )


def test_tdoas_that_contradict_and_a_recovery_are_named_and_open_the_yaw():
    flight, said, last = elsewhere(fly(0, 22.0, **QUIET), [3.0, -2.5, 0.0]), [], -math.inf
    count, unknown = 0, []
    for t, estimator, odometry in looks(flight):
        if t - STEP - 1e-3 < last < t:
            unknown.append(yaw_std(odometry) > YAW_KNOWN)
        if estimator.recoveries > count:
            count, last = estimator.recoveries, t
        said.append((t, estimator.unsure))
    assert count and all(unknown)
    assert not any(words for t, words in said if t < BEGIN)
    assert all(words for t, words in said if BEGIN + 0.5 < t < last + RECOVERY_NAMED - STEP)
    assert not any(words for t, words in said if t > last + RECOVERY_NAMED + STEP)


@pytest.mark.parametrize("axes", [[0.3, 0.3, 0.3], [0.3, 0.0, 0.0]])
def test_an_imu_whose_motion_tdoas_contradict_is_left_out(axes):
    flight = fly(1, 25.0, **QUIET)
    off = (flight.imu.t > BEGIN)[:, None] * np.array(axes)
    flight = replace(flight, imu=replace(flight.imu, gyro=flight.imu.gyro + off))
    certain, far, reasons = 0, 0, set()
    for t, estimator, odometry in looks(flight):
        error = np.linalg.norm(odometry.p[-1] - position_at(flight, odometry.t[-1:])[0])
        far += error > 4.0
        found = estimator.without_imu
        reasons |= {found.cause} if found else set()
        std = math.sqrt(np.trace(odometry.covariance[-1, :3, :3]))
        certain += error > max(1.0, 3.0 * std) and estimator.unsure is None
    assert any("the motion that the IMU measures" in cause for cause in reasons)
    assert certain * STEP < 2.0 and far * STEP < 3.0, (certain, far)


def test_what_a_fault_has_spoiled_is_opened_and_settles():
    flight = fly(2, 25.0, **QUIET)
    known = {}
    for t, _, odometry in looks(flight, [(10.0, Estimator.distrust)]):
        known[round(t, 1)] = yaw_std(odometry) < YAW_KNOWN
        last = odometry
    assert known[9.9] and not known[10.3] and known[24.0]
    assert np.linalg.norm(last.p[-1] - position_at(flight, last.t[-1:])[0]) < 0.3


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_a_pause_of_the_link_restarts_nothing_and_keeps_the_yaw(spread):
    """TDOAs of 3 s come together, or within 1 s. The IMU, on board, goes on."""
    flight = fly(1, 20.0, **QUIET)
    t, imu, estimator, deviations = flight.tdoa.t, flight.imu, Estimator(flight.anchors), []
    paused = (t > 10.0) & (t < 13.0)
    arrival = np.maximum.accumulate(np.where(paused, 13.0 + spread * (t - 10.0) / 3.0, t))
    for now in np.arange(0.02, 20.0, 0.02):
        part = (imu.t >= now - 0.02) & (imu.t < now)
        came = (arrival >= now - 0.02) & (arrival < now)
        estimator.add_imu(imu.t[part], imu.gyro[part], imu.accel[part])
        estimator.add_tdoa(*(getattr(flight.tdoa, name)[came] for name in ("t", "a", "b", "d")))
        odometry, _ = estimator.advance()
        if now > 13.0 and len(odometry):
            deviations.append(yaw_std(odometry))
    assert not estimator.counts["restarts"] and max(deviations) < 2.0 * YAW_KNOWN
    assert np.linalg.norm(odometry.p[-1] - position_at(flight, odometry.t[-1:])[0]) < 0.2
