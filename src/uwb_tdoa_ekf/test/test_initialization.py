from dataclasses import replace

from driving import assert_sound, drive, errors, state_for
from flights import fly
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core.config import ROBUST, FilterConfig
from uwb_tdoa_ekf.core.memory import REJECTED, STARTUP, USED


def test_starts_by_itself_within_its_window_and_knows_where_it_is():
    for seed in range(5):
        flight = fly(seed, 2.0, outliers=0.1)
        odometry, residuals = drive(flight)
        assert 0.4 < odometry.t[0] < 0.6
        assert errors(flight, odometry)[0] < 0.3
        startup = residuals.verdict == STARTUP
        np.testing.assert_array_equal(startup, flight.tdoa.t <= flight.tdoa.t[startup][-1])
        for name in ("innovation", "variance"):
            np.testing.assert_array_equal(np.isnan(residuals[name]), startup)
        assert (residuals.weight[startup] == 0.0).all() and np.isfinite(residuals.weight).all()
        assert np.isin(residuals.verdict[~startup], (USED, REJECTED)).all()


def test_starts_level_with_the_yaw_it_was_told():
    flight = fly(3, 2.0, hover=True)
    turned = Rotation.from_euler("ZYX", [0.7, 0.2, -0.3])
    flight = replace(flight, imu=replace(flight.imu, accel=turned.inv().apply(flight.imu.accel)))
    odometry, _ = drive(flight, FilterConfig(initial_yaw=0.7, initial_yaw_std=0.5))
    assert (Rotation.from_quat(odometry.x[0, 6:10]).inv() * turned).magnitude() < 0.02
    assert odometry.covariance[0, 8, 8] == pytest.approx(0.25, rel=0.05)


def test_contradicting_tdoas_start_only_after_the_timeout():
    flight = fly(4, 3.0, outliers=0.6)
    odometry, _ = drive(flight, FilterConfig(start_timeout=1.5))
    assert 1.5 < odometry.t[0] < 1.75


def test_one_tdoa_long_before_the_others_does_not_use_up_the_timeout():
    flight = fly(4, 3.0, outliers=0.6, begin=30.0)
    early = np.concatenate([[1.0], flight.tdoa.t])
    first = [
        np.concatenate([column[:1], column])
        for column in (flight.tdoa.a, flight.tdoa.b, flight.tdoa.d)
    ]
    odometry, _ = drive(replace(flight, tdoa=Tdoas(early, *first)))
    assert odometry.t[0] > 30.4  # a window of start_window, not a dozen TDOAs


@pytest.mark.parametrize("robust", ROBUST)
def test_finds_a_tag_again_that_was_carried_away(robust):
    """3.6 m, which its inertial sensor has not felt: not before it could have come so far."""
    near, far = fly(10, 12.0, hover=True), fly(10, 12.0, hover=True)
    there = np.array([1.0, 6.5, 0.8])
    p = np.where(far.tdoa.t[:, None] < 5.0, near.truth.p[0], there)
    positions = far.anchors.positions
    d = tdoa(p, positions[far.anchors.index(far.tdoa.a)], positions[far.anchors.index(far.tdoa.b)])
    d += 0.1 * np.random.default_rng(0).standard_normal(len(d))
    state = state_for(far)
    odometry, _ = drive(
        replace(far, tdoa=replace(far.tdoa, d=d)), FilterConfig(robust=robust), state
    )
    assert state.record.recoveries <= 2
    assert np.linalg.norm(odometry.x[odometry.t > 8.0, :3] - there, axis=1).max() < 0.3
    assert_sound(state, odometry)


def test_a_good_flight_needs_no_recovery():
    for seed in range(3):
        flight = fly(seed, 10.0, outliers=0.1)
        state = state_for(flight)
        drive(flight, state=state)
        assert state.record.recoveries == 0


def beside(flight, positions):
    """The flight, heard by anchors at other positions (N, 3) m."""
    a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
    p = flight.meta["wave"].motion(flight.tdoa.t)[0]
    d = tdoa(p, positions[a], positions[b]) + 0.1 * np.random.default_rng(0).standard_normal(len(p))
    return replace(
        flight, anchors=replace(flight.anchors, positions=positions), tdoa=replace(flight.tdoa, d=d)
    )


def test_of_anchors_on_a_wall_both_sides_are_followed_until_motion_tells():
    """The deviation is as large as the sides are apart; the accelerometer then decides."""
    y, z = np.meshgrid([0.0, 2.7, 5.3, 8.0], [0.3, 3.0])
    wall = np.column_stack([np.full(8, 0.5), y.ravel(), z.ravel()])
    wrong = 0
    for seed in range(6):
        flight = beside(fly(seed, 15.0), wall)
        odometry, _ = drive(flight)
        off = errors(flight, odometry)
        std = np.sqrt(np.trace(odometry.covariance[:, :3, :3], axis1=1, axis2=2))
        wrong += (off > 1.5).any()
        assert (off < 4.0 * std).all() and off[-1] < 1.0
    assert wrong  # of some the other side is believed in for a while
