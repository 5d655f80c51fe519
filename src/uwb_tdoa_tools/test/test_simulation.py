# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated flights: the command, configurations, rooms and inertial sensors."""

from dataclasses import replace
import json

from hypothesis import given, settings, strategies as st
import numpy as np
from programs import python
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors.pressure import altitude_of
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.commands import simulate as command
from uwb_tdoa_tools.simulation import NO_IMU_ERRORS, ImuErrors, SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import (
    CONSTELLATIONS,
    PROTOCOLS,
    YAW_PROFILES,
    Walls,
    constellation,
    heard_at,
    room_of,
)
from uwb_tdoa_tools.simulation.vehicles import TRAJECTORIES

# --- simulate ---


SHORT = ["--duration", "20", "--trajectory", "circle"]
ACROSS = Walls(((4.0, -10.0, 4.0, 2.0, np.inf),))


def test_writes_bag_and_json(tmp_path, capsys):
    bag, report = tmp_path / "flight.bag", tmp_path / "flight.json"
    assert command.main([*SHORT, "--out", str(bag), "--json", str(report)]) == 0
    assert (bag / "metadata.yaml").is_file()
    content = json.loads(report.read_text())
    assert content["imu_samples"] == 20_000 and content["config"]["trajectory"] == "circle"
    assert str(bag) in capsys.readouterr().out


def test_an_existing_bag_is_kept_unless_forced(tmp_path, capsys):
    bag = tmp_path / "flight.bag"
    assert command.main([*SHORT, "--out", str(bag)]) == 0
    before = {path: path.read_bytes() for path in bag.iterdir()}
    assert command.main([*SHORT, "--seed", "1", "--out", str(bag)]) == 2
    assert {path: path.read_bytes() for path in bag.iterdir()} == before
    assert "simulate: error: " in capsys.readouterr().err
    assert command.main([*SHORT, "--seed", "1", "--out", str(bag), "--force"]) == 0
    assert {path: path.read_bytes() for path in bag.iterdir()} != before


def test_options_reach_the_configuration(tmp_path):
    report, anchors = tmp_path / "r.json", tmp_path / "a.yaml"
    SimulationConfig().complete()[0].anchors.to_yaml(anchors)
    options = (
        "--protocol tdoa3 --seed 4 --noise 0.02 --shared-noise --no-bias --no-outliers "
        "--no-multipath"
    )
    options += " --perfect-imu --yaw rotating --height 1.1 --speed 0.8 --start-in-air"
    options += " --height-noise 0.02 --pressure-noise 0.3 --velocity-noise 0.1"
    options += f" --anchors {anchors} --json {report}"
    assert command.main([*SHORT, *options.split()]) == 0
    content = json.loads(report.read_text())
    config = content["config"]
    assert {
        k: config[k]
        for k in ("protocol", "seed", "noise_std", "shared_noise", "bias", "multipath", "yaw")
    } == {
        "protocol": "tdoa3",
        "seed": 4,
        "noise_std": 0.02,
        "shared_noise": True,
        "bias": False,
        "multipath": False,
        "yaw": "rotating",
    }
    assert (config["height"], config["speed"], config["outlier_probability"]) == (1.1, 0.8, 0.0)
    assert [config[f"{stream}_noise"] for stream in ("height", "pressure", "velocity")] == [
        0.02,
        0.3,
        0.1,
    ]
    assert config["start_in_air"] and content["parameters"]["take_off"] is None
    assert set(config["imu_errors"].values()) == {0.0}
    assert content["bias_std"] == content["multipath_std"] == content["outliers"] == 0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--duration", "3"], "duration: 3 s"),
        (["--constellation", "nowhere"], "constellation: 'nowhere'"),
        (["--speed", "nan"], "speed: nan"),
        (["--anchors", "missing.yaml"], "missing.yaml"),
        (["--json", "no/such/place.json"], "no/such/place.json"),
        (["--trajectory", "loop"], "invalid choice: 'loop'"),
        (["--constellation", "six", "--anchors", "a.yaml"], "not allowed with"),
    ],
)
def test_bad_input_is_told_in_one_sentence(options, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command.main([*options, "--out", "flight.bag"]) == 2
    err = capsys.readouterr().err
    assert says in err and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


# --- simulation ---


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
    except InputError as error:  # the only two valid reasons among these configurations
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
    meta = json.loads(json.dumps(flight.meta))
    assert meta["protocol"] == "tdoa3" and meta["source"] == "simulation"
    assert meta["config"]["imu_errors"]["gyro_noise"] == SimulationConfig().imu_errors.gyro_noise
    assert meta["parameters"]["take_off"] == 3.0 and meta["parameters"]["landing"] == 57.0
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


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"trajectory": "loop"}, "trajectory"),
        ({"trajectory": "circle", "radius": 20.0}, "trajectory"),
        ({"trajectory": "hover", "height": 5.0}, "trajectory"),
        ({"trajectory": "circle", "radius": 0.5, "speed": 5.0}, "speed"),
        ({"vehicle": "submarine"}, "vehicle"),
        ({"path": ((0.0, 0.0),)}, "path"),
        ({"path": ((0.0, 0.0), (1.0, float("nan")))}, "path"),
        ({"path": ((0.0, 0.0), (1.0, 1.0, 1.0))}, "path"),
        ({"poses": ((0.0, 0.0, 0.0, 1.0, 0.0),)}, "poses"),
        ({"poses": ((1.0, 0.0, 0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 1.0, 0.0))}, "poses"),
        ({"area": ((1.0, 0.0), (0.0, 1.0))}, "area"),
        ({"protocol": "tdoa4"}, "protocol"),
        ({"tdoa_rate": 0.0}, "tdoa_rate"),
        ({"yaw": "wild"}, "yaw"),
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"duration": float("nan")}, "duration"),
        ({"duration": 10.0}, "duration"),
        ({"vehicle": "rover", "duration": 5.0}, "duration"),
        ({"vehicle": "hand", "duration": 5.0}, "duration"),
        ({"noise_std": -0.1}, "noise_std"),
        ({"outlier_probability": 1.5}, "outlier_probability"),
        ({"wheel_slip": -1.0}, "wheel_slip"),
        ({"place": (1.0, 2.0, 3.0)}, "place"),
        ({"tag_lever_arm": (0.0, float("inf"), 0.0)}, "tag_lever_arm"),
        ({"anchor_noise_std": (0.1, 0.1)}, "anchor_noise_std"),
        ({"constellation": "nowhere"}, "constellation"),
        ({"constellation": "random-x"}, "constellation"),
        ({"constellation": "random-1-3"}, "constellation"),
        ({"constellation": "random-1-65"}, "constellation"),
        ({"anchors": Anchors.from_positions(np.eye(3) * 4.0)}, "anchors"),
        ({"anchors": Anchors.from_positions(np.eye(3)[:1]), "bias": False}, "anchors"),
        ({"walls": ACROSS}, "walls"),
        ({"cell_ids": 256}, "cell_ids"),
        ({"cell_ids": 1, "radio_reach": 9.0}, "cell_ids"),
    ],
)
def test_what_cannot_be_is_refused_by_name(change, field):
    with pytest.raises(InputError, match=f"^{field}: "):
        simulate(SimulationConfig.of(**{"vehicle": "quadrotor", **change}))


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
    # every part has its own random stream
    np.testing.assert_array_equal(noisy.tdoa.d, plain.tdoa.d)


# --- simulation rooms ---


NAMES = [*CONSTELLATIONS, "random-5", "random-1-4", "random-2-64"]


@pytest.mark.parametrize("name", NAMES)
def test_is_a_usable_constellation_that_faces_the_middle(name):
    anchors = constellation(name)
    assert (4 <= len(anchors) <= 64) or name == "pair"
    gaps = np.linalg.norm(anchors.positions[:, None] - anchors.positions, axis=2)[
        np.triu_indices(len(anchors), 1)
    ]
    assert gaps.min() > 0.4
    front = Rotation.from_quat(anchors.orientations).apply([1.0, 0.0, 0.0])
    inwards = -(anchors.positions - anchors.positions.mean(axis=0))
    assert (np.sum(front[:, :2] * inwards[:, :2], axis=1) > 0.0).all()
    low, high = room_of(anchors).path_box
    assert (high - low > 1.0).all()


def test_random_is_seeded():
    one, same, other = (
        constellation("random-7-12"),
        constellation("random-7-12"),
        constellation("random-8-12"),
    )
    assert len(one) == 12
    np.testing.assert_array_equal(one.orientations, same.orientations)
    assert np.abs(one.positions - other.positions).max() > 0.1


SHELF = Walls(((4.0, -10.0, 4.0, 20.0, 3.0),))


def hall_of_cells():
    """Return 32 Anchors in 28 x 14 m. Ids are 256 times the number of a cell, plus 0 ... 15.

    Each cell holds 16 anchors.
    """
    x, y = np.meshgrid(np.arange(8) * 4.0, np.arange(4) * 14.0 / 3.0)
    positions = np.column_stack([x.ravel(), y.ravel(), np.tile([0.5, 3.0, 5.5, 4.0], 8)])
    right = positions[:, 0] > 14.0
    ids = np.where(right, 256, 0) + np.where(right, np.cumsum(right), np.cumsum(~right)) - 1
    return Anchors.from_positions(positions, ids)


def flown(**kind):
    config = SimulationConfig(
        anchors=hall_of_cells(),
        bias=False,
        protocol="tdoa3",
        duration=20.0,
        start_in_air=True,
        radio_reach=12.0,
        **kind,
    )
    return simulate(config)


@pytest.mark.parametrize(
    "walls, p, q, blocked",
    [
        (ACROSS, (0, 0, 1), (8, 0, 1), True),
        (ACROSS, (0, 6, 1), (8, 6, 1), False),  # past its end
        (ACROSS, (0, 0, 1), (3, 0, 1), False),  # this side of it
        (ACROSS, (5, 0, 1), (8, 0, 1), False),
        (ACROSS, (4, -20, 1), (4, 20, 1), False),  # along it
        (ACROSS, (0, 0, 100), (8, 0, 100), True),
        (SHELF, (0, 0, 1), (8, 0, 4), True),
        (SHELF, (0, 0, 1), (8, 0, 6), False),  # over it
    ],
)
def test_a_wall_stands_between(walls, p, q, blocked):
    for one, other in ((p, q), (q, p)):
        assert walls.between(np.array([one], float), np.array([other], float)).tolist() == [blocked]


def test_nothing_is_heard_through_a_wall(monkeypatch):
    monkeypatch.setattr("uwb_tdoa_tools.simulation.config.AT_ONCE", 100)
    anchors, walls = hall_of_cells(), Walls(((15.0, -1.0, 15.0, 20.0, np.inf),))
    p = np.random.default_rng(0).uniform((0.0, 0.0, 0.0), (28.0, 14.0, 3.0), (50, 3))
    far = np.linalg.norm(p[:, None] - anchors.positions, axis=2) > 12.0
    behind = (p[:, None, 0] > 15.0) != (anchors.positions[:, 0] > 15.0)
    for rows, blocked in zip(heard_at(p, anchors.positions, 12.0, walls), far | behind):
        np.testing.assert_array_equal(rows, np.flatnonzero(~blocked))


@pytest.mark.parametrize("walls", [None, ACROSS])
def test_no_point_hears_nothing(walls):
    assert heard_at(np.empty((0, 3)), np.eye(3), 12.0, walls) == []


def test_a_flight_hears_nothing_through_walls():
    walls = Walls(((14.0, -1.0, 14.0, 20.0, np.inf),))
    flight = flown(walls=walls)
    place = np.column_stack(
        [np.interp(flight.tdoa.t, flight.truth.t, column) for column in flight.truth.p.T]
    )
    for ids in (flight.tdoa.a, flight.tdoa.b):
        assert not walls.between(place, flight.anchors.positions[flight.anchors.index(ids)]).any()
    assert np.ptp(place[:, 0]) > 5.0 and flight.meta["config"]["walls"] == [
        [14.0, -1.0, 14.0, 20.0]
    ]
    assert walls.between(
        place, flown().anchors.positions[flown().anchors.index(flown().tdoa.a[: len(place)])]
    ).any()


def test_cells_that_use_the_same_ids_have_clocks_of_their_own():
    flight = flown(cell_ids=256)
    assert set(flight.anchors.ids % 256) == set(range(16))
    np.testing.assert_array_equal(flight.tdoa.a // 256, flight.tdoa.b // 256)
    assert set(flight.tdoa.a // 256) == {0, 1}
    assert (flown().tdoa.a // 256 != flown().tdoa.b // 256).any()


def test_a_tag_among_cells_is_found():
    flight = flown(cell_ids=256)
    odometry = run_offline(flight).odometry
    place = np.column_stack(
        [np.interp(odometry.t, flight.truth.t, column) for column in flight.truth.p.T]
    )
    assert np.linalg.norm(odometry.p - place, axis=1)[odometry.t > 5.0].max() < 0.5


@pytest.mark.parametrize(
    "text, wrong",
    [
        ("walls: []", "no list 'walls'"),
        ("[1, 2]", "no list 'walls'"),
        ("walls: [[0, 0, 1]]", "number 1 is"),
        ("walls: [[0, 0, 1, 1], [2, 2, 2, 2]]", "number 2 is"),
        ("walls: [[0, 0, x, 1]]", "number 1 is"),
    ],
)
def test_what_is_no_wall_is_refused(tmp_path, text, wrong):
    (tmp_path / "walls.yaml").write_text(text)
    with pytest.raises(InputError, match=wrong):
        Walls.from_yaml(tmp_path / "walls.yaml")


def test_walls_of_a_file(tmp_path):
    (tmp_path / "walls.yaml").write_text("walls:\n- [0, 1, 2.5, 3]\n- [0, 1, 2, 3, 4]\n")
    assert Walls.from_yaml(tmp_path / "walls.yaml").segments == (
        (0.0, 1.0, 2.5, 3.0, np.inf),
        (0.0, 1.0, 2.0, 3.0, 4.0),
    )


# --- simulation sensors ---


CONFIG = SimulationConfig(trajectory="hover", duration=30.0)


def errors_of(imu_errors, **change):
    """Return the errors of both sensors, (gyro (n, 3), accel (n, 3)), and the flight."""
    config = replace(CONFIG, imu_errors=imu_errors, **change)
    flight, exact = (
        simulate(config),
        simulate(replace(config, imu_errors=NO_IMU_ERRORS)),
    )
    return flight.imu.gyro - exact.imu.gyro, flight.imu.accel - exact.imu.accel, flight


@pytest.mark.parametrize("rate", [1000.0, 250.0])
def test_white_noise_has_the_density_whatever_the_rate(rate):
    gyro, accel, _ = errors_of(
        replace(NO_IMU_ERRORS, gyro_noise=3e-4, accel_noise=2e-3), imu_rate=rate
    )
    assert gyro.std() == pytest.approx(3e-4 * np.sqrt(rate), rel=0.02)
    assert accel.std() == pytest.approx(2e-3 * np.sqrt(rate), rel=0.02)
    flat = (gyro / gyro.std()).ravel()
    assert abs(np.mean(flat[1:] * flat[:-1])) < 0.02


def test_bias_walks_as_configured():
    gyro, accel, flight = errors_of(
        replace(NO_IMU_ERRORS, gyro_bias_walk=1e-3, accel_bias_walk=1e-2)
    )
    assert np.diff(gyro, axis=0).std() == pytest.approx(1e-3 * np.sqrt(1e-3), rel=0.02)
    assert np.diff(accel, axis=0).std() == pytest.approx(1e-2 * np.sqrt(1e-3), rel=0.02)
    state = flight.extra["state_truth"]
    at = np.searchsorted(flight.imu.t, state["t"] + 1e-9) - 1
    np.testing.assert_allclose(state["gyro_bias_y"], gyro[at, 1], atol=1e-12)
    np.testing.assert_allclose(state["accel_bias_z"], accel[at, 2], atol=1e-12)


def test_initial_bias_has_the_configured_spread():
    only_bias = replace(NO_IMU_ERRORS, gyro_bias=0.01, accel_bias=0.1)
    start = [errors_of(only_bias, seed=k, duration=1.0, start_in_air=True)[:2] for k in range(20)]
    for values, spread in zip(zip(*start), (0.01, 0.1)):
        # constant over each flight
        np.testing.assert_allclose(np.ptp(values, axis=1), 0.0, atol=1e-12)
        assert np.std([v[0] for v in values]) == pytest.approx(spread, rel=0.3)


def test_vibration_only_while_the_motors_turn():
    gyro, accel, flight = errors_of(replace(NO_IMU_ERRORS, vibration=2.0))
    # half a second before take-off and after landing
    flying = (flight.imu.t >= 2.5) & (flight.imu.t <= 27.5)
    assert accel[flying].std() == pytest.approx(2.0, rel=0.02)
    np.testing.assert_array_equal(accel[~flying], 0.0)
    np.testing.assert_array_equal(gyro, 0.0)


def test_bad_values_are_refused():
    with pytest.raises(InputError, match="gyro_noise"):
        ImuErrors(gyro_noise=-1.0)
    with pytest.raises(InputError, match="vibration"):
        ImuErrors(vibration=np.nan)


REGISTERED = """
from dataclasses import fields, replace
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.common.sensors.sensor import parameter
use = {"use_side_sonar": parameter(True, "use it", fixed=True)}
SENSORS["side_sonar"] = replace(SENSORS["pressure"], name="side_sonar", parameters=use)
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.bags.messages import topics_of
from uwb_tdoa_tools.simulation import SimulationConfig
from uwb_tdoa_tools.commands.simulate import OPTIONS, config_of
names = [{each.name for each in fields(kind)} for kind in (Flight, FilterConfig, SimulationConfig)]
assert "side_sonar" in names[0] and "use_side_sonar" in names[1]
assert "side_sonar_noise" in names[2]
assert topics_of("side_sonar") == (("side_sonar", "sensor_msgs/msg/FluidPressure"),)
parser = cli.parser("simulate", "Simulate.", options=OPTIONS)
assert config_of(parser.parse_args(["--side-sonar-noise", "0.1"])).side_sonar_noise == 0.1
"""


def test_the_registry_alone_adds_a_sensor_to_recordings_parameters_simulation_and_bags():
    """It runs in another process, because importers of the registry derive their fields from it."""
    done = python("-c", REGISTERED)
    assert done.returncode == 0, done.stderr
