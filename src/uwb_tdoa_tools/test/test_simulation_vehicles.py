# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Paths and vehicles of simulated flights."""

from dataclasses import replace

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_tools import simulation
from uwb_tdoa_tools.commands import simulate as command
from uwb_tdoa_tools.simulation import NO_IMU_ERRORS, SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import VEHICLE_DEFAULTS
from uwb_tdoa_tools.simulation.vehicles import GRAVITY, TRAJECTORIES, VEHICLES, Trajectory

CONFIG = SimulationConfig(duration=40.0, speed=1.2)
YAWS = {"circle": "along_track", "sines": "along_track", "square": "rotating"}


def fly(config):
    filled, room = config.complete()
    return Trajectory.of_config(filled, room, filled.random("trajectory")), filled, room


@pytest.fixture(
    params=[(name, in_air) for name in TRAJECTORIES for in_air in (False, True)], ids=str
)
def flown(request):
    name, in_air = request.param
    return fly(replace(CONFIG, trajectory=name, yaw=YAWS.get(name, "fixed"), start_in_air=in_air))[
        0
    ]


def test_derivatives_are_those_of_the_position(flown):
    t = np.linspace(0.5, 39.5, 3001)
    h = 1e-3
    before, here, after = (flown.motion(t + k * h) for k in (-1, 0, 1))
    np.testing.assert_allclose((after.p - before.p) / (2 * h), here.v, atol=2e-5)
    np.testing.assert_allclose((after.v - before.v) / (2 * h), here.a, atol=2e-4)


def test_gyro_integrates_to_the_attitude(flown):
    t = np.arange(0.0, 40.0, 1e-3)
    motion = flown.motion(t)
    attitude = Rotation.from_quat(motion.q)
    turned = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 1e-3
    middle = 0.5 * (motion.body_rates[:-1] + motion.body_rates[1:])
    assert np.abs(turned - middle).max() < 1e-5


def test_specific_force_integrates_to_the_position(flown):
    """Exact samples, integrated for 10 s with the trapezoidal rule, match within millimetres."""
    t = np.arange(8.0, 18.0, 1e-3)
    motion = flown.motion(t)
    a = Rotation.from_quat(motion.q).apply(motion.specific_force) - [0.0, 0.0, GRAVITY]
    dt = np.diff(t)[:, None]
    v = motion.v[0] + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.5 * dt * (a[1:] + a[:-1]), axis=0)]
    )
    p = motion.p[0] + np.cumsum(dt * (v[:-1] + dt * (2 * a[:-1] + a[1:]) / 6), axis=0)
    assert np.abs(p - motion.p[1:]).max() < 1e-3


def test_rests_exactly_on_the_floor():
    trajectory, config, room = fly(CONFIG)
    motion = trajectory.motion(np.array([0.0, 1.0, 2.999, 37.001, 40.0]))
    np.testing.assert_array_equal(motion.v, 0.0)
    np.testing.assert_array_equal(motion.a, 0.0)
    np.testing.assert_array_equal(motion.body_rates, 0.0)
    np.testing.assert_allclose(
        motion.specific_force, np.tile([0.0, 0.0, GRAVITY], (5, 1)), atol=1e-12
    )
    np.testing.assert_allclose(motion.p[:, 2], 0.03, atol=1e-9)
    np.testing.assert_array_equal(motion.p[0], motion.p[2])
    assert (trajectory.take_off, trajectory.landing) == (3.0, 37.0)
    assert (
        not trajectory.motors(np.array([0.0, 40.0])).any()
        and trajectory.motors(np.array([3.0, 20.0])).all()
    )


def test_start_in_air_is_moving_from_the_first_instant():
    trajectory, config, room = fly(replace(CONFIG, trajectory="circle", start_in_air=True))
    motion = trajectory.motion(np.array([0.0, 40.0]))
    np.testing.assert_allclose(np.linalg.norm(motion.v, axis=1), 1.2, atol=1e-3)
    np.testing.assert_allclose(motion.p[:, 2], config.height, atol=1e-6)
    assert trajectory.take_off is None


def test_circle_is_a_circle():
    trajectory, config, room = fly(
        replace(CONFIG, trajectory="circle", radius=1.5, place=(0.3, -0.4), height=1.2)
    )
    motion = trajectory.motion(np.linspace(10.0, 30.0, 500))
    np.testing.assert_allclose(
        np.linalg.norm(motion.p[:, :2] - [0.3, -0.4], axis=1), 1.5, atol=1e-4
    )
    np.testing.assert_allclose(np.linalg.norm(motion.v, axis=1), 1.2, atol=1e-3)
    np.testing.assert_allclose(motion.p[:, 2], 1.2, atol=1e-4)


@pytest.mark.parametrize("axis", [0, 1])
def test_line_goes_back_and_forth_along_its_axis(axis):
    trajectory = fly(
        replace(CONFIG, trajectory=f"line_{'xy'[axis]}", radius=2.0, place=(0.2, -0.3), height=1.0)
    )[0]
    motion = trajectory.motion(np.linspace(10.0, 30.0, 2000))
    middle = [0.2, -0.3, 1.0]
    assert motion.p[:, axis].min() == pytest.approx(
        middle[axis] - 2.0, abs=0.3
    )  # the turns are smooth
    assert motion.p[:, axis].max() == pytest.approx(middle[axis] + 2.0, abs=0.3)
    aside = np.delete(motion.p - middle, axis, axis=1)
    assert np.abs(aside).max() < 1e-6
    assert np.median(np.abs(motion.v[:, axis])) == pytest.approx(1.2, abs=1e-3)
    assert (np.diff(np.sign(motion.v[:, axis])) != 0).sum() >= 4


def test_sines_are_seeded_fill_the_room_and_keep_the_mean_speed():
    paths = []
    for seed in (1, 1, 2):
        trajectory, config, room = fly(
            replace(CONFIG, seed=seed, duration=200.0, start_in_air=True)
        )
        motion = trajectory.motion(np.linspace(0.0, 200.0, 4000))
        paths.append(motion.p)
        low, high = room.path_box
        assert (motion.p > low - 1e-6).all() and (motion.p < high + 1e-6).all()
        assert (np.ptp(motion.p, axis=0) > 0.5 * (high - low)).all()
        assert np.sqrt(np.mean(np.sum(motion.v**2, axis=1))) == pytest.approx(1.2, rel=0.2)
    np.testing.assert_array_equal(paths[0], paths[1])
    assert np.abs(paths[0] - paths[2]).max() > 0.5


def test_yaw_along_track_follows_the_velocity():
    trajectory = fly(replace(CONFIG, trajectory="circle", yaw="along_track"))[0]
    motion = trajectory.motion(np.linspace(12.0, 28.0, 200))
    forward = Rotation.from_quat(motion.q).apply([1.0, 0.0, 0.0])[:, :2]
    track = motion.v[:, :2] / np.linalg.norm(motion.v[:, :2], axis=1, keepdims=True)
    assert np.sum(forward * track, axis=1).min() > 0.99


def test_spin_turns_on_the_spot():
    trajectory = fly(replace(CONFIG, trajectory="spin", yaw_rate=0.7))[0]
    motion = trajectory.motion(np.linspace(12.0, 28.0, 200))
    np.testing.assert_allclose(motion.body_rates, np.tile([0.0, 0.0, 0.7], (200, 1)), atol=1e-3)
    np.testing.assert_allclose(np.ptp(motion.p, axis=0), 0.0, atol=1e-6)


ON_FOOT_OR_WHEELS = [name for name in VEHICLE_DEFAULTS if name != "quadrotor"]
SQUARE = ((-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5))


def moved(config):
    filled, room = config.complete()
    return VEHICLES[filled.vehicle](filled, room, filled.random("trajectory"))


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(ON_FOOT_OR_WHEELS),
    st.sampled_from(list(TRAJECTORIES)),
    st.integers(0, 2**32 - 1),
    st.floats(0.2, 1.0),
)
def test_rates_and_forces_are_those_of_the_motion(vehicle, trajectory, seed, speed):
    motion = moved(
        SimulationConfig.of(vehicle, trajectory=trajectory, seed=seed, speed=speed, duration=40.0)
    ).motion
    t, h = np.linspace(0.1, 39.9, 2003), 1e-3
    before, here, after = (motion(t + k * h) for k in (-1, 0, 1))
    np.testing.assert_allclose((after.p - before.p) / (2 * h), here.v, atol=1e-4)
    # of a cubic; its second derivative has corners
    np.testing.assert_allclose((after.v - before.v) / (2 * h), here.a, atol=2e-2)
    turned = (Rotation.from_quat(before.q).inv() * Rotation.from_quat(after.q)).as_rotvec() / (
        2 * h
    )
    np.testing.assert_allclose(turned, here.body_rates, atol=2e-3)
    np.testing.assert_allclose(
        Rotation.from_quat(here.q).apply(here.specific_force),
        here.a + [0.0, 0.0, GRAVITY],
        atol=1e-9,
    )


def test_a_rover_drives_ahead_on_the_floor_and_stops():
    flight = simulate(SimulationConfig.of("rover", seed=3, duration=90.0))
    velocity = np.column_stack([flight.extra["state_truth"][f"v{axis}"] for axis in "xyz"])
    body = Rotation.from_quat(flight.truth.q).inv().apply(velocity)
    np.testing.assert_allclose(body[:, 1:], 0.0, atol=1e-12)
    assert body[:, 0].min() >= 0.0 and 0.4 < body[:, 0].max() < 1.3
    np.testing.assert_array_equal(flight.truth.p[:, 2], 0.0)
    still = (body[:, 0] == 0.0) & (flight.truth.t > 4.0) & (flight.truth.t < 86.0)
    assert 0.05 < still.mean() < 0.5
    assert (np.ptp(flight.truth.p[:, :2], axis=0) > [5.0, 3.0]).all()
    assert [len(stream) for stream in (flight.imu, flight.velocity)] == [9000, 4500] and 8500 < len(
        flight.tdoa
    ) < 9500


def test_wheels_say_too_much_and_slip():
    config = SimulationConfig.of("rover", seed=3, velocity_noise=0.0)
    flight = simulate(config)
    motion = moved(config).motion(flight.velocity.t)
    true = Rotation.from_quat(motion.q).inv().apply(motion.v)[:, 0]
    ratio = flight.velocity.v[true > 0.1, 0] / true[true > 0.1]
    slips = ratio > 1.1
    np.testing.assert_allclose(ratio[~slips], 1.02)
    np.testing.assert_allclose(ratio[slips], 1.02 * 1.2)
    assert 0.01 < slips.mean() < 0.15
    np.testing.assert_array_equal(flight.velocity.v[:, 1:], 0.0)
    standing = true == 0.0
    assert np.std(flight.velocity.yaw_rate[standing]) == pytest.approx(0.02, rel=0.2)
    turn = np.polyfit(motion.body_rates[true > 0.1, 2], flight.velocity.yaw_rate[true > 0.1], 1)[0]
    assert 1.015 < turn < 1.1


def test_a_person_walks_at_the_height_of_a_hand():
    flight = simulate(SimulationConfig.of("hand", seed=1, imu_errors=NO_IMU_ERRORS))
    assert 1.0 < flight.truth.p[:, 2].min() < flight.truth.p[:, 2].max() < 1.2
    assert (
        np.abs(np.linalg.norm(flight.imu.accel, axis=1) - GRAVITY).max() > 1.0
    )  # its steps are measured
    assert flight.velocity is None


@pytest.mark.parametrize("vehicle", VEHICLE_DEFAULTS)
def test_waypoints_are_passed_in_turn(vehicle):
    flight = simulate(SimulationConfig.of(vehicle, path=SQUARE, duration=80.0))
    away = np.linalg.norm(flight.truth.p[:, None, :2] - np.array(SQUARE), axis=2)
    assert (away.min(axis=0) < 0.45).all()
    first = np.argmax(away < 0.5, axis=0)
    assert (np.diff(first) > 0).all()
    assert flight.name.endswith(
        "path-tdoa3-six_wide-0" if vehicle == "rover" else "path-tdoa2-corners-0"
    )


def test_waypoints_have_heights():
    flight = simulate(SimulationConfig(path=((-1.0, -1.0, 0.6), (1.0, 1.0, 2.4)), duration=40.0))
    assert np.ptp(flight.truth.p[(flight.truth.t > 8.0) & (flight.truth.t < 32.0), 2]) > 1.3


def test_timed_poses_are_flown_as_they_are():
    t = np.arange(0.0, 10.01, 0.1)
    going = 5.0 * (1.0 - np.cos(0.1 * np.pi * t))  # from rest to rest
    p = np.column_stack([np.sin(0.5 * going), np.cos(0.5 * going), 1.0 + 0.05 * going])
    turned = 0.3 * going
    poses = tuple(map(tuple, np.column_stack([t + 7.0, p, turned])))
    truth = simulate(SimulationConfig(poses=poses, duration=10.0, start_in_air=True)).truth
    places = np.column_stack([np.interp(truth.t, t, axis) for axis in p.T])
    assert np.abs(truth.p - places).max() < 0.01
    yaw = np.unwrap(Rotation.from_quat(truth.q).as_euler("ZYX")[:, 0])
    assert np.abs(yaw - np.interp(truth.t, t, turned)).max() < 0.02
    whole = simulate(SimulationConfig(poses=poses, duration=30.0)).truth
    away = np.linalg.norm(whole.p[:, None] - p[[0, 50, 100]], axis=2).min(axis=0)
    assert (away < 0.1).all() and whole.p[-1, 2] < 0.1  # it lands at the end


@pytest.mark.parametrize("vehicle", VEHICLE_DEFAULTS)
def test_a_trajectory_lies_in_its_area_even_beside_the_anchors(vehicle):
    area = ((-8.0, -3.0), (-5.0, 3.0))
    flight = simulate(SimulationConfig.of(vehicle, area=area, duration=60.0, speed=0.5))
    low, high = flight.truth.p[:, :2].min(axis=0), flight.truth.p[:, :2].max(axis=0)
    assert (low > np.subtract(area[0], 0.3)).all() and (high < np.add(area[1], 0.3)).all()
    assert (high - low > [1.0, 2.0]).all()


def test_what_is_given_counts_more_than_what_is_usual(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        simulation, "simulate", lambda config: made.append(config) or simulate(config)
    )
    given = ["--path", "-2,-1 2,1", "--tdoa-rate", "50", "--tag-lever-arm", "0,0,0.2"]
    assert command.main(["--vehicle", "rover", "--duration", "12", *given]) == 0
    assert command.main(["--duration", "20", "--area", "-1,-1 1,1"]) == 0
    rover, quadrotor = made
    changes = {
        "path": ((-2.0, -1.0), (2.0, 1.0)),
        "tdoa_rate": 50.0,
        "tag_lever_arm": (0.0, 0.0, 0.2),
    }
    assert rover == SimulationConfig.of("rover", duration=12.0, **changes)
    assert quadrotor == SimulationConfig(duration=20.0, area=((-1.0, -1.0), (1.0, 1.0)))


def test_points_that_are_none_are_told(capsys):
    assert command.main(["--path", "0,0 1;1"]) == 2
    assert "is not X,Y" in capsys.readouterr().err
