from dataclasses import replace

from flights import fly
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.hypotheses import (
    MERGED_WITHIN,
    PRUNED_BELOW,
    YAW_STD,
    select,
)
from uwb_tdoa_ekf.core.memory import HYPOTHESES, new_state
from uwb_tdoa_ekf.offline import run_offline

NOISE = dict(accel_noise=0.01, gyro_noise=0.001)  # a common sensor that does not vibrate


def yaw_errors(flight, odometry):
    """rad, at the stamps of the odometry."""
    attitude = flight.meta["wave"].motion(odometry.t)[2]
    return (attitude.inv() * Rotation.from_quat(odometry.q)).as_rotvec()[:, 2]


def ekf_with(yaws, log_weights):
    ekf = new_state(np.zeros((4, 3))).record
    ekf.hypotheses["log_weight"] = np.append(
        log_weights, np.full(HYPOTHESES - len(log_weights), -np.inf)
    )
    for h, yaw in enumerate(yaws):
        ekf.hypotheses["x"][h, 6:10] = Rotation.from_euler("z", yaw).as_quat()
    return ekf


def test_select_follows_the_best_and_prunes_the_improbable_and_the_same():
    ekf = ekf_with([0.0, 0.05, 2.0, 3.0], [-1.0, -2.0, -3.0, -1.0 + 1.1 * PRUNED_BELOW])
    select(ekf, 5.0)
    assert ekf.best == 0
    np.testing.assert_array_equal(ekf.hypotheses["log_weight"][:4], [0.0, -np.inf, -2.0, -np.inf])


def test_what_is_elsewhere_is_not_the_same_whichever_way_it_faces():
    ekf = ekf_with([0.0, 0.0, 0.0], [0.0, -1.0, -1.0])
    ekf.hypotheses["x"][1, 2], ekf.hypotheses["x"][2, 2] = 1.5 * MERGED_WITHIN, 0.5 * MERGED_WITHIN
    select(ekf, 5.0)
    np.testing.assert_array_equal(ekf.hypotheses["log_weight"][:3], [0.0, -1.0, -np.inf])


@pytest.mark.parametrize("wrong", [0.5 * np.pi, -0.5 * np.pi, np.pi, 0.8])
def test_a_yaw_that_nobody_told_is_found_while_moving_and_doubted_until_then(wrong):
    """Within 15 degrees 10 s after the start; before, the error is inside three of its own standard
    deviations.
    """
    for seed in range(3):
        flight = fly(seed, 15.0, **NOISE)
        yaw = Rotation.from_quat(flight.truth.q[0]).as_euler("ZYX")[0]
        odometry = run_offline(flight, FilterConfig(initial_yaw=yaw + wrong)).odometry
        error = yaw_errors(flight, odometry)
        late = odometry.t > odometry.t[0] + 10.0
        assert np.abs(np.degrees(error[late])).max() < 15.0, seed
        assert (np.abs(error) < 3.0 * np.sqrt(odometry.covariance[:, 8, 8])).mean() > 0.99, seed


def test_a_yaw_that_is_known_starts_one_filter():
    flight = fly(1, 2.0, hover=True)
    known = run_offline(flight, FilterConfig(initial_yaw=0.0, initial_yaw_std=YAW_STD))
    assert known.odometry.covariance[0, 8, 8] == pytest.approx(YAW_STD**2, rel=0.05)
    unknown = run_offline(flight, FilterConfig(initial_yaw=0.0))
    assert unknown.odometry.covariance[0, 8, 8] > 1.5**2


def test_a_yaw_that_no_motion_tells_stays_unknown():
    flight = fly(2, 20.0, hover=True, **NOISE)
    odometry = run_offline(flight).odometry
    assert np.sqrt(odometry.covariance[-1, 8, 8]) > np.radians(45.0)


def test_turning_the_world_turns_the_estimate():
    """Nothing in the filter prefers a direction but initial_yaw, and that only among equals."""
    flight = fly(3, 12.0, **NOISE)
    turn = Rotation.from_euler("z", 2.0)
    anchors = replace(flight.anchors, positions=turn.apply(flight.anchors.positions.copy()))
    one = run_offline(flight).odometry
    other = run_offline(replace(flight, anchors=anchors)).odometry
    late = one.t > 11.0
    np.testing.assert_allclose(other.p[late], turn.apply(one.p[late]), atol=0.02)
