from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.simulation import SimulationConfig
from uwb_tdoa_tools.simulation.paths import TRAJECTORIES
from uwb_tdoa_tools.simulation.vehicles import GRAVITY, Trajectory

CONFIG = SimulationConfig(duration=40.0, speed=1.2)
YAWS = {"circle": "along_track", "sines": "along_track", "square": "rotating"}


def fly(config):
    filled, room = config.complete()
    return Trajectory(filled, room, filled.random("trajectory")), filled, room


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
    """Dead reckoning from exact samples, trapezoidal, over 10 s: millimetres."""
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


def test_square_keeps_its_speed_on_the_edges_and_slows_in_the_corners():
    trajectory, config, room = fly(replace(CONFIG, trajectory="square", radius=2.0))
    motion = trajectory.motion(np.linspace(10.0, 30.0, 2000))
    on_edge = np.min(np.abs(motion.v[:, :2]), axis=1) < 1e-3
    assert on_edge.mean() > 0.5
    np.testing.assert_allclose(np.linalg.norm(motion.v[on_edge], axis=1), 1.2, atol=2e-3)
    assert np.abs(motion.p[:, :2]).max() == pytest.approx(2.0, abs=1e-3)
    assert 1.0 < np.linalg.norm(motion.a, axis=1).max() < 4.0


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
        low, high = room.flyable
        assert (motion.p > low - 1e-6).all() and (motion.p < high + 1e-6).all()
        assert (np.ptp(motion.p, axis=0) > 0.5 * (high - low)).all()
        assert np.sqrt(np.mean(np.sum(motion.v**2, axis=1))) == pytest.approx(1.2, rel=0.2)
    np.testing.assert_array_equal(paths[0], paths[1])
    assert np.abs(paths[0] - paths[2]).max() > 0.5


def test_rising_circle_rises():
    trajectory = fly(replace(CONFIG, trajectory="rising_circle"))[0]
    z = trajectory.motion(np.linspace(10.0, 30.0, 500)).p[:, 2]
    assert np.ptp(z) == pytest.approx(1.2, abs=0.02)


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


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"duration": 10.0}, "duration"),
        ({"trajectory": "circle", "radius": 20.0}, "trajectory"),
        ({"trajectory": "hover", "height": 5.0}, "trajectory"),
        ({"trajectory": "circle", "radius": 0.5, "speed": 5.0}, "speed"),
    ],
)
def test_flights_that_do_not_fit_are_refused(change, field):
    with pytest.raises(InputError, match=f"^{field}: "):
        fly(replace(CONFIG, **change))
