# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of plans: its solver at places with a known answer, and two cases."""

import numpy as np
import pytest

from studies import plans
from uwb_tdoa_tools.planning.installation import FixedNoise, RadioNoise
from uwb_tdoa_tools.planning.maps import FLYABLE, TOO_FEW, TWO_SOLUTIONS
from uwb_tdoa_tools.simulation.rooms import Room


def cube(side=6.0, noise=FixedNoise(0.05)):
    """A room with an anchor in each corner."""
    corners = np.stack(np.meshgrid(*[[0.0, side]] * 3), axis=-1).reshape(-1, 3)
    return plans.Drawn(Room(np.zeros(3), np.full(3, side)), corners, noise, False, np.inf, None)


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


def test_a_wall_hides_anchors_behind_it():
    one = plans.Drawn(
        Room(np.zeros(3), np.array([10.0, 10.0, 3.0])),
        np.array([[1.0, 1.0, 1.0], [9.0, 1.0, 1.0], [9.0, 9.0, 1.0], [1.0, 9.0, 1.0]]),
        FixedNoise(0.1),
        False,
        20.0,
        (5.0, 5.0),
    )
    assert one.heard(np.array([2.0, 2.5, 1.0])).tolist() == [0, 2, 3]
    assert one.heard(np.array([2.0, 9.0, 1.0])).tolist() == [0, 1, 2, 3]


@pytest.mark.slow
@pytest.mark.parametrize(("points", "seed"), [(30, 2), (12, 101)])
def test_a_case_agrees_with_the_solver_and_with_its_rerun(points, seed):
    row = plans.compared(points, seed)
    share, gain, bound = plans.differences(row)
    assert share <= 1.0 / points + 1e-9 and gain <= 1e-9 and bound <= 1e-9
    assert sum(row["plan"]) == pytest.approx(1.0) and sum(row["solver"]) == pytest.approx(1.0)
    lines = plans.table([row]).splitlines()
    assert lines[0].count("|") == lines[2].count("|") and "allowed 3" in lines[-1]


def test_too_few_anchors_are_a_state_of_their_own():
    one = cube()
    far = plans.Drawn(one.room, one.anchors, one.noise, False, 1.0, (3.0, 3.0))
    points = np.array([[1.0, 1.0, 1.0], [3.0, 3.0, 3.0]])
    assert plans.solved(far, points, np.random.default_rng(0)) == [TOO_FEW, TOO_FEW]
    assert plans.planned(far, points).tolist() == [TOO_FEW, TOO_FEW]
    assert plans.shares([FLYABLE, TWO_SOLUTIONS]) == [0.5, 0.5, 0.0, 0.0]
