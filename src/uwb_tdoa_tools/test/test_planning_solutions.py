# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Second solutions of a position: of pairings and of all measurements, and their consequences."""

from dataclasses import replace

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import norm

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.planning.maps import (
    IMPRECISE,
    TWO_SOLUTIONS,
    Demand,
    Grid,
    Hall,
    judge,
)
from uwb_tdoa_tools.planning.precision import (
    CLEAR,
    FLIP,
    MOST_SUBSETS,
    FixedNoise,
    Installation,
    RadioNoise,
    Subsets,
    other_solutions,
)
from uwb_tdoa_tools.simulation.config import Room, Walls, constellation, corners

# --- planning bifurcation ---


SQUARE = Anchors.from_positions([[0, 0, 0.2], [4, 0, 0.2], [4, 4, 0.2], [0, 4, 0.2]])
SKEW = Anchors.from_positions([[0.4, 0.3, 0.2], [3.9, 0.9, 0.2], [3.1, 3.7, 0.2], [0.7, 2.6, 0.2]])


def tdoas(x, corners):
    return np.diff(np.linalg.norm(x - corners, axis=1))


def has_another_solution(rng, point, corners, dimensions):
    """Return whether scipy finds another place with the TDOAs of a point, from several starts."""
    wanted, height = tdoas(point, corners), point[dimensions:]
    extent = np.ptp(corners, axis=0).max()
    for radius in np.repeat([0.1, 0.4, 1.5, 10.0, 100.0], 8):
        ray = rng.standard_normal(dimensions)
        found = least_squares(
            lambda x: tdoas(np.append(x, height), corners) - wanted,
            corners[:, :dimensions].mean(axis=0) + radius * extent * ray / np.linalg.norm(ray),
            method="lm",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        apart = np.linalg.norm(found.x - point[:dimensions])
        if found.cost < 1e-16 and apart > 1e-3 * extent:
            return True
    return False


AT_HEIGHTS = Anchors.from_positions([[0, 0, 0.2], [4, 0, 3.0], [4, 4, 0.4], [0, 4, 2.5]])


@pytest.mark.parametrize(
    ("anchors", "dimensions"),
    [(SQUARE, 2), (SKEW, 2), (AT_HEIGHTS, 2), (corners(), 3)],
    ids=["square", "skew", "known height", "space"],
)
def test_a_solver_finds_a_second_solution_where_the_formula_has_one(anchors, dimensions):
    subsets, rng = Subsets(anchors, dimensions), np.random.default_rng(2)
    points = rng.uniform([-1.9, -2.0, 0.0], [5.9, 6.0, 3.0], (15, 3))
    choices = rng.integers(len(subsets.rows), size=len(points))
    formula = subsets.discriminant(points)[np.arange(len(points)), choices]
    corners = anchors.positions[subsets.rows[choices]]
    found = [
        has_another_solution(rng, point, each, dimensions) for point, each in zip(points, corners)
    ]
    assert 0.0 < np.mean(found) < 1.0
    clear = np.abs(formula) > 0.01  # else the second solution is kilometres away
    np.testing.assert_array_equal(np.array(found)[clear], formula[clear] > 0.0)


def test_the_flyable_area_of_the_paper():
    """Fig. 6c and sec. 5.1 of the paper.

    An envelope around each anchor contains at least all points within 0.5 m of the anchor. The
    middle and the middles of the sides are free. All four corners look the same.
    """
    subsets, installation = Subsets(SQUARE, 2), Installation(SQUARE, dimensions=2)
    assert len(subsets.rows) == 4
    points = Grid.slice((-1, 5), (-1, 5), 0.2, 0.04).points
    free = subsets.ambiguous(points) == 0.0
    near = np.linalg.norm(points[:, None] - SQUARE.positions, axis=-1).min(axis=1)
    assert not free[near < 0.5].any() and free[np.abs(points[:, :2] - 2).max(axis=1) < 1].all()
    assert free[(np.abs(points[:, :2] - 2) < 0.5).any(axis=1)].all()
    square = free.reshape(150, 150)
    for turned in (square[::-1], square[:, ::-1], square.T):
        np.testing.assert_array_equal(turned, square)
    hull = installation.inside_hull(points)
    assert np.mean(free[hull]) == pytest.approx(0.890, abs=0.002)
    on_the_diagonal = np.linspace(0.01, 1.5, 150)
    reach = Subsets(SQUARE, 2).ambiguous(
        np.column_stack([on_the_diagonal, on_the_diagonal, 0 * on_the_diagonal + 0.2])
    )
    assert np.sqrt(2) * on_the_diagonal[np.flatnonzero(reach)[-1]] == pytest.approx(
        np.sqrt(0.5), abs=0.02
    )


def test_flat_choices_are_left_out():
    subsets = Subsets(corners(), 3)
    # of 70; 6 faces and 6 diagonal planes are left out
    assert len(subsets.rows) == 58
    with pytest.raises(InputError, match="nearly in one line"):
        Subsets(Anchors.from_positions([[0, 0, 0], [4, 0.02, 0], [8, 0, 0]]), 2)


def test_of_many_anchors_those_that_are_heard_together_are_chosen():
    subsets = Subsets(constellation("random-3-64"), 3)
    assert MOST_SUBSETS / 3 < len(subsets.rows) <= MOST_SUBSETS
    assert set(subsets.rows.ravel()) == set(range(64))
    span = (subsets.rows.max(axis=1) - subsets.rows.min(axis=1)) % 64
    assert (np.minimum(span, 64 - span) < 32).all()
    assert len({tuple(sorted(row)) for row in subsets.rows}) == len(subsets.rows)
    assert subsets.ambiguous(np.zeros((10, 3))).shape == (10,)


# --- planning second minimum ---


def box(rng, low, high):
    return Room(np.zeros(3), rng.uniform(low, high))


def whitened(p, anchors, variance, planar):
    """Return f(x): TDOAs of consecutive anchors at x minus TDOAs at p, whitened."""
    d = np.diff(np.eye(len(anchors)), axis=0)
    root = np.linalg.inv(np.linalg.cholesky(d * variance @ d.T))
    true = np.linalg.norm(p - anchors, axis=1)

    def residual(x):
        return (
            root
            @ d
            @ (np.linalg.norm((np.append(x, p[2]) if planar else x) - anchors, axis=1) - true)
        )

    return residual


def has_no_minimum_there(point, anchors, noise, place, room):
    """Return whether a descent from `place` ends at the point or outside the room.

    The descent uses the TDOAs of fewer anchors. If it ends at the point, the additional anchor has
    split a valley. If it ends outside, the additional anchor has moved a minimum into the room.
    """
    variance = noise.variance(point[None], Anchors.from_positions(anchors))[0]
    residual = whitened(point, anchors, variance, False)
    end = least_squares(residual, place, xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=2000).x
    inside = (end >= room.lower).all() and (end <= room.upper).all()
    return np.linalg.norm(end - point) < FLIP or not inside


def random_room(seed):
    rng = np.random.default_rng(seed)
    room = box(rng, [4, 4, 2.5], [14, 14, 6])
    positions = rng.uniform(room.lower, room.upper, (int(rng.integers(5, 10)), 3))
    noise = FixedNoise(float(rng.uniform(0.03, 0.3))) if rng.integers(2) else RadioNoise()
    return rng, room, positions, noise, rng.uniform(room.lower, room.upper, (300, 3))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_one_more_anchor_loses_a_place_only_if_it_makes_the_second_minimum(seed):
    """One more anchor raises the misfit everywhere, and lowers the bound.

    It can exclude a position only by a minimum that did not exist before.
    """
    _, room, positions, noise, points = random_room(seed)
    few, more = (
        Installation(Anchors.from_positions(p), noise, hall=True)
        for p in (positions[:-1], positions)
    )
    before, after = (judge(points, one, Demand(room)) for one in (few, more))
    assert (after.error <= before.error * (1.0 + 1e-9)).all()
    misfit, places = other_solutions(points, more, room)
    for row in np.flatnonzero(before.flyable & ~after.flyable):
        assert has_no_minimum_there(points[row], positions[:-1], noise, places[row], room)
    rows = np.flatnonzero(misfit <= CLEAR)
    for row in rows[:20]:
        for one in (few, more):
            variance = noise.variance(points[[row]], one.anchors)[0]
            value = np.linalg.norm(
                whitened(points[row], one.anchors.positions, variance, False)(places[row])
            )
            assert value <= misfit[row] + 1e-6


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_more_noise_never_raises_a_share_and_a_known_height_never_lowers_it(seed):
    _, room, positions, _, points = random_room(seed)
    anchors = Anchors.from_positions(positions)
    quiet, loud = (
        judge(points, Installation(anchors, FixedNoise(std), hall=True), Demand(room))
        for std in (0.1, 0.2)
    )
    assert (
        not (loud.flyable & ~quiet.flyable).any()
        and not ((quiet.status == TWO_SOLUTIONS) & (loud.status != TWO_SOLUTIONS)).any()
    )
    planar = judge(
        points, Installation(anchors, FixedNoise(0.1), dimensions=2, hall=True), Demand(room)
    )
    assert (planar.error <= quiet.error * (1.0 + 1e-9)).all()
    assert planar.flyable.mean() >= quiet.flyable.mean() - 0.005


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_in_a_hall_a_wall_or_a_missing_anchor_gains_a_place_only_by_a_lost_minimum(seed):
    rng = np.random.default_rng(seed)
    room = box(rng, [30, 20, 4], [60, 40, 8])
    positions = rng.uniform(room.lower, room.upper, (int(rng.integers(10, 25)), 3))
    installation = Installation(Anchors.from_positions(positions), FixedNoise(0.1), hall=True)
    whole = Hall(installation, Demand(room), 20.0)
    points = rng.uniform(room.lower, room.upper, (300, 3))
    x, y = rng.uniform(room.lower, room.upper)[:2]
    found, heard = whole.judge(points)
    fewer = Anchors.from_positions(positions[:-1])
    for less in (replace(whole, walls=Walls(((x, 0.0, x, y, np.inf),))), whole.with_anchors(fewer)):
        other, count = less.judge(points)
        assert (count <= heard).all() and (found.error <= other.error * (1.0 + 1e-9)).all()
        for row in np.flatnonzero(other.flyable & ~found.flyable):
            rows = whole.heard(points[[row]])[0]
            among = installation.with_anchors(Anchors.from_positions(positions[rows]))
            place = other_solutions(points[[row]], among, room)[1][0]
            left = positions[less.heard(points[[row]])[0]]
            assert has_no_minimum_there(points[row], left, FixedNoise(0.1), place, room)


def test_imprecision_is_no_second_solution():
    """Anchors at nearly one height hardly determine z.

    Together, they still have only one minimum in the room.
    """
    rng = np.random.default_rng(0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(5) * 12.0, np.arange(4) * 12.0))
    anchors = Anchors.from_positions(np.column_stack([x, y, 5.0 + 0.3 * rng.random(len(x))]))
    room = Room(np.zeros(3), np.array([48.0, 36.0, 5.0]))
    points = rng.uniform([6, 6, 0.5], [42, 30, 2.0], (60, 3))
    status = Hall(Installation(anchors, hall=True), Demand(room, 0.3), 25.0).judge(points)[0].status
    assert (status != TWO_SOLUTIONS).all() and (status == IMPRECISE).mean() > 0.5


def test_a_second_minimum_predicts_how_often_an_estimator_flips():
    """The other minimum fits better than the truth in a share Phi(-misfit / 2) of noisy rounds."""
    anchors, rng = constellation("random-3-5"), np.random.default_rng(4)
    room = Room(anchors.positions.min(axis=0) - 1.0, anchors.positions.max(axis=0) + 1.0)
    noise = 0.1
    for pairing in ("ring", "all_pairs"):
        installation = Installation(anchors, FixedNoise(noise), pairing)
        points = rng.uniform(room.lower, room.upper, (2000, 3))
        misfits, places = other_solutions(points, installation, room)
        k = np.argmin(np.abs(misfits - 1.5))
        if pairing == "ring":  # without the last pair
            d, times = np.diff(np.eye(5), axis=0), 1.0
            root = np.linalg.cholesky(noise**2 * (d @ d.T))
        else:  # 10 TDOAs count as 5
            a, b = np.triu_indices(5, 1)
            d, times = np.eye(5)[b] - np.eye(5)[a], 0.5
            root = np.sqrt(2) * noise * np.eye(len(d))
        true, other = (
            np.linalg.norm(p - anchors.positions, axis=1) for p in (points[k], places[k])
        )
        shift = np.linalg.solve(root, d @ (other - true)) * np.sqrt(times)
        assert np.linalg.norm(shift) == pytest.approx(misfits[k], rel=1e-6)
        draws = rng.standard_normal((40_000, len(d)))
        flips = np.mean(np.sum((draws - shift) ** 2, axis=1) < np.sum(draws**2, axis=1))
        assert flips == pytest.approx(norm.cdf(-0.5 * misfits[k]), abs=0.01)
    assert norm.cdf(-0.5 * CLEAR) == pytest.approx(0.01, abs=2e-4)


def test_anchors_in_a_plane_mirror_a_place_in_the_room_and_not_one_beyond_it():
    x, y = (axis.ravel() for axis in np.meshgrid([0.0, 5.0, 10.0], [0.0, 4.0, 8.0]))
    anchors = Anchors.from_positions(np.column_stack([x, y, np.full(9, 3.0)]))
    installation, points = (
        Installation(anchors, FixedNoise(0.05), hall=True),
        np.array([[4.0, 3.0, 1.0]]),
    )
    for height, two in ((6.0, True), (3.0, False)):
        misfit, place = other_solutions(
            points, installation, Room(np.zeros(3), np.array([10.0, 8.0, height]))
        )
        assert (misfit[0] <= CLEAR) == two
    (misfit,), (place,) = other_solutions(
        points, installation, Room(np.zeros(3), np.array([10.0, 8.0, 6.0]))
    )
    assert misfit == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(place, [4.0, 3.0, 5.0], atol=1e-3)


def test_an_accuracy_is_a_size():
    for wrong in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="accuracy: "):
            Demand(accuracy=wrong)
