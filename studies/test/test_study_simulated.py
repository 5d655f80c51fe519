# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What studies simulate, and how they judge it: paths, situations, rooms, and named anchors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from studies import moved_anchors, plans, situations
from studies.any_path import Path, between
from studies.healthy import healthy
from uwb_tdoa_tools.checking.check import check, processed_streams
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.planning.maps import TOO_FEW
from uwb_tdoa_tools.planning.precision import FixedNoise, RadioNoise
from uwb_tdoa_tools.simulation.config import Room


def test_the_motion_of_a_path_is_its_derivative_and_what_a_sensor_feels():
    path = Path(10.0, between((0.0, 0, 0, 1), (1.0, 0, 0, 1), (4.0, 3, 1, 2), (9.0, 0, 0, 1)))
    t = np.linspace(0.5, 9.5, 400)
    motion, h = path.motion(t), 1e-3
    ahead, behind = path.motion(t + h), path.motion(t - h)
    np.testing.assert_allclose((ahead.p - behind.p) / (2 * h), motion.v, atol=1e-4)
    np.testing.assert_allclose((ahead.v - behind.v) / (2 * h), motion.a, atol=1e-3)
    felt = Rotation.from_quat(motion.q).apply(motion.specific_force)
    np.testing.assert_allclose(felt, motion.a + [0, 0, 9.81], atol=1e-9)
    turn = Rotation.from_quat(behind.q).inv() * Rotation.from_quat(ahead.q)
    np.testing.assert_allclose(turn.as_rotvec() / (2 * h), motion.body_rates, atol=1e-3)
    still = path.motion(np.array([0.3]))
    np.testing.assert_allclose(still.p, [[0, 0, 1]], atol=1e-9)


def run_of(right, seconds=20.0, rate=100.0):
    """What of an ErrorSeries `again` takes: right in spans ((begin, end), ...) s, else 2 m off."""
    t = np.arange(0.0, seconds, 1.0 / rate)
    good = np.any([(t >= begin) & (t < end) for begin, end in right], axis=0)
    return SimpleNamespace(t=t, error=np.where(good, 0.1, 2.0)[:, None] * [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("right", "since", "after"),
    [
        ([(0.0, 20.0)], 5.0, 0.0),
        ([(0.0, 6.0), (9.0, 20.0)], 5.0, 4.0),
        ([(6.0, 7.0), (8.0, 10.5), (11.0, 20.0)], 5.0, 3.0),
        ([(0.0, 6.0)], 5.0, None),
        ([(19.0, 20.0)], 5.0, 14.0),
        ([(0.0, 20.0)], 25.0, None),  # no estimate any more
    ],
)
def test_right_again_is_right_for_two_seconds_or_to_the_end(right, since, after):
    assert situations.again(run_of(right), since) == pytest.approx(after, abs=0.021)


def simulated(situation):
    common = {"seed": 3, "imu_rate": 100.0, "truth_rate": 50.0, "protocol": "tdoa3"}
    return situation.make(np.random.default_rng(3), common | {"anchors": situations.corners()})


@pytest.mark.parametrize("situation", situations.SITUATIONS, ids=lambda one: one.name)
def test_every_situation_can_be_simulated_and_is_judged_within_its_recording(situation):
    flight = simulated(situation)
    begin, end = situation.judged
    assert flight.truth.t[0] <= begin + 0.02 and end <= flight.truth.t[-1] + 0.02
    assert np.isfinite(flight.imu.accel).all() and np.isfinite(flight.tdoa.d).all()


def test_low_anchors_are_late_on_the_floor_alone():
    named = {one.name: one for one in situations.SITUATIONS}
    late = simulated(named["lift-off, low anchors 3.2 m late on the floor"])
    added = late.tdoa.d - simulated(named["lift-off, 3 s"]).tdoa.d
    height = np.interp(late.tdoa.t, late.truth.t, late.truth.p[:, 2])
    low = late.anchors.ids[late.anchors.positions[:, 2] < 0.5]
    b_alone = np.isin(late.tdoa.b, low) & ~np.isin(late.tdoa.a, low)
    assert np.median(added[b_alone & (height < 0.05)]) == pytest.approx(3.2, abs=0.5)
    np.testing.assert_array_equal(added[height > 0.21], 0.0)


def cube(side=6.0, noise=FixedNoise(0.05), reach=np.inf, wall=None):
    """A room with an anchor in each corner."""
    corners = np.stack(np.meshgrid(*[[0.0, side]] * 3), axis=-1).reshape(-1, 3)
    return plans.Drawn(Room(np.zeros(3), np.full(3, side)), corners, noise, False, reach, wall)


def test_the_solver_finds_the_mirror_of_a_plane_and_nothing_else():
    one, rng, point = cube(), np.random.default_rng(0), np.array([2.0, 3.5, 1.0])
    assert plans.second_minimum(one, point, one.anchors, rng) == np.inf
    flat = np.array([[x, y, 3.0] for x in (0.0, 3.0, 6.0) for y in (0.0, 3.0, 6.0)])
    assert plans.second_minimum(one, point, flat, rng) == pytest.approx(0.0, abs=1e-6)


def test_the_bound_is_that_of_a_symmetric_layout():
    """In the middle of a cube N ranges with one offset have 3 sigma / sqrt(N)."""
    one = cube()
    assert plans.bound(one, np.full(3, 3.0), one.anchors) == pytest.approx(0.05 * 3 / np.sqrt(8))
    near, far = (cube(side, RadioNoise()) for side in (6.0, 12.0))
    bounds = [plans.bound(room, room.room.centre, room.anchors) for room in (near, far)]
    assert bounds[1] == pytest.approx(2.0 * bounds[0], rel=0.1)


def test_too_few_anchors_and_a_wall_are_seen_by_both():
    one, points = cube(reach=1.0, wall=(3.0, 3.0)), np.array([[1.0, 1.0, 1.0], [3.0, 3.0, 3.0]])
    assert plans.solved(one, points, np.random.default_rng(0)) == [TOO_FEW, TOO_FEW]
    assert plans.planned(one, points).tolist() == [TOO_FEW, TOO_FEW]
    behind = cube(wall=(3.0, 2.0)).heard(np.array([1.0, 1.0, 1.0]))
    assert one.anchors[behind].tolist() == [
        point for point in one.anchors.tolist() if point[0] < 3.0 or point[1] > 3.0
    ]


def test_a_pair_is_right_if_it_holds_the_anchor_and_stands_alone():
    pair = "anchor 3 or 5 does not stand where the survey has it, but if it is anchor 3, "
    groups = moved_anchors._groups([pair, "two anchors are exchanged, 1 and 2"])
    assert groups == [[1], [2], [3, 5]]
    assert moved_anchors._right([[3, 5]], [5]) and moved_anchors._right([[1], [2]], [1, 2])
    wrong = [[3, 5], [4]], [[3, 4, 5]], [[3, 4]], []
    assert not any(moved_anchors._right(groups, [5]) for groups in wrong)
    assert not moved_anchors._right([[1, 2]], [1, 2])


@pytest.mark.parametrize("unit, named", [(1.0, set()), (180.0 / np.pi, {"imu_rate_unit"})])
def test_only_a_gyroscope_in_degrees_is_named_while_a_tilted_quadrotor_turns(unit, named):
    flight = healthy("quadrotor, TDOA3", 8008)  # 2 rad/s, and a large radius
    recording = of_flight(flight.replaced(imu=replace(flight.imu, gyro=unit * flight.imu.gyro)))
    assert {one.rule for one in processed_streams(recording).findings()} == named


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "anchor"), [(1000, 3), (1006, 6)])
def test_one_anchor_that_explains_nearly_as_much_as_delays_of_all_is_named(seed, anchor):
    """It was "the survey does not fit", although the anchor costs 0.37 m."""
    changed = moved_anchors.recorded("moved before", seed)[2]
    found = check(of_flight(replace(changed, truth=None))).findings
    assert found[0].cause.startswith(f"anchor {anchor} ") and len(found) == 1


@pytest.mark.slow
def test_a_sound_imu_outside_of_the_anchors_is_not_of_another_body():
    flight = healthy(
        "outside of its anchors", 9806
    )  # worse by 5 % with it, and by 0.6 standard errors
    assert not [one for one in check(of_flight(flight)).findings if one.severity == "error"]
