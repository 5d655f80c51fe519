from dataclasses import replace

import known_answer
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.flying.mission import DONE, Circles, Rules
from uwb_tdoa_tools.flying.trial import Task, fly
from uwb_tdoa_tools.flying.verdict import verdict_of
from uwb_tdoa_tools.flying.world import HALL, WORLDS
from uwb_tdoa_tools.scoring.metrics import position_at
from uwb_tdoa_tools.simulation.config import NO_IMU_ERRORS
from uwb_tdoa_tools.simulation.inject import parse_effect

SHORT = Circles(turns=1)
PLAIN = replace(HALL, floor_effect=False)
PERFECT = replace(
    PLAIN, noise=0.01, outlier_share=0.0, delay=0.0, bearing_bias=0.0, imu=NO_IMU_ERRORS
)


@pytest.fixture(scope="module")
def plain():
    return fly(Task(PERFECT, seed=3, given="place", path=SHORT))


def test_it_takes_off_follows_the_path_and_lands(plain):
    verdict = verdict_of(plain)
    assert verdict["landed"] and verdict["why"] == ""
    assert plain.missions[0].state == DONE and plain.missions[0].started == 4.0
    assert verdict["tracking"] < 0.2 and verdict["place"] < 0.1 and verdict["touchdown"] < 0.4
    assert plain.flight.truth.p[:, 2].max() == pytest.approx(SHORT.height, abs=0.2)
    assert [*verdict["phases"]] == ["before", "lift_off", "air", "landing", "after"]


def test_the_same_task_is_the_same_flight_and_another_seed_another_one(plain):
    again = fly(plain.task)
    np.testing.assert_array_equal(again.states, plain.states)
    np.testing.assert_array_equal(again.flight.tdoa.d, plain.flight.tdoa.d)
    other = fly(replace(plain.task, seed=4))
    assert not np.array_equal(other.states[0], plain.states[0])


def test_what_was_measured_is_a_flight_of_the_truth(plain):
    flight = plain.flight
    truth, tdoa = flight.truth, flight.tdoa
    p = np.stack([np.interp(tdoa.t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)
    at = (
        flight.anchors.positions[flight.anchors.index(tdoa.b)],
        flight.anchors.positions[flight.anchors.index(tdoa.a)],
    )
    residual = tdoa.d - (np.linalg.norm(p - at[0], axis=1) - np.linalg.norm(p - at[1], axis=1))
    assert np.std(residual) == pytest.approx(0.01, rel=0.05)
    assert len(tdoa) / (truth.t[-1] - truth.t[0]) == pytest.approx(360.0, rel=0.03)
    still = (flight.imu.t > 1.0) & (flight.imu.t < 3.9)
    np.testing.assert_allclose(flight.imu.accel[still].mean(axis=0), [0.0, 0.0, 9.81], atol=1e-3)


@pytest.fixture(scope="module")
def silent():
    return fly(Task(replace(PERFECT, silence=("circle", 3.0)), seed=3, given="place", path=SHORT))


def test_in_a_silence_nothing_is_heard_and_it_lands(silent):
    heard = silent.flight.tdoa.t
    gap = np.argmax(np.diff(heard))
    began = silent.missions[0].started + SHORT.rise + 4.0
    assert heard[gap] == pytest.approx(began, abs=0.02) and heard[gap + 1] - heard[
        gap
    ] == pytest.approx(3.0, abs=0.02)
    assert verdict_of(silent)["safe"]


def test_everything_comes_late_and_is_flown_by_all_the_same():
    flown = fly(Task(replace(PERFECT, latency=0.05), seed=3, given="place", path=SHORT))
    assert verdict_of(flown)["safe"]
    truth = flown.flight.truth
    assert truth.t[-1] - flown.odometry.t[-1] >= 0.05 - 1e-9


def test_an_effect_is_in_the_loop_what_inject_makes_of_it(plain):
    """At the same true path it adds to each TDOA what it adds to a recording."""
    effect = parse_effect("nlos", ["2.delay=0.4", "2.start=1", "2.end=3"])
    rules = Rules(rest=3.5, patience=0.0, arm=1e-6)  # stays where it is
    task = Task(PERFECT, seed=3, given="place", path=SHORT, rules=rules)
    without, with_it = (
        fly(task).flight,
        fly(replace(task, world=replace(PERFECT, effects=EffectSet((effect,))))).flight,
    )
    np.testing.assert_allclose(with_it.tdoa.d, effect.inject(without).tdoa.d, atol=1e-9)
    assert not np.array_equal(with_it.tdoa.d, without.tdoa.d)


def test_after_a_minute_it_flies_once_more_from_where_it_was_carried():
    flown = fly(
        Task(replace(PERFECT, outlier_share=0.01), seed=3, given="place", path=SHORT, again=True)
    )
    first, second = flown.missions
    assert np.linalg.norm(first.place - second.place) == pytest.approx(2.0, abs=0.3)
    assert second.begin - first.ended > 60.0 and second.started == pytest.approx(
        second.begin + 4.0, abs=0.02
    )
    truth, imu = flown.flight.truth, flown.flight.imu
    carried = truth.p[(truth.t > second.begin - 6.0) & (truth.t < second.begin)]
    assert carried[:, 2].max() == pytest.approx(0.53, abs=0.02)
    lifted = (imu.t > second.begin - 6.0) & (imu.t < second.begin - 4.0)
    assert np.abs(imu.accel[lifted, 2] - 9.81).max() > 0.3  # its sensors feel that
    verdict = verdict_of(flown)
    assert verdict["started"] == second.started
    assert position_at(np.array([truth.t[-1]]), truth)[0, 2] < 0.05


def test_it_is_flown_by_what_a_network_corrects(tmp_path):
    path = Circles(turns=1, turn_time=4.0)
    task = Task(PERFECT, seed=1, given="place", path=path, model=str(known_answer.write(tmp_path)))
    plain, corrected = fly(replace(task, model=None)), fly(task)
    # the same samples until the vehicle moves, but other estimates
    np.testing.assert_array_equal(plain.flight.tdoa.d[:100], corrected.flight.tdoa.d[:100])
    n = min(len(plain.odometry.t), len(corrected.odometry.t))
    assert np.abs(plain.odometry.p[:n] - corrected.odometry.p[:n]).max() > 0.01


@pytest.mark.parametrize(
    "name", ["table", "person", "three-kinds", "tdoa3", "jitter", "rectifying", "gusts"]
)
def test_every_world_can_be_flown_in(name):
    world = replace(WORLDS[name], sensors=("height", "pressure", "velocity"))
    flown = fly(
        Task(world, seed=1, path=Circles(turns=1, turn_time=2.0, radius=0.0), given="place")
    )
    assert (
        flown.missions[0].started is not None
        and len(flown.flight.height)
        and len(flown.flight.velocity)
    )
    assert flown.flight.truth.p[0, 2] == pytest.approx(world.table + 0.03, abs=0.005)
