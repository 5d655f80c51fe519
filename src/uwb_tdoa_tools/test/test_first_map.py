# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""First maps of unknown anchors: accepted maps are correct, and open questions are named."""

from dataclasses import replace
import json
import shlex

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import localize
from uwb_tdoa_tools.commands.map_anchors import main
from uwb_tdoa_tools.first_map import map_anchors, observe
from uwb_tdoa_tools.first_map.least_squares import Equations, Fit, Problem, rigid_distance
from uwb_tdoa_tools.first_map.observations import STEP, G, _Level
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.surveying.report import read_coordinates

CERTAIN = 4.0  # standard deviations, limit of the coordinate errors of an accepted map


def flown(seed=7, **config):
    values = {"constellation": "random-77-7", "duration": 40.0, "imu_rate": 200.0, **config}
    return simulate(SimulationConfig.of("quadrotor", seed=seed, **values))


@pytest.fixture(scope="module")
def flight():
    return flown()


def apart(positions):
    """Return the rows of the two anchors that are farthest apart, seen from above."""
    distance = np.linalg.norm((positions[:, None] - positions)[:, :, :2], axis=2)
    return np.unravel_index(np.argmax(distance), distance.shape)


def of_rows(positions, rows, axes=(0, 1, 2), std=0.01):
    return [(row, axis, positions[row, axis], std) for row in rows for axis in axes]


def seen_of(flights, *coordinates):
    true = flights[0].anchors
    rows = np.array([*of_rows(true.positions, apart(true.positions)), *coordinates])
    return replace(observe(flights, true.ids), coordinates=rows)


def measured(positions, *coordinates, std=0.02, noise=0.0, drop=()):
    """Return observations of all distances between anchors except `drop`."""
    rng = np.random.default_rng(3)
    rows = [
        (a, b, np.linalg.norm(positions[a] - positions[b]) + noise * rng.standard_normal(), std)
        for a in range(len(positions))
        for b in range(a)
        if (a, b) not in drop
    ]
    known = [*of_rows(positions, apart(positions)), *coordinates]
    empty = observe([], np.arange(len(positions)))
    return replace(empty, distances=np.array(rows), coordinates=np.array(known))


def side_of(positions):
    """Return the heights of all anchors, and a rough position of one anchor.

    This anchor is off the line of the trusted anchors.
    """
    one, other = apart(positions)
    line = positions[other] - positions[one]
    row = int(np.argmax(np.abs((positions - positions[one]) @ [-line[1], line[0], 0.0])))
    heights = of_rows(positions, range(len(positions)), (2,), 0.03)
    return [*heights, *of_rows(positions, [row], (0, 1), 1.0)]


def largest_z(found, true):
    free = ~found.trusted
    return float((np.abs(found.positions - true)[free] / found.std[free]).max())


def room(seed, count=7):
    rng = np.random.default_rng(seed)
    return rng.uniform([-5.0, -4.0, 0.2], [5.0, 4.0, 3.0], (count, 3))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 1000), st.booleans())
def test_rigid_motions_and_reflections_are_told_apart(seed, mirrored):
    points = room(seed)
    turn = Rotation.random(random_state=seed).as_matrix() @ np.diag(
        [1.0, 1.0, -1.0 if mirrored else 1.0]
    )
    moved = points @ turn.T + [1.0, -2.0, 3.0]
    assert rigid_distance(points, moved) < 1e-6
    assert rigid_distance(points, moved, mirrored) < 1e-6
    assert rigid_distance(points, moved, not mirrored) > 0.01


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-3.0, 3.0), st.integers(0, 1000))
def test_levelled_accelerations_are_second_differences_of_positions(roll, pitch, yaw, seed):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 8.0, 0.01)
    size, frequency = rng.uniform(0.1, 0.5, 3), rng.uniform(1.5, 3.0, 3)
    moving = t > 3.0  # the attitude is known from the time at rest before
    since = np.maximum(t - 3.0, 0.0)[:, None]
    swing = -size * frequency**2 * np.sin(frequency * since)
    world = np.where(moving[:, None], swing, 0.0)
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    imu = Imu(t, np.zeros((len(t), 3)), turn.inv().apply(world + [0.0, 0.0, G]))
    level = _Level.of(imu)
    middle = np.arange(4.0, 7.5, STEP)
    at = [np.maximum(middle + shift - 3.0, 0.0)[:, None] for shift in (-STEP, 0.0, STEP)]
    before, here, after = (size * np.sin(frequency * s) - size * frequency * s for s in at)
    expected = (before - 2.0 * here + after) / STEP**2
    accel = level.accelerations(middle)
    np.testing.assert_allclose(accel[:, 2], expected[:, 2], atol=0.35)
    size_of = np.linalg.norm(accel[:, :2], axis=1), np.linalg.norm(expected[:, :2], axis=1)
    np.testing.assert_allclose(*size_of, atol=0.35)


@pytest.mark.parametrize("inertial", [True, False])
def test_gradient_is_that_of_the_cost(flight, inertial):
    seen = seen_of([flight], (0, 2, 1.0, 0.5))
    distances = np.array([(0, 1, 5.0, 0.1), (2, 3, 4.0, 0.1)])
    problem = Problem(replace(seen, distances=distances, delay_std=0.1), inertial)
    rng = np.random.default_rng(0)
    path = rng.uniform(-2.0, 2.0, (problem.bins, 3))
    columns = rng.uniform(-1.0, 1.0, problem.layout.size)
    equations = Equations(Fit(problem, path, columns))
    step = 1e-5
    for column in range(0, problem.layout.size, 3):
        there = np.zeros(len(columns))
        there[column] = step
        ends = [Fit(problem, path, columns + sign * there).cost for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2.0 * step)
        assert equations.gradient[column] == pytest.approx(slope, rel=1e-3, abs=1e-2)
    for row in (0, 5, problem.bins - 1):
        there = np.zeros_like(path)
        there[row, 1] = step
        ends = [Fit(problem, path + sign * there, columns).cost for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2.0 * step)
        # the cost does not include WEAK
        assert equations.path_gradient[3 * row + 1] == pytest.approx(slope, rel=1e-3, abs=1e-2)


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(st.integers(0, 1000))
def test_distances_with_heights_and_a_side_give_the_map_or_a_reason(seed):
    true = room(seed)
    found = map_anchors(measured(true, *side_of(true), noise=0.02))
    assert found.why_not or largest_z(found, true) < CERTAIN


@pytest.mark.slow
def test_distances_alone_leave_the_map_open():
    true = room(1)
    found = map_anchors(measured(true))
    assert "turn about the line" in found.why_not
    mirrored = map_anchors(measured(true, *of_rows(true, range(7), (2,), 0.03)))
    assert "mirror image" in mirrored.why_not
    assert not map_anchors(measured(true, *side_of(true))).why_not


def test_a_wrong_distance_is_rejected_or_named():
    true = room(2, 8)
    seen = measured(true, *side_of(true), noise=0.02)
    distances = seen.distances.copy()
    distances[9, 2] += 2.0
    found = map_anchors(replace(seen, distances=distances))
    assert found.why_not or largest_z(found, true) < CERTAIN


def test_distances_that_nothing_checks_are_refused():
    true = np.array([[0, 0, 0], [8, 0, 0], [0, 6, 0], [6, 5, 3], [2, 3, 3]], float)
    known = [*of_rows(true, [0, 1, 2]), *of_rows(true, [3, 4], (0, 1, 2), 1.0)]
    seen = measured(true, *known, drop={(4, 0)})
    assert "nothing checks the distance" in map_anchors(seen, accuracy=0.8).why_not


def test_a_flight_gives_the_map(flight):
    found = map_anchors(seen_of([flight]))
    true = flight.anchors.positions
    assert not found.why_not
    assert largest_z(found, true) < CERTAIN
    assert np.linalg.norm(found.positions - true, axis=1).max() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trajectory", "why"), [("hover", "the flight hardly moves"), ("line_x", "have a second place")]
)
def test_a_flight_that_shows_too_little_is_refused(trajectory, why):
    assert why in map_anchors(seen_of([flown(trajectory=trajectory, duration=28.0)])).why_not


@pytest.mark.slow
def test_a_faulty_inertial_sensor_is_refused():
    flight = flown(duration=28.0)
    still = replace(flight.imu, gyro=0.0 * flight.imu.gyro)
    found = map_anchors(seen_of([replace(flight, imu=still)]))
    assert "a faulty inertial sensor deforms the map" in found.why_not


@pytest.mark.slow
def test_a_gyroscope_with_wrong_signs_mirrors_no_map(flight):
    """The mirror image fits all TDOAs, so only the IMU itself can reveal it."""
    imu = replace(flight.imu, gyro=-flight.imu.gyro)
    assert "accelerations" in map_anchors(seen_of([replace(flight, imu=imu)])).why_not


@pytest.mark.slow
def test_a_flat_path_needs_heights(flight):
    flat = flown(trajectory="circle")
    assert map_anchors(seen_of([flat])).why_not
    heights = of_rows(flat.anchors.positions, range(7), (2,), 0.03)
    found = map_anchors(seen_of([flat], *heights))
    assert found.why_not or largest_z(found, flat.anchors.positions) < CERTAIN


@pytest.mark.slow
def test_a_flight_without_inertial_sensor_leaves_the_frame_open(flight):
    found = map_anchors(seen_of([flight.without("imu")]))
    assert "turn about the line" in found.why_not or "mirror image" in found.why_not


def test_a_short_flight_is_refused(flight):
    imu = Imu(*(values[:1200] for values in vars(flight.imu).values()))
    with pytest.raises(InputError, match="holds .* s of motion"):
        observe([replace(flight, imu=imu)], flight.anchors.ids)


@pytest.mark.parametrize(
    ("line", "words"),
    [("1,w,2.0,0.1", "no coordinate"), ("1,x,2.0,0", "no coordinate"), ("1.5,x,2.0,0.1", "no id")],
)
def test_a_bad_coordinate_is_named(tmp_path, line, words):
    file = tmp_path / "coordinates.csv"
    file.write_text(f"anchor,axis,value,std\n{line}\n")
    with pytest.raises(InputError, match=f"line 2: .*{words}"):
        read_coordinates(file)


@pytest.fixture(scope="module")
def desk(tmp_path_factory, flight):
    folder = tmp_path_factory.mktemp("first_map")
    write_bag(flight, folder / "flight.bag")
    flight.anchors.only(np.array(apart(flight.anchors.positions))).to_yaml(folder / "two.yaml")
    flight.anchors.to_yaml(folder / "all.yaml")
    return folder


@pytest.mark.slow
def test_the_command_writes_a_map_and_a_next_line_that_runs(desk, flight, capsys, monkeypatch):
    monkeypatch.chdir(desk)
    out = desk / "map"
    words = [str(desk / "flight.bag"), "--survey", str(desk / "two.yaml"), "--out", str(out)]
    assert main(words) == 0
    told = capsys.readouterr().out
    assert "a first map" in told
    words = shlex.split(told.split("next: ")[1])
    assert localize.main(words[words.index("localize") + 1 :]) == 0
    assert any((desk / "localized").iterdir())
    assert (out / "map.png").stat().st_size > 1000
    content = json.loads((out / "map.json").read_text())
    assert content["accepted"] and len(content["covariance"]) == 3 * len(flight.anchors)
    mapped = read_survey(out / "anchors.yaml")
    assert mapped.ids.tolist() == flight.anchors.ids.tolist()
    off = np.linalg.norm(mapped.positions - flight.anchors.positions, axis=1)
    assert off.max() < 1.0


@pytest.mark.slow
def test_the_command_refuses_and_writes_no_anchors(desk, flight, capsys):
    p = flight.anchors.positions
    pairs = [(a, b) for a in range(len(p)) for b in range(a)]
    lines = [f"{a},{b},{np.linalg.norm(p[a] - p[b]):.3f},0.02" for a, b in pairs]
    (desk / "laser.csv").write_text("\n".join(["a,b,distance,std", *lines, ""]))
    out = desk / "open"
    words = ["--survey", str(desk / "two.yaml"), "--distances", str(desk / "laser.csv")]
    assert main([*words, "--out", str(out)]) == 1
    assert "no map: the map can turn" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"map.json", "map.png"}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "FLIGHT: is missing"),
        (["flight.bag", "--survey", "all.yaml"], "holds all 7 anchors"),
        (["flight.bag", "--survey", "two.yaml", "--accuracy", "-1"], "--accuracy: -1"),
        (["flight.bag", "--survey", "."], "is a folder"),
    ],
)
def test_bad_input_is_named(desk, words, sentence, capsys, monkeypatch):
    monkeypatch.chdir(desk)
    given_survey = [] if "--survey" in words else ["--survey", "two.yaml"]
    assert main([*words, *given_survey, "--out", "none"]) == 2
    assert sentence in capsys.readouterr().err
