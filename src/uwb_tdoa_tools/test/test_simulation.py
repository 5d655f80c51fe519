import json
import time

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors.pressure import altitude_of
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import PROTOCOLS, YAW_PROFILES
from uwb_tdoa_tools.simulation.paths import TRAJECTORIES
from uwb_tdoa_tools.simulation.rooms import CONSTELLATIONS, room_of

configs = st.builds(
    SimulationConfig,
    seed=st.integers(0, 2**32 - 1),
    constellation=st.sampled_from([*CONSTELLATIONS, "random-3", "random-4-4", "random-5-64"]),
    trajectory=st.sampled_from(list(TRAJECTORIES)),
    duration=st.floats(16.0, 22.0),
    speed=st.floats(0.05, 1.5),
    yaw=st.sampled_from(YAW_PROFILES),
    yaw_angle=st.floats(-4.0, 4.0),
    floor_time=st.floats(0.0, 2.0),
    start_in_air=st.booleans(),
    imu_rate=st.sampled_from([100.0, 250.0]),
    protocol=st.sampled_from(PROTOCOLS),
    shared_noise=st.booleans(),
    bias=st.booleans(),
    tag_unit=st.integers(0, 9),
    multipath=st.booleans(),
)


@settings(max_examples=40, deadline=None)
@given(configs)
def test_any_config_gives_a_sound_flight(config):
    try:
        flight = simulate(config)
    except InputError as error:  # the only two honest reasons among these configurations
        assert str(error).startswith(("speed: ", "duration: "))
        return
    for stream in (flight.tdoa, flight.imu, flight.truth):
        assert all(np.isfinite(column).all() for column in vars(stream).values())
        assert len({len(column) for column in vars(stream).values()}) == 1
        assert (
            (np.diff(stream.t) > 0.0).all()
            and stream.t[0] > 0.0
            and stream.t[-1] <= config.duration + 1e-9
        )
    for columns in flight.extra.values():
        assert all(np.isfinite(column).all() for column in columns.values())
    room = room_of(flight.anchors)
    assert (flight.truth.p >= room.lower).all() and (flight.truth.p <= room.upper).all()
    np.testing.assert_allclose(np.linalg.norm(flight.truth.q, axis=1), 1.0, atol=1e-12)
    assert (np.sum(flight.truth.q[1:] * flight.truth.q[:-1], axis=1) > 0.9).all()
    assert set(flight.tdoa.a) | set(flight.tdoa.b) <= set(flight.anchors.ids)


def test_same_seed_same_flight_other_seed_other_flight():
    one, same, other = (simulate(SimulationConfig(seed=seed, duration=20.0)) for seed in (5, 5, 6))
    for stream in ("tdoa", "imu", "truth"):
        for name, values in vars(getattr(one, stream)).items():
            np.testing.assert_array_equal(values, getattr(getattr(same, stream), name))
    for name in ("bias", "multipath", "noise", "outlier"):
        np.testing.assert_array_equal(one.extra["tdoa_truth"][name], same.extra["tdoa_truth"][name])
    assert one.tdoa.d[0] != other.tdoa.d[0]
    assert np.abs(one.imu.gyro[:1000] - other.imu.gyro[:1000]).max() > 1e-3
    assert np.abs(one.truth.p[:1000] - other.truth.p[:1000]).max() > 0.1


def test_rates_and_names():
    flight = simulate(SimulationConfig(protocol="tdoa3", trajectory="square", seed=9))
    assert flight.name == "sim-square-tdoa3-corners-9"
    assert (
        len(flight.imu) == 60_000
        and len(flight.truth) == 15_000
        and 12_000 < len(flight.tdoa) < 16_200
    )
    assert np.diff(flight.imu.t) == pytest.approx(1e-3)
    assert flight.meta["protocol"] == "tdoa3" and flight.meta["source"] == "simulation"


def test_meta_is_plain_and_tells_the_whole_configuration():
    flight = simulate(SimulationConfig(duration=20.0, noise_std=0.07))
    meta = json.loads(json.dumps(flight.meta))
    assert meta["config"]["noise_std"] == 0.07
    assert meta["config"]["imu_errors"]["gyro_noise"] == SimulationConfig().imu_errors.gyro_noise
    assert meta["parameters"]["take_off"] == 3.0 and meta["parameters"]["landing"] == 17.0
    assert sorted(meta["parameters"]["anchor_delays"]) == [str(k) for k in range(8)]


def test_own_anchors_keep_their_ids():
    corners = SimulationConfig().complete()[0].anchors
    mine = Anchors(corners.ids + 40, corners.positions + [10.0, -5.0, 0.0], corners.orientations)
    flight = simulate(SimulationConfig(anchors=mine, duration=20.0))
    assert flight.anchors is mine and set(flight.tdoa.a) == set(range(40, 48))
    np.testing.assert_allclose(flight.truth.p[:, :2].mean(axis=0), [10.0, -5.0], atol=2.0)
    assert flight.name.endswith("-anchors-0")


def test_state_truth_is_the_velocity():
    flight = simulate(SimulationConfig(trajectory="circle", duration=20.0))
    state = flight.extra["state_truth"]
    np.testing.assert_array_equal(state["t"], flight.truth.t)
    v = np.gradient(flight.truth.p, flight.truth.t, axis=0)
    np.testing.assert_allclose(
        np.column_stack([state["vx"], state["vy"], state["vz"]])[1:-1], v[1:-1], atol=1e-3
    )


def test_a_minute_takes_no_time():
    simulate(SimulationConfig(duration=20.0))
    start = time.process_time()
    simulate(SimulationConfig(constellation="random-1-64"))
    assert time.process_time() - start < 1.5


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"trajectory": "loop"}, "trajectory"),
        ({"protocol": "tdoa4"}, "protocol"),
        ({"yaw": "wild"}, "yaw"),
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"duration": float("nan")}, "duration"),
        ({"noise_std": -0.1}, "noise_std"),
        ({"outlier_probability": 1.5}, "outlier_probability"),
        ({"place": (1.0, 2.0, 3.0)}, "place"),
        ({"tag_lever_arm": (0.0, float("inf"), 0.0)}, "tag_lever_arm"),
        ({"anchor_noise_std": (0.1, 0.1)}, "anchor_noise_std"),
        ({"constellation": "nowhere"}, "constellation"),
        ({"anchors": Anchors.from_positions(np.eye(3) * 4.0)}, "anchors"),
        ({"anchors": Anchors.from_positions(np.eye(3)[:1]), "bias": False}, "anchors"),
    ],
)
def test_bad_values_are_refused_by_name(change, field):
    with pytest.raises(InputError, match=f"^{field}: "):
        simulate(SimulationConfig(**change))


def test_anchors_without_orientation_do_without_bias():
    anchors = Anchors.from_positions(SimulationConfig().complete()[0].anchors.positions)
    flight = simulate(SimulationConfig(anchors=anchors, bias=False, duration=20.0))
    np.testing.assert_array_equal(flight.extra["tdoa_truth"]["bias"], 0.0)


def test_height_pressure_and_velocity_are_true_without_noise_and_noisy_as_told():
    exact = simulate(
        SimulationConfig(duration=20.0, height_noise=0.0, pressure_noise=0.0, velocity_noise=0.0)
    )
    config = SimulationConfig(
        duration=20.0, height_noise=0.02, pressure_noise=0.1, velocity_noise=0.05
    )
    noisy, plain = simulate(config), simulate(SimulationConfig(duration=20.0))
    at = np.searchsorted(exact.truth.t, exact.height.t)
    turn = Rotation.from_quat(exact.truth.q[at])
    np.testing.assert_allclose(exact.truth.t[at], exact.height.t, atol=1e-9)
    np.testing.assert_allclose(
        exact.height.range * turn.as_matrix()[:, 2, 2], exact.truth.p[at, 2], atol=1e-9
    )
    np.testing.assert_allclose(
        altitude_of(exact.pressure.pressure) - 200.0, exact.truth.p[at, 2], atol=1e-6
    )
    state = exact.extra["state_truth"]
    v = np.stack([state[name][at] for name in ("vx", "vy", "vz")], axis=1)
    np.testing.assert_allclose(turn.apply(exact.velocity.v), v, atol=1e-9)
    air = exact.truth.p[at, 2] > 0.3
    assert np.std((noisy.height.range - exact.height.range)[air]) == pytest.approx(0.02, rel=0.15)
    assert np.std(noisy.velocity.v - exact.velocity.v) == pytest.approx(0.05, rel=0.1)
    assert (noisy.velocity.std == 0.05).all() and (exact.velocity.std > 0.0).all()
    assert plain.height is None and plain.pressure is None and plain.velocity is None
    # every part draws from its own stream
    np.testing.assert_array_equal(noisy.tdoa.d, plain.tdoa.d)
