from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.planning import optimisation
from uwb_tdoa_tools.planning.bifurcation import Subsets
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.planning.layout import UNUSABLE, AnchorPlaces, Goal, Layout, lattice
from uwb_tdoa_tools.planning.maps import Demand
from uwb_tdoa_tools.planning.optimisation import descend, errors_and_slopes, failing_and_slopes
from uwb_tdoa_tools.simulation.constellations import corners

ROOM = np.array([-4.0, -4.5, 0.0]), np.array([4.0, 4.5, 3.0])
POINTS = lattice((-3.2, -3.1, 0.5), (2.9, 3.3, 2), 1.6)


def case(
    pairing="ring",
    link_std=0.0,
    dimensions=3,
    fixed=None,
    depth=0.0,
    objective="worst",
    criterion="pairings",
):
    installation = Installation(corners(), link_std=link_std, dimensions=dimensions)
    count, places = 6 if fixed is None else 2, AnchorPlaces.walls(*ROOM, depth=depth)
    layout = Layout(places, count, fixed, np.array([0.0, 0.0, 1.5]))
    x = layout.start(places.nearest(corners().positions[-count:]))
    x += np.random.default_rng(4).uniform(-0.1, 0.1, len(x))
    return (
        Goal(POINTS, installation, pairing, objective, Demand(criterion=criterion)),
        layout,
        np.clip(x, *np.transpose(layout.bounds)),
    )


CASES = [
    {},
    {"pairing": "all_pairs", "depth": 0.5},
    {"pairing": "ring_uncorrelated"},
    {"link_std": 0.05},
    {"dimensions": 2},
    {"fixed": Anchors([3, 5, 1, 9, 2], corners().positions[:5], corners().orientations[:5])},
]


@pytest.mark.parametrize("options", CASES, ids=lambda options: "-".join(options) or "plain")
def test_slopes_are_those_of_numerical_differentiation(options):
    goal, layout, x = case(**options)

    def bound(x):
        return goal.errors(layout.anchors(x))

    def failing(x):
        return failing_and_slopes(goal, layout, x, POINTS)[0]

    errors, slopes = errors_and_slopes(goal, layout, x, POINTS)
    np.testing.assert_allclose(errors, bound(x), rtol=1e-9)
    share, along = failing_and_slopes(goal, layout, x, POINTS)
    assert 0.05 < share < 0.95
    for k, step in enumerate(1e-5 * np.eye(len(x))):
        np.testing.assert_allclose(
            slopes[:, k], (bound(x + step) - bound(x - step)) / 2e-5, atol=2e-4 * slopes.max()
        )
        assert along[k] == pytest.approx(
            (failing(x + step) - failing(x - step)) / 2e-5, abs=1e-3 * np.abs(along).max()
        )


@pytest.mark.parametrize("dimensions", [2, 3])
def test_slopes_of_the_discriminant(dimensions):
    rng = np.random.default_rng(0)
    positions, weights = corners().positions + rng.normal(0.0, 0.2, (8, 3)), None

    def weighed(p):
        found = Subsets(Anchors.from_positions(p), dimensions).discriminant(POINTS)
        return np.sum(weights * found)

    subsets = Subsets(Anchors.from_positions(positions), dimensions)
    weights = rng.random((len(POINTS), len(subsets.rows)))
    got, step = subsets.slopes(POINTS, weights), 1e-6
    for at in np.ndindex(8, 3):
        moved = np.zeros((8, 3))
        moved[at] = step
        wanted = (weighed(positions + moved) - weighed(positions - moved)) / (2 * step)
        assert got[at] == pytest.approx(wanted, rel=1e-4, abs=1e-4 * np.abs(got).max())


@pytest.mark.parametrize("objective", ["worst", "mean"])
def test_a_descent_goes_down_and_stays_in_bounds(objective):
    goal, layout, x = case(objective=objective, criterion="round")
    found = descend(goal, layout, POINTS, x, 15)
    low, high = np.transpose(layout.bounds)
    assert (found >= low).all() and (found <= high).all()
    before, after = (goal.figures(layout.anchors(y))[objective] for y in (x, found))
    assert after < 0.9 * before


def test_anchors_that_locate_nothing_have_no_slopes():
    goal, layout, x = case()
    low = Layout(
        AnchorPlaces([[0, 0, 1, 6, 5, 1]]), 6, None, np.zeros(3)
    )  # all in one plane, with the points beside it
    x, points = low.start(np.random.default_rng(0).random((6, 2))), POINTS * [1, 1, 0] + [0, 0, 1]
    errors, slopes = errors_and_slopes(goal, low, x, points)
    assert (errors == UNUSABLE).all() and not slopes.any()
    with pytest.raises(InputError, match="plane"):
        failing_and_slopes(goal, low, x, points)
    with pytest.raises(InputError, match="hull"):
        failing_and_slopes(goal, low, np.zeros(6 * low.width), points)  # all in one place


@pytest.mark.parametrize("objective", ["worst", "mean"])
def test_a_descent_leaves_a_start_at_which_the_goal_cannot_be_told(objective):
    """A slope of zero that was made up there would be a valley: the descent would be over before it
    began.
    """
    goal, layout, x = case(objective=objective)
    level = np.column_stack(
        [np.linspace(0.05, 0.95, 6), np.full(6, 0.5)]
    )  # round the walls, half-way up
    x = layout.start(level)
    goal = replace(goal, points=POINTS * [1, 1, 0] + [0, 0, 1.5])
    with pytest.raises(InputError):
        failing_and_slopes(goal, layout, x, goal.points)
    found = descend(goal, layout, goal.points, x, 15)
    assert goal.score(layout.anchors(x)) >= UNUSABLE
    assert goal.score(layout.anchors(found)) < 1.0


@pytest.mark.parametrize("objective", ["worst", "mean"])
def test_a_descent_does_not_end_where_the_goal_cannot_be_told(objective, monkeypatch):
    """Told only within 0.02 of the start, which the first step leaves."""
    goal, layout, x = case(objective=objective, criterion="round")
    before = goal.figures(layout.anchors(x))[objective]

    def told_near(goal, layout, at, points):
        if np.abs(at - x).max() > 0.02:
            raise InputError("too far")
        return failing_and_slopes(goal, layout, at, points)

    monkeypatch.setattr(optimisation, "failing_and_slopes", told_near)
    found = descend(goal, layout, POINTS, x, 15)
    assert 1e-4 < np.abs(found - x).max() <= 0.02
    assert goal.figures(layout.anchors(found))[objective] < before


def test_a_start_that_no_shaking_helps_is_given_back():
    goal, _, _ = case()
    low = Layout(AnchorPlaces([[0, 0, 1, 6, 5, 1]]), 6, None, np.zeros(3))
    x = low.start(np.random.default_rng(0).random((6, 2)))
    np.testing.assert_array_equal(descend(goal, low, POINTS, x, 15), x)
