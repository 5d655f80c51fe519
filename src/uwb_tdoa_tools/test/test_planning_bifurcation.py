from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.planning.bifurcation import (
    MOST_SUBSETS,
    Subsets,
    same_place,
    solutions,
)
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.planning.maps import Grid
from uwb_tdoa_tools.simulation.rooms import constellation, corners

SQUARE = Anchors.from_positions([[0, 0, 0.2], [4, 0, 0.2], [4, 4, 0.2], [0, 4, 0.2]])
SKEW = Anchors.from_positions([[0.4, 0.3, 0.2], [3.9, 0.9, 0.2], [3.1, 3.7, 0.2], [0.7, 2.6, 0.2]])


def tdoas(points, anchors):
    distances = np.linalg.norm(points[..., None, :] - anchors, axis=-1)
    return np.diff(distances, axis=-1)


def test_in_the_plane_it_is_the_polynomial_of_compagnoni_et_al():
    """|D_1 a_2 - D_2 a_1|^2 - |a_1 ^ a_2|^2, whose sign decides in Inverse Problems 30, 2014,
    035004.
    """
    points = np.column_stack([np.random.default_rng(0).uniform(-3, 7, (300, 2)), np.full(300, 0.2)])
    subsets = Subsets(SKEW, 2)
    for rows, got in zip(subsets.rows, subsets.discriminant(points).T):
        corner = SKEW.positions[rows]
        d = np.linalg.norm(points[:, None] - corner, axis=-1)
        (a1, a2), d1, d2 = corner[1:, :2] - corner[0, :2], d[:, 1] - d[:, 0], d[:, 2] - d[:, 0]
        wedge = a1[0] * a2[1] - a1[1] * a2[0]
        np.testing.assert_allclose(
            got, np.sum((d1[:, None] * a2 - d2[:, None] * a1) ** 2, axis=1) / wedge**2 - 1
        )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([2, 3]))
def test_a_mirrored_position_has_the_same_tdoas(seed, dimensions):
    rng = np.random.default_rng(seed)
    # of any heights
    anchors = Anchors.from_positions(rng.uniform([-4, -4, 0], [4, 4, 3], (dimensions + 1, 3)))
    try:
        subsets = Subsets(anchors, dimensions)
    except InputError:
        return  # nearly flat
    points = rng.uniform([-6, -6, -1], [6, 6, 4], (40, 3))
    row, _, mirror = subsets.mirrors(points)
    if dimensions == 2:
        np.testing.assert_array_equal(mirror[:, 2], points[row, 2])
    near = np.linalg.norm(mirror, axis=1) < 1e4
    np.testing.assert_allclose(
        tdoas(mirror[near], anchors.positions),
        tdoas(points[row[near]], anchors.positions),
        atol=1e-6,
    )
    assert len(row) == np.sum(subsets.discriminant(points) > 0.0)


def agreement(anchors, dimensions, points, chosen=None):
    subsets = Subsets(anchors, dimensions)
    predicted, agree = subsets.discriminant(points) < 0.0, []
    for q in range(len(subsets.rows)) if chosen is None else chosen:
        corner = anchors.positions[subsets.rows[q]]
        found = solutions(points, corner, dimensions)
        assert (
            (same_place(points[:, None], found, corner)).any(axis=1).all()
        )  # it finds at least the point
        unique = (np.isnan(found[..., 0]) | same_place(points[:, None], found, corner)).all(axis=1)
        agree.append(unique == predicted[:, q])
    assert 0.02 < np.mean(predicted) < 0.98
    return np.mean(agree)


AT_HEIGHTS = Anchors.from_positions([[0, 0, 0.2], [4, 0, 3.0], [4, 4, 0.4], [0, 4, 2.5]])
IN_SPACE = np.random.default_rng(2).uniform([-4, -4.5, -0.5], [4, 4.5, 3.5], (60, 3))


@pytest.mark.parametrize(
    ("anchors", "dimensions", "points", "chosen"),
    [  # clear of the diagonals
        (SQUARE, 2, Grid.slice((-0.95, 4.9), (-1.1, 5.2), 0.2, 0.45).points, None),
        (SKEW, 2, Grid.slice((-0.95, 4.9), (-1.1, 5.2), 0.2, 0.45).points, None),
        (AT_HEIGHTS, 2, Grid.slice((-1.93, 5.97), (-2.07, 6.03), 1.2, 0.7).points, None),
        (corners(), 3, IN_SPACE, range(0, 58, 9)),
    ],
    ids=["square", "skew", "known height", "space"],
)
def test_brute_force_agrees(anchors, dimensions, points, chosen):
    assert agreement(anchors, dimensions, points, chosen) >= 0.99


def test_the_flyable_area_of_the_paper():
    """Fig. 6c and sec. 5.1: an envelope about each anchor that holds at least all within 0.5 m of
    it; the middle and the middles of the sides are free; the same at all four corners.
    """
    subsets, installation = Subsets(SQUARE, 2), Installation(SQUARE, dimensions=2)
    assert len(subsets.rows) == 4 and subsets.left_out == 0
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
    assert (len(subsets.rows), subsets.left_out) == (58, 12)  # of 70: 6 faces and 6 diagonal planes
    with pytest.raises(InputError, match="nearly in one line"):
        Subsets(Anchors.from_positions([[0, 0, 0], [4, 0.02, 0], [8, 0, 0]]), 2)


def test_of_many_anchors_those_that_are_heard_together_are_chosen():
    subsets = Subsets(constellation("random-3-64"), 3)
    assert len(subsets.rows) + subsets.left_out <= MOST_SUBSETS
    assert len(subsets.rows) > MOST_SUBSETS / 3 and set(subsets.rows.ravel()) == set(range(64))
    span = (subsets.rows.max(axis=1) - subsets.rows.min(axis=1)) % 64
    assert (np.minimum(span, 64 - span) < 32).all()
    assert len({tuple(sorted(row)) for row in subsets.rows}) == len(subsets.rows)
    assert subsets.ambiguous(np.zeros((10, 3))).shape == (10,)
