# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A rover on a floor: wheels as a motion sensor, the plane, and TDOAs that contradict wheels."""

from dataclasses import replace
import math

from flights import corners, fly, with_sensors, without_tdoas
from hypothesis import given, strategies as st
from live import assert_same, feed, joined, messages, send
import numpy as np
import pytest
from rovers import HEIGHT, HEIGHT_STD, Errors, drive, late, misled, yaw_of
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.sensors import Velocity
from uwb_tdoa_ekf.core.config import PLANAR_HEIGHT_STD, FilterConfig
from uwb_tdoa_ekf.core.initialization import ANY_YAW, RIVAL_TIME
from uwb_tdoa_ekf.core.memory import USED
from uwb_tdoa_ekf.core.state import turn_about_vertical
from uwb_tdoa_ekf.core.yaw_check import YAW_KNOWN
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_ekf.smoother import smooth

SHORT, LAG = 45.0, 0.25  # s; s, default of the estimator
PLANAR = FilterConfig(planar=True, fixed_height=HEIGHT)
WHEELS = replace(PLANAR, use_imu=False)
SETTLED = 15.0  # s until the yaw is known


def errors(flight, config, since=SETTLED):
    """Return the errors of a filter without a given start."""
    return Errors(flight, run_offline(flight, config).odometry, since)


def rms(values):
    return math.sqrt(np.mean(np.square(values)))


@pytest.fixture(scope="module")
def rover():
    return drive(3, SHORT)


@pytest.mark.parametrize(
    ("config", "xy", "yaw"),
    [(PLANAR, 0.08, 2.0), (WHEELS, 0.09, 3.0), (replace(WHEELS, planar=False), 0.12, 3.0)],
)
def test_wheels_tell_position_and_yaw_with_an_imu_and_without(rover, config, xy, yaw):
    found = errors(rover, config)
    assert rms(found.xy) < xy and rms(np.degrees(found.yaw)) < yaw
    assert (
        (found.yaw_std < YAW_KNOWN).all()
        and np.mean(found.nees_yaw) < 5.0
        and np.mean(found.nees_xy) < 5.0
    )
    # The filter must not claim a known yaw too early.
    early = errors(rover, config, 0.0)
    assert not np.any((early.yaw_std < YAW_KNOWN) & (np.abs(early.yaw) > 3.0 * YAW_KNOWN))


def test_a_yaw_that_nothing_measures_is_not_known(rover):
    told = FilterConfig(
        use_imu=False, initial_yaw=float(yaw_of(rover.truth.q)[0]), initial_yaw_std=0.05
    )
    found = errors(rover.without("velocity"), told, 0.0)
    assert found.yaw_std[0] < 0.2 and np.degrees(found.yaw_std[-1]) == pytest.approx(
        np.degrees(ANY_YAW), rel=0.05
    )
    assert rms(found.xy[found.t - found.t[0] > SETTLED]) < 0.12 and np.mean(found.nees_yaw) < 5.0


def test_a_yaw_that_nothing_measures_grows_uncertain_as_the_parameter_says(rover):
    told = FilterConfig(
        use_imu=False,
        turn_noise=0.05,
        initial_yaw=float(yaw_of(rover.truth.q)[0]),
        initial_yaw_std=0.1,
    )
    odometry = run_offline(rover.without("velocity"), told).odometry
    squares = odometry.covariance[:, 8, 8]
    grown = squares[-1] - squares[0]
    assert grown == pytest.approx(0.05**2 * (odometry.t[-1] - odometry.t[0]), rel=0.1)


def test_a_yaw_without_a_yaw_rate_is_known_by_motion_alone(rover):
    """Without a yaw rate, the yaw follows from the direction of the motion.

    It becomes unknown while the rover stands.
    """
    no_rate = rover.replaced(velocity=replace(rover.velocity, yaw_rate=None, yaw_rate_std=None))
    found = errors(no_rate, WHEELS)
    assert np.mean(found.nees_yaw) < 5.0
    # the last part of the stop
    stands = (found.t - rover.truth.t[0] > 27.0) & (found.t - rover.truth.t[0] < 28.5)
    assert (found.yaw_std[stands] > YAW_KNOWN).all()


def test_wheels_carry_the_tag_while_no_tdoas_come(rover):
    begin = rover.truth.t[0]
    silent = without_tdoas(rover, begin + 25.0, begin + 40.0)
    # share of the distance
    for config, share in ((PLANAR, 0.1), (WHEELS, 0.2)):
        found = errors(silent, config)
        assert found.xy.max() < share * 15.0 * 0.5 and np.mean(found.nees_xy) < 5.0


@pytest.mark.parametrize("config", [PLANAR, WHEELS, replace(WHEELS, use_velocity=False)])
def test_a_planar_vehicle_is_flat_and_says_how_well_that_is_known(rover, config):
    odometry = run_offline(without_tdoas(rover, rover.truth.t[0] + 30.0), config).odometry
    np.testing.assert_array_equal(odometry.p[:, 2], HEIGHT)
    np.testing.assert_array_equal(odometry.q[:, :2], 0.0)
    np.testing.assert_array_equal(odometry.v[:, 2], 0.0)
    variances = np.diagonal(odometry.covariance, axis1=1, axis2=2)
    # This includes 15 s without TDOAs.
    np.testing.assert_allclose(variances[:, 2], PLANAR_HEIGHT_STD**2)
    np.testing.assert_allclose(variances[:, 6:8], config.tilt_std**2)
    assert np.linalg.eigvalsh(odometry.covariance).min() > 0.0


def test_a_fixed_height_alone_is_held_and_stated(rover):
    found = errors(rover, FilterConfig(fixed_height=HEIGHT, fixed_height_std=HEIGHT_STD))
    assert np.abs(found.position[:, 2]).max() < 3.0 * HEIGHT_STD
    assert 0.5 * HEIGHT_STD < found.z_std.min() and found.z_std.max() < 1.5 * HEIGHT_STD
    assert errors(rover, FilterConfig()).z_std.max() > 0.2


def test_a_yaw_rate_alone_shows_no_yaw(rover):
    """With a gyroscope in a twist and no IMU, the position is as good as with TDOAs alone."""
    n = len(rover.velocity)
    alone = rover.replaced(
        velocity=replace(rover.velocity, v=np.full((n, 3), np.nan), std=np.full((n, 3), np.inf))
    )
    found, without = errors(alone, WHEELS), errors(rover.without("velocity"), WHEELS)
    assert (found.yaw_std > YAW_KNOWN).all() and rms(found.xy) == pytest.approx(
        rms(without.xy), rel=0.05
    )


def test_two_sources_of_velocity_do_not_disturb_each_other(rover):
    """Optical flow without a yaw rate alternates with messages of wheels."""
    wheels = rover.velocity
    n = len(wheels)
    parts = [
        (wheels.t, wheels.t + 0.01),
        (wheels.v, wheels.v),
        (wheels.std, np.tile([0.1, 0.1, np.inf], (n, 1))),
        (wheels.yaw_rate, np.full(n, np.nan)),
        (wheels.yaw_rate_std, np.full(n, np.inf)),
    ]
    order = np.argsort(np.concatenate(parts[0]))
    both = Velocity(*(np.concatenate(part)[order] for part in parts))
    found, one = errors(rover.replaced(velocity=both), WHEELS), errors(rover, WHEELS)
    assert rms(found.yaw) < 1.5 * rms(one.yaw) and rms(found.xy) < 1.2 * rms(one.xy)


def test_what_cannot_move_sideways(rover):
    """The wheels state no sideways velocity."""
    std = rover.velocity.std.copy()
    std[:, 0], std[:, 1:] = 0.03, np.inf
    along = rover.replaced(velocity=replace(rover.velocity, std=std))
    free, bound = (errors(along, replace(WHEELS, non_holonomic_std=std)) for std in (0.0, 0.03))
    assert rms(bound.yaw) < min(rms(free.yaw), math.radians(4.0)) and np.mean(bound.nees_yaw) < 5.0


def test_messages_without_a_variance_are_used_with_the_deviation_of_the_parameter(rover):
    silent = run_offline(rover, PLANAR)
    assert (silent.sensors["velocity"]["verdict"] == USED).mean() > 0.8
    n, config = len(rover.velocity), FilterConfig()
    stated = replace(
        rover.velocity,
        std=np.full((n, 3), config.velocity_std),
        yaw_rate_std=np.full(n, config.yaw_rate_std),
    )
    assert_same(run_offline(rover.replaced(velocity=stated), PLANAR).odometry, silent.odometry)


@pytest.mark.parametrize("config", [PLANAR, replace(WHEELS, non_holonomic_std=0.05)])
def test_live_is_off_line(config):
    short = drive(1, 12.0)
    odometry, _ = feed(Estimator(short.anchors, config), short)
    assert_same(odometry, run_offline(short, config).odometry)


def test_the_yaw_rate_of_wheels_is_that_of_the_odometry_where_they_predict():
    """The filter has no IMU, or an IMU that stops.

    The wheels do not have the bias of the gyroscope.
    """
    short = drive(1, 8.0)
    wheels, silent = short.velocity, short.truth.t[0] + 6.0
    imu = rows_of(short.imu, short.imu.t < silent)
    for flight, config, since in (
        (short, WHEELS, 0.0),
        (replace(short, imu=imu), PLANAR, silent + PLANAR.imu_timeout),
    ):
        odometry = run_offline(flight, config).odometry
        odometry = rows_of(odometry, odometry.t > max(since, flight.truth.t[0] + 3.0))
        last = np.searchsorted(wheels.t, odometry.t, side="right") - 1
        assert len(odometry) > 100 and np.isnan(odometry.rate[:, :2]).all()
        same = odometry.rate[:, 2] == wheels.yaw_rate[last]
        # In the remaining cases the last message of the wheels was refused.
        assert same.mean() > 0.95
        np.testing.assert_allclose(odometry.rate_variance[same, 2], config.yaw_rate_std**2)


def test_no_yaw_rate_is_stated_where_nothing_measures_one(rover):
    odometry = run_offline(rover.without("velocity"), WHEELS).odometry
    assert np.isnan(odometry.rate).all() and np.isnan(odometry.rate_variance).all()


def test_without_an_imu_time_goes_on_by_wheels_while_no_tdoas_come():
    flight = drive(1, 20.0)
    begin = flight.truth.t[0]
    flight = without_tdoas(flight, begin + 12.0, begin + 17.0).without("imu")
    estimator, parts = Estimator(flight.anchors, WHEELS), []
    for t, stream, i in messages(flight):
        send(estimator, flight, stream, i)
        parts.append(estimator.advance()[0])
        if 14.0 < t - begin < 16.9:
            newest = max(part.t[-1] for part in parts[-200:] if len(part))
            assert t - newest < LAG + 0.1
    parts.append(estimator.finish()[0])
    assert_same(joined(parts), run_offline(flight, WHEELS).odometry)


def test_the_smoother_takes_wheels():
    short = drive(1, 30.0)
    smoothed, online = (
        Errors(short, run.odometry, SETTLED)
        for run in (smooth(short, WHEELS), run_offline(short, WHEELS))
    )
    assert rms(smoothed.xy) < rms(online.xy) and rms(smoothed.yaw) < 1.2 * rms(online.yaw)


# --- TDOAs that contradict wheels ---


@pytest.mark.parametrize(
    ("seed", "rows", "config"), [(3, (0, 4), PLANAR), (5, (4, 3), WHEELS), (2, (1, 4), WHEELS)]
)
def test_two_late_anchors_do_not_overrule_wheels(seed, rows, config):
    flight = late(drive(seed, SHORT), rows, since=33.0)
    run = run_offline(flight, config)
    found = Errors(flight, run.odometry, SETTLED)
    assert run.recoveries == 0 and found.xy.max() < 0.3 and found.steps.max() < 0.2


@pytest.mark.slow
def test_a_tag_that_two_places_are_possible_for_says_so():
    """`unsure` is set while TDOAs agree on another position. The deviation then covers it.

    It is not set before, nor some time after.
    """
    flight = late(drive(3, SHORT), (0, 4), since=33.0)
    estimator, said = Estimator(flight.anchors, PLANAR), []

    def look():
        said.append((estimator.newest - flight.truth.t[0], estimator.unsure is not None))
        return True

    odometry, _ = feed(estimator, flight, advance=look)
    t, unsure = (np.array(column) for column in zip(*said))
    assert (
        not unsure[t < 33.0].any()
        and unsure[(t > 34.0) & (t < 38.0)].mean() > 0.3
        and not unsure[t > 39.5].any()
    )
    std = np.sqrt(odometry.covariance[:, 0, 0])
    since = odometry.t - flight.truth.t[0]
    assert np.median(std[since < 33.0]) < 0.3 < 0.5 < std[(since > 33.0) & (since < 38.5)].max()


@pytest.mark.slow
def test_a_rover_that_is_lost_is_found(config=WHEELS):
    """The filter gets a wrong pose, and the wheels are good.

    The filter is unsure for a while. Then TDOAs of all anchors prevail.
    """
    flight = drive(1, 40.0)
    estimator, begin = Estimator(flight.anchors, config), flight.truth.t[0]
    told = False

    def tell():
        nonlocal told
        if not told and estimator.newest > begin + 25.0:
            told = True
            true = flight.truth.p[np.searchsorted(flight.truth.t, estimator.newest)]
            middle = flight.anchors.positions.mean(axis=0)
            wrong = true + 3.0 * np.sign(middle - true) * [1.0, 0.0, 0.0]
            estimator.set_pose(estimator.newest, wrong, 1e-4 * np.eye(3))
        return True

    odometry, _ = feed(estimator, flight, advance=tell)
    found = Errors(flight, odometry, 25.1)
    assert found.xy[0] > 2.0 and estimator.recoveries >= 1
    again = found.t[found.xy > 0.5].max() - begin - 25.0
    assert 0.5 * RIVAL_TIME < again < RIVAL_TIME + 4.0


# --- TDOAs that show wrong wheels ---


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["stick", "spin", "twice", "opposite"])
@pytest.mark.parametrize("every", [1, 5])
def test_wheels_that_tdoas_contradict_are_left_out_named_and_taken_again(fault, every):
    """Without an IMU, at 100 and 20 TDOAs/s, the wheels are wrong from 28 to 36 s.

    In the opposite direction they lead farther. The yaw does not follow them.
    """
    drove = drive(1, SHORT)
    flight = misled(replace(drove, tdoa=rows_of(drove.tdoa, slice(None, None, every))), fault)
    estimator, begin, named = Estimator(flight.anchors, WHEELS), flight.truth.t[0], []

    def look():
        if "contradict the wheels" in (estimator.unsure or ""):
            named.append(estimator.newest - begin)
        return True

    odometry, _ = feed(estimator, flight, advance=look)
    found = Errors(flight, odometry, SETTLED)
    step = np.median(np.diff(found.t))
    assert np.sum(found.xy > 0.5) * step < (4.0 if (fault, every) == ("opposite", 5) else 2.0)
    assert not np.any((found.yaw_std < YAW_KNOWN) & (np.abs(found.yaw) > 3.0 * YAW_KNOWN))
    assert 28.5 < min(named) < 31.0 and max(named) < 40.0
    wheels = run_offline(flight, WHEELS).sensors["velocity"]
    t, used = flight.velocity.t - begin, wheels["verdict"] == USED
    assert used[(t > 31.0) & (t < 35.0)].mean() < 0.1 and used[t > 41.0].mean() > 0.8


def test_few_tdoas_hold_wheels_without_an_imu():
    """The yaw of the start is wrong for a while; before, the wheels then led 8 m away."""
    drove = drive(0, SHORT)
    flight = replace(drove, tdoa=rows_of(drove.tdoa, slice(None, None, 5)))
    assert errors(flight, replace(WHEELS, planar=False)).xy.max() < 0.4


def test_wheels_show_a_wrong_yaw():
    """A yaw that is told wrong is found again, with an IMU and without."""
    flight = drive(3, 30.0)
    for config in (PLANAR, WHEELS):
        told = replace(
            config, initial_yaw=float(yaw_of(flight.truth.q)[0]) + 2.0, initial_yaw_std=0.1
        )
        found = errors(flight, told, 10.0)
        assert np.degrees(np.abs(found.yaw)).max() < 20.0


# --- parts ---


@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
def test_a_turn_about_the_vertical(seed, angle):
    before = Rotation.random(random_state=seed)
    x = np.zeros(16)
    x[6:10] = before.as_quat()
    turn_about_vertical(x, angle)
    after = Rotation.from_euler("z", angle) * before
    assert (after.inv() * Rotation.from_quat(x[6:10])).magnitude() < 1e-9
    np.testing.assert_array_equal(np.delete(x, range(6, 10)), 0.0)


def test_wheels_that_turn_evenly_are_not_stuck():
    """A simulated rover drives straight at constant speed, so its wheels repeat the same value."""
    flight = with_sensors(fly(2, 6.0, anchors=corners()))
    t = flight.velocity.t
    even = Velocity(
        t,
        np.tile([0.3, 0.0, 0.0], (len(t), 1)),
        np.full((len(t), 3), 3.0),
        np.full(len(t), 0.1),
        np.full(len(t), 3.0),
    )
    for velocity, used in ((even, 1.0), (Velocity(t, even.v, even.std), 0.0)):
        assert (
            run_offline(flight.replaced(velocity=velocity)).sensors["velocity"]["verdict"][t > 3.0]
            == USED
        ).mean() == used
