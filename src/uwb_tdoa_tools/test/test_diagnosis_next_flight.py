# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The flight that resolves the open questions of a diagnosis."""

from types import SimpleNamespace

from hypothesis import given, settings, strategies as st
from known_effects import CLEAN
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.commands import diagnose
from uwb_tdoa_tools.commands.simulate import OPTIONS, POSE, config_of
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.motions import (
    ANCHOR_CLEARANCE,
    RATE,
    Limits,
    _line,
    motions,
)
from uwb_tdoa_tools.diagnosis.next_flight import Model, Rivalry, plan_flight
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.report import maps
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import Room, constellation, corners, room_of

RATES = {"imu_rate": 200.0, "truth_rate": 100.0, "start_in_air": True}


def flown(effect, seed, **path):
    flight = simulate(SimulationConfig(seed=seed, **path, **RATES, **CLEAN))
    return effect.inject(flight, np.random.default_rng(seed)) if effect else flight


def of_anchors(anchors):
    return [SimpleNamespace(anchors=anchors, tdoa=[1])]


def sides(path):
    """Return speeds, accelerations and turning rates along a TimedPath."""
    v = np.diff(path.p, axis=0) * RATE
    a = np.diff(v, axis=0) * RATE
    rate = np.diff(path.yaw) * RATE
    return np.linalg.norm(v, axis=1), np.linalg.norm(a, axis=1), np.abs(rate)


def keeps(path, limits):
    speed, acceleration, turning = sides(path)
    assert speed.max() <= 1.01 * limits.speed and turning.max() <= 1.01 * limits.turning
    assert acceleration.max() <= 1.05 * limits.acceleration
    assert max(speed[0], speed[-1]) < 0.05 * limits.speed


@settings(max_examples=12, deadline=None)
@given(
    st.tuples(*[st.floats(-9.0, 9.0)] * 3),
    st.tuples(*[st.floats(1.2, 12.0)] * 2, st.floats(1.2, 5.0)),
    st.floats(0.2, 3.0),
    st.floats(0.5, 4.0),
)
def test_motions_stay_clear_of_walls_and_anchors_and_within_limits(lower, size, speed, most):
    room = Room(np.array(lower), np.array(lower) + size)
    limits = Limits(600.0, speed, most)
    for anchors in (corners(), constellation("pillars")):
        try:
            found = motions(room, of_anchors(anchors), limits)
        except InputError:
            continue
        low, high = room.path_box
        for path in found.paths:
            assert (path.p >= low - 1e-9).all() and (path.p <= high + 1e-9).all(), path.what
            away = np.linalg.norm(path.p[:, None] - anchors.positions, axis=2)
            # the planner checks every fifth pose
            assert away.min() > ANCHOR_CLEARANCE - 2.5 * speed / RATE
            keeps(path, limits)


def test_a_room_too_small_or_a_flight_too_short_is_refused():
    anchors = corners()
    for room, limits in (
        (Room(anchors.positions[0] - 0.2, anchors.positions[0] + 0.2), Limits()),
        (room_of(anchors), Limits(time=1.0)),
    ):
        with pytest.raises(InputError, match="no motion fits"):
            motions(room, of_anchors(anchors), limits)
    with pytest.raises(InputError, match="needs TDOAs"):
        motions(room_of(anchors), [SimpleNamespace(anchors=anchors, tdoa=[])], Limits())
    for values in ((0.0,), (60.0, -1.0), (60.0, np.nan)):
        with pytest.raises(InputError, match="--plan-(time|speed)"):
            Limits(*values)


def test_a_path_goes_on_where_the_one_before_ended():
    limits = Limits()
    turning = _line(np.zeros(3), np.zeros(3), (0.0, 2.0 * np.pi), limits, "turn")
    other = _line(np.zeros(3), np.array([1.0, 0.0, 0.0]), (0.0, 0.5), limits, "line")
    path = turning.then(other)
    keeps(path, limits)
    assert path.duration == pytest.approx(turning.duration + other.duration)
    assert path.yaw[-1] == pytest.approx(2.0 * np.pi + 0.5)
    assert path.stops == (0, len(turning.p) - 1, len(path.p) - 1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_misfit_is_that_of_least_squares(seed):
    """The misfit is the increase by the new rows, beyond the misfit of the old rows alone."""
    rng = np.random.default_rng(seed)
    old, new = rng.standard_normal((9, 4)), rng.standard_normal((7, 6))
    places = np.array([0, 2, 3, 5])
    fitted, truth = rng.standard_normal(4), rng.standard_normal(6)
    model = Model("a", places, fitted, old.T @ old)
    target = np.concatenate([old @ fitted, new @ truth])
    rest = np.linalg.lstsq(np.vstack([old, new[:, places]]), target, rcond=None)[1]
    assert model.misfit(new.T @ new, truth[None])[0] == pytest.approx(float(rest[0]))


def test_a_probability_rises_with_what_distinguishes_and_not_with_what_does_not():
    models = (
        Model("a", np.array([0]), np.ones(1), 100.0 * np.eye(1)),
        Model("b", np.array([1]), np.ones(1), 100.0 * np.eye(1)),
    )
    rivalry = Rivalry(0.05, models, np.array([0.0, 2.0]))
    alike, apart = np.ones((2, 2)), np.array([[1.0, 0.0], [0.0, 1.0]])
    for much in (1.0, 100.0, 1e4):
        assert rivalry.probability(much * alike) < 0.1 and rivalry.value(much * alike) < 0.2
    chances = [rivalry.probability(much * apart) for much in (0.0, 10.0, 100.0)]
    assert chances[0] == 0.0 and np.all(np.diff(chances) > 0.0) and chances[-1] > 0.95
    assert "distinguishes a from b" in rivalry.answer(apart)
    left, sentences = rivalry.without_twins(1e4 * alike)
    assert len(left.models) == 1 and sentences == ["No flight in this box distinguishes a from b."]
    assert rivalry.without_twins(1e4 * apart)[1] == []


@pytest.fixture(scope="module")
def planned():
    """Return a flight with a lever arm at one yaw, its diagnosis and the planned flight.

    At one yaw, a lever arm looks like a shifted frame.
    """
    first = flown(EFFECTS["tag_lever_arm"]({"x": 0.1}), 5, trajectory="circle", duration=25.0)
    found = attribute([first], GroundTruth(), undeclared=False)
    library = motions(room_of(first.anchors), [first], Limits(time=30.0))
    return first, found, library, plan_flight([first], found, found.findings(), library)


def names_left(found):
    """Return the names of the chosen candidates and of rivals with a similar criterion."""
    near = {
        one.candidate.name for rivals in found.selection.rivals for one in rivals if one.gap < 10.0
    }
    return {one.name for one in found.selection.chosen}, near


@pytest.mark.slow
def test_the_planned_flight_turns_and_settles_the_question(planned):
    first, found, library, plan = planned
    chosen, near = names_left(found)
    assert chosen | near == {"tag_lever_arm", "truth_frame"}
    assert np.ptp(plan.path.yaw) > 0.5 * np.pi and plan.path.duration <= library.limits.time
    assert plan.probability > 0.9 and "tag_lever_arm" in plan.answers[0]
    keeps(plan.path, library.limits)
    poses = tuple(map(tuple, np.column_stack([plan.path.t, plan.path.p, plan.path.yaw])))
    effect = EFFECTS["tag_lever_arm"]({"x": 0.1})
    second = flown(effect, 6, poses=poses, duration=plan.path.duration)
    again = attribute([first, second], GroundTruth(), undeclared=False)
    assert names_left(again) == ({"tag_lever_arm"}, set())


def test_its_files_are_flown_and_read(planned, tmp_path):
    first, _, _, plan = planned
    for name, text in plan.files().items():
        (tmp_path / name).write_text(text)
    table = np.genfromtxt(tmp_path / "next_flight.csv", delimiter=",", names=True)
    assert table.dtype.names == POSE
    parser = cli.parser("simulate", "Simulate.", options=OPTIONS)
    config = config_of(parser.parse_args(["--poses", str(tmp_path / "next_flight.csv")]))
    assert np.allclose(np.array(config.poses)[:, 1:4], plan.path.p, atol=1e-3)
    tum = np.loadtxt(tmp_path / "next_flight.tum")
    assert tum.shape == (len(plan.path.p), 8)
    assert np.allclose(2.0 * np.arctan2(tum[:, 6], tum[:, 7]), plan.path.yaw, atol=1e-3)
    lines = (tmp_path / "next_flight_waypoints.csv").read_text().splitlines()
    assert lines[0] == "x,y,z,yaw,t,motion" and lines[-1].endswith('"end"')
    words = " ".join(plan.sentences)
    assert f"{plan.path.duration:.0f} s" in words and "m/s" in words
    told = plan.as_json()
    assert told["probability"] == plan.probability and told["settles"] == list(plan.answers)
    assert told["parts"][0] == {"from": 0.0, "motion": plan.parts[0][1]}
    picture = maps.planned(SimpleNamespace(next_flight=plan, flights=[first]))
    assert picture.source.startswith("data:image/") and picture.alt


def test_without_rivals_it_makes_the_values_precise(planned):
    first, found, library, _ = planned
    alone = SimpleNamespace(
        selection=SimpleNamespace(
            **{**vars(found.selection), "rivals": ((),) * len(found.selection.chosen)}
        )
    )
    plan = plan_flight([first], alone, found.findings(), library)
    assert plan.probability is None and "reduces the standard deviations" in plan.answers[0]
    nothing = SimpleNamespace(
        selection=SimpleNamespace(**{**vars(found.selection), "chosen": (), "rivals": ()})
    )
    assert plan_flight([first], nothing, [], library) is None


def test_it_needs_ground_truth(tmp_path, capsys):
    line = ["nowhere", "--no-truth", "--plan-flight", *"-3 3 -3 3 0 3".split()]
    assert diagnose.main([*line, "--out", str(tmp_path / "out")]) == 2
    assert (
        "--plan-flight: no part of it is used with --reference nothing" in capsys.readouterr().err
    )
