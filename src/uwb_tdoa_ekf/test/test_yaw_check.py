# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filter doubts a wrong yaw and opens it again within seconds of motion.

It keeps a right one.
"""

from dataclasses import replace
import itertools
import math

import flights
from flights import Wave, fly, position_at
from live import assert_same, assert_same_as_offline, feed
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import new_state
from uwb_tdoa_ekf.core.state import ERROR_STATES
from uwb_tdoa_ekf.core.yaw_check import evidence
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import rotation_std
from uwb_tdoa_ekf.smoother import smooth


class Brisk(Wave):
    """A path at twice the speed.

    The horizontal acceleration is about 1 m/s^2, as in measured flights.
    """

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.pace = 2.0 * self.pace


@pytest.fixture(autouse=True)
def brisk(monkeypatch):
    monkeypatch.setattr(flights, "Wave", Brisk)


NOISE = {"accel_noise": 0.01, "gyro_noise": 0.001}
SOON = 5.0  # s of motion; the tag of `fly` moves from the first stamp on


def yaw_at(flight, t):
    """Return the true yaw, in rad."""
    return flight.meta["wave"].motion(np.atleast_1d(t))[2].as_euler("ZYX")[:, 0]


def told(flight, wrong, degrees=5.0):
    """Return a FilterConfig with an initial yaw that is `wrong` rad off.

    degrees : stated standard deviation, in degrees.
    """
    yaw = float(yaw_at(flight, 0.0)[0]) + wrong
    return FilterConfig(
        initial_yaw=math.remainder(yaw, 2.0 * math.pi), initial_yaw_std=math.radians(degrees)
    )


def dishonest(flight, odometry):
    """Return whether the yaw error exceeds both three deviations and 20 degrees, (n,) bool."""
    error = Rotation.from_quat(odometry.q).as_euler("ZYX")[:, 0] - yaw_at(flight, odometry.t)
    off = np.abs((error + np.pi) % (2.0 * np.pi) - np.pi)
    return off > np.maximum(
        3.0 * rotation_std(odometry.q, odometry.covariance)[:, 2], math.radians(20.0)
    )


def opened(estimator, flight):
    """Feed a Flight and return (Odometry, stamps in s at which the yaw was opened again)."""
    count, stamps, messages = 0, [], itertools.count()

    def advance():
        nonlocal count
        if estimator.yaw_doubts > count:
            count = estimator.yaw_doubts
            stamps.append(estimator.newest)
        return next(messages) % 10 == 0

    odometry, _ = feed(estimator, flight, advance=advance)
    return odometry, stamps


@pytest.mark.parametrize(("seed", "wrong"), [(0, 90.0), (1, -120.0), (2, 180.0)])
def test_a_wrong_yaw_that_is_told_is_opened_within_seconds(seed, wrong):
    flight = fly(seed, 20.0, tdoa_std=0.05, **NOISE)
    odometry, stamps = opened(Estimator(flight.anchors, told(flight, math.radians(wrong))), flight)
    assert stamps and stamps[0] < SOON, stamps
    assert not dishonest(flight, odometry)[odometry.t > stamps[0] + 0.3].any()
    error = np.linalg.norm(odometry.p - position_at(flight, odometry.t), axis=1)
    assert error[odometry.t > 15.0].max() < 0.3


@pytest.mark.parametrize(
    ("seed", "degrees"),
    [
        (0, 3.0),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((1, 12.0), (3, 3.0), (5, 12.0))),
    ],
)
def test_a_right_yaw_is_not(seed, degrees):
    flight = fly(seed, 20.0, outliers=0.05, accel_bias=0.1, gyro_bias=0.005, **NOISE)
    for config in (
        told(flight, 0.0, degrees),
        told(flight, math.radians(degrees), degrees),
        FilterConfig(),
    ):
        _, stamps = opened(Estimator(flight.anchors, config), flight)
        assert not stamps


@pytest.mark.parametrize("seed", range(2))
def test_a_wrong_yaw_of_a_pose_in_flight_is_opened(seed):
    flight = fly(seed, 25.0, tdoa_std=0.05, **NOISE)
    estimator = Estimator(flight.anchors, told(flight, 0.0))
    p, yaw = position_at(flight, np.array([10.0]))[0], float(yaw_at(flight, 10.0)[0])
    estimator.set_pose(
        10.0, p, 0.01 * np.eye(3), math.remainder(yaw + 2.0, 2.0 * math.pi), math.radians(5.0)
    )
    odometry, stamps = opened(estimator, flight)
    assert stamps and 10.0 < stamps[0] < 10.0 + SOON
    assert not dishonest(flight, odometry)[(odometry.t > stamps[0] + 0.3)].any()


@pytest.mark.parametrize("seed", range(2))
def test_a_gyroscope_that_is_off_for_three_seconds_leaves_no_yaw_that_is_wrong_and_known(seed):
    flight = fly(seed, 25.0, tdoa_std=0.05, **NOISE)
    off = ((flight.imu.t > 8.0) & (flight.imu.t < 11.0))[:, None] * [0.0, 0.0, 0.5]
    flight = replace(flight, imu=replace(flight.imu, gyro=flight.imu.gyro + off))
    odometry, _ = opened(Estimator(flight.anchors, told(flight, 0.0)), flight)
    assert not dishonest(flight, odometry)[odometry.t > 11.0 + SOON].any()


def test_it_depends_on_stamps_alone_and_the_smoother_goes_on():
    flight, rng = fly(1, 12.0, tdoa_std=0.05, **NOISE), np.random.default_rng(0)
    config = told(flight, math.pi)
    assert_same_as_offline(flight, config, advance=lambda: rng.random() < 0.1)
    smoothed = smooth(flight, config).odometry
    assert (
        np.isfinite(smoothed.p).all()
        and (np.diagonal(smoothed.covariance, axis1=1, axis2=2) > 0.0).all()
    )
    records: list[np.ndarray] = []
    assert_same(
        run_offline(flight, config, records=records).odometry, run_offline(flight, config).odometry
    )


def test_a_tag_at_rest_doubts_nothing():
    flight = fly(0, 20.0, hover=True, **NOISE)
    assert not opened(Estimator(flight.anchors, told(flight, math.pi)), flight)[1]


def test_evidence_is_the_likelihood_ratio_of_the_best_angle():
    doubt = new_state(np.zeros((4, 3))).record.yaw_test
    assert evidence(doubt) == 0.0 and doubt.response.shape == (2, ERROR_STATES)
    doubt.information[:] = 10.0 * np.eye(2)
    # innovations of a yaw error of 270 degrees
    doubt.vector[:] = 10.0 * np.array([math.cos(1.5 * math.pi) - 1.0, math.sin(1.5 * math.pi)])
    assert evidence(doubt) == pytest.approx(0.5 * 10.0 * 2.0)
