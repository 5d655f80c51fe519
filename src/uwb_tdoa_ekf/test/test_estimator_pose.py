"""What an Estimator is told in flight: poses, a reset, another FilterConfig, that an anchor has
changed.
"""

from dataclasses import replace
import math

from flights import corners, fly, position_at
from live import assert_same, assert_same_as_offline, feed
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.verdicts import COMPENSATED, STARTUP
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline

FIRST = int(corners().ids[0])


def pose_at(flight, t, offset=(0.0, 0.0, 0.0), std=0.1, yaw=math.nan, yaw_std=math.nan):
    """Arguments of set_pose: the true position of a flight at t, off by some metres."""
    return t, position_at(flight, np.array([t]))[0] + offset, std**2 * np.eye(3), yaw, yaw_std


def test_a_pose_that_is_set_starts_the_filter_there_with_its_yaw():
    flight = fly(duration=1.0)
    yaw = Rotation.from_quat(flight.truth.q[0]).as_euler("ZYX")[0]
    estimator = Estimator(flight.anchors)
    estimator.set_pose(*pose_at(flight, 0.05, yaw=yaw, yaw_std=0.1))
    odometry, residuals = feed(estimator, flight)
    assert odometry.t[0] < 0.06  # half a second of TDOAs would be needed
    error = np.linalg.norm(odometry.p - position_at(flight, odometry.t), axis=1)
    assert error.max() < 0.35
    found = Rotation.from_quat(odometry.q[0]).as_euler("ZYX")[0]
    assert abs(found - yaw) < 0.1
    assert np.sum(residuals.verdict == STARTUP) == np.sum(flight.tdoa.t < 0.05)


@pytest.mark.parametrize("ahead", [0.0, 0.4])
def test_a_pose_takes_effect_at_its_stamp_whenever_it_comes_before(ahead):
    flight, t = fly(duration=3.0), 2.0
    expected = None
    for when in (t - 0.05, t - 0.05 - ahead):
        estimator, sent = Estimator(flight.anchors), []

        def set_in_time(estimator=estimator, sent=sent, when=when):
            if not sent and estimator.newest >= when:
                sent.append(estimator.set_pose(*pose_at(flight, t, (3.0, 0.0, 0.0), 0.2)))
            return True

        odometry, _ = feed(estimator, flight, advance=set_in_time)
        if expected is None:
            expected = odometry
    assert_same(odometry, expected)
    before, after = odometry.p[odometry.t <= t], odometry.p[odometry.t > t]
    assert after[0, 0] - before[-1, 0] > 2.5  # it goes where it is told


def test_a_pose_that_comes_late_counts_from_the_next_measurement_and_another_time_is_refused():
    flight = fly(duration=2.0)
    estimator = Estimator(flight.anchors)
    feed(estimator, flight)
    estimator.set_pose(*pose_at(flight, 1.5, (0.0, 3.0, 0.0), 0.01))
    t = flight.imu.t[-1] + 0.005
    estimator.add_imu(t, flight.imu.gyro[-1], flight.imu.accel[-1])
    odometry, _ = estimator.finish()
    assert odometry.p[-1, 1] - position_at(flight, np.array([1.5]))[0, 1] == pytest.approx(
        3.0, abs=0.1
    )
    for stamp in (t - 5.0, t + 100.0):
        with pytest.raises(InputError, match="its stamp is"):
            estimator.set_pose(stamp, np.zeros(3), np.eye(3))


@pytest.mark.parametrize("stamp", [1.7e9, -500.0])
def test_a_pose_of_another_clock_that_comes_before_the_first_measurement_is_dropped_and_said_to_be(
    stamp,
):
    flight = fly(duration=2.0)
    estimator = Estimator(flight.anchors)
    estimator.set_pose(stamp, np.zeros(3), np.eye(3))
    odometry, _ = feed(estimator, flight)
    assert_same(odometry, run_offline(flight).odometry)
    assert odometry.t[-1] < 2.0 and "is not used" in estimator.refused_pose
    estimator.set_pose(*pose_at(flight, 2.0))
    assert estimator.refused_pose is None


def test_coordinates_that_are_not_told_stay():
    flight = fly(duration=3.0)
    estimator, plain = Estimator(flight.anchors), Estimator(flight.anchors)
    undisturbed, _ = feed(plain, flight)
    t, p, covariance, _, _ = pose_at(flight, 2.0, (1.0, 0.0, 0.0), 0.01)
    estimator.set_pose(t, [p[0], math.nan, math.nan], covariance)
    odometry, _ = feed(estimator, flight)
    k = np.searchsorted(odometry.t, t, side="right")
    change = odometry.p[k] - undisturbed.p[k]
    assert change[0] > 0.8 and np.abs(change[1:]).max() < 0.1
    np.testing.assert_allclose(odometry.q[k], undisturbed.q[k], atol=0.01)


def test_after_a_reset_a_recording_gives_what_it_gives_to_a_new_filter():
    flight = fly(duration=2.0)
    estimator = Estimator(flight.anchors)
    first = feed(estimator, flight)
    odometry, residuals = estimator.reset()
    assert len(odometry) == len(residuals.t) == 0 and not estimator.running
    assert_same(feed(estimator, flight)[0], first[0])
    assert estimator.counts["restarts"] == 1


def test_another_tuning_counts_from_the_next_measurement_on():
    flight = fly(duration=3.0)
    estimator, plain = Estimator(flight.anchors), Estimator(flight.anchors)
    undisturbed, _ = feed(plain, flight)

    def configure():
        if estimator.newest >= 2.0:
            estimator.configure(FilterConfig(tdoa_std=5.0))
        return True

    odometry, residuals = feed(estimator, flight, advance=configure)
    before = odometry.t < 1.95
    np.testing.assert_array_equal(odometry.p[before], undisturbed.p[before])
    assert residuals.variance[-1] > 20.0


def with_a_late_anchor(size=0.8, since=20.0):
    """A flight of 32 s in which one of eight anchors becomes late."""
    flight = fly(4, 32.0, imu_rate=50.0, tdoa_rate=100.0, tdoa_std=0.05)
    tdoa = flight.tdoa
    sign = (tdoa.b == FIRST).astype(float) - (tdoa.a == FIRST)
    return flight, replace(flight, tdoa=replace(tdoa, d=tdoa.d + size * sign * (tdoa.t > since)))


def test_a_delay_that_comes_in_flight_is_taken_out_if_asked_for_whatever_the_arrival():
    flight, harmed = with_a_late_anchor()
    config = FilterConfig(compensate_changes=True)
    assert_same_as_offline(harmed, config)
    rng = np.random.default_rng(2)
    assert_same_as_offline(harmed, config, advance=lambda: rng.random() < 0.01)
    errors = {}
    for name, (run_of, of) in {
        "sound": (flight, config),
        "off": (harmed, None),
        "on": (harmed, config),
    }.items():
        run = run_offline(run_of, of)
        late = run.odometry.t > 25.0
        errors[name] = np.sqrt(
            np.mean((run.odometry.p[late] - position_at(flight, run.odometry.t[late])) ** 2)
        )
        of_anchor = (run.residuals.a == FIRST) | (run.residuals.b == FIRST)
        compensated = run.residuals.verdict == COMPENSATED
        assert compensated.any() == (name == "on") and not compensated[~of_anchor].any()
        if name == "on":  # the innovation still has the delay
            assert np.mean(np.abs(run.residuals.innovation[compensated])) == pytest.approx(
                0.8, abs=0.15
            )
    assert errors["on"] < 0.5 * errors["off"]
    estimator = Estimator(harmed.anchors)
    feed(estimator, harmed)
    assert (
        estimator.alarms[0].startswith(f"anchor {FIRST}: ") and estimator.counts["compensated"] == 0
    )
