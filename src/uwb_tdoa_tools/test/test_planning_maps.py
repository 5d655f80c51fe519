import time

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.planning.bifurcation import Subsets
from uwb_tdoa_tools.planning.installation import PAIRINGS, Installation
from uwb_tdoa_tools.planning.maps import MOST_CELLS, OUTSIDE, TWO_SOLUTIONS, Demand, Grid, chart
from uwb_tdoa_tools.simulation.constellations import constellation, corners
from uwb_tdoa_tools.simulation.room import Room


def test_cells_are_cubes_that_cover_the_box():
    grid = Grid.box((0, 0, 0), (1.0, 0.25, 0.1), 0.1)
    assert grid.shape == (10, 3, 1) and grid.points.shape == (30, 3)
    np.testing.assert_allclose(grid.lower, [0.0, -0.025, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        grid.points[[0, 1, 3, -1]],
        [[0.05, 0.025, 0.05], [0.05, 0.125, 0.05], [0.15, 0.025, 0.05], [0.95, 0.225, 0.05]],
    )
    assert Grid.slice((0, 1), (0, 1), 1.2, 0.25).axes[2].tolist() == [1.2]
    layer = grid.layer(np.arange(30), 0)
    assert layer.shape == (3, 10) and layer[2, 9] == 29 and layer[1, 0] == 1


@pytest.mark.parametrize(
    ("upper", "step", "says"),
    [
        ((1, 1, 0), 0.1, "is empty"),
        ((1, 1, 1), 0.0, "step: 0"),
        ((1, 1, 1), float("nan"), "step: nan"),
        ((9, 9, 9), 1e-3, f"more than {MOST_CELLS}"),
    ],
)
def test_impossible_grids(upper, step, says):
    with pytest.raises(InputError, match=says):
        Grid.box((0, 0, 0), upper, step)


def test_a_chart_says_the_same_as_its_parts():
    installation = Installation(corners())
    found = chart(installation, Grid.box((-4, -4, 0), (4, 4, 3), 0.8), Demand(criterion="pairings"))
    points = found.grid.points
    hull, ambiguous = installation.inside_hull(points), Subsets(corners(), 3).ambiguous(points)
    np.testing.assert_array_equal(found.status == OUTSIDE, ~hull)
    np.testing.assert_array_equal(found.status == TWO_SOLUTIONS, hull & (ambiguous > 0.0))
    np.testing.assert_allclose(found.error, np.linalg.norm(found.std, axis=1))
    np.testing.assert_array_equal(found.flyable, hull & (ambiguous == 0))
    assert 0 < found.flyable.sum() < hull.sum() < len(points) and (found.heard == 8).all()
    volume = found.volume(installation.anchors, installation.dimensions)
    np.testing.assert_array_equal(volume.contains(points), found.flyable)
    assert volume.belongs_to(corners())


def test_a_whole_round_leaves_more_flyable_than_every_pairing_alone():
    grid = Grid.box((-4, -4, 0), (4, 4, 3), 0.8)
    alone, whole = (
        chart(Installation(corners()), grid, Demand(criterion=criterion))
        for criterion in ("pairings", "round")
    )
    assert (
        whole.flyable | ~alone.flyable
    ).all() and whole.flyable.sum() > 1.2 * alone.flyable.sum()


def cpu_seconds(anchors, shape, pairing):
    extent = np.ptp(anchors.positions, axis=0)
    step = max(extent[:2] / shape[:2])
    grid = Grid(anchors.positions.min(axis=0) + [0, 0, 0.3 * step], step, shape)
    installation = Installation(anchors, pairing=PAIRINGS[pairing](len(anchors)))
    began = time.process_time()
    found = chart(
        installation, grid, Demand(Room(grid.lower, grid.lower + grid.step * np.array(shape)))
    )
    assert np.isfinite(found.error).mean() > 0.9
    return time.process_time() - began


@pytest.mark.parametrize("pairing", PAIRINGS)
def test_a_slice_is_quick(pairing):
    """100 x 100 cells, 8 anchors, all maps, in CPU time: 0.2 - 0.25 s on a 2020s laptop core."""
    assert min(cpu_seconds(corners(), (100, 100, 1), pairing) for _ in range(3)) < 0.5


@pytest.mark.slow
def test_a_volume_is_quick():
    assert cpu_seconds(corners(), (50, 50, 50), "ring") < 20


@pytest.mark.slow
@pytest.mark.parametrize("pairing", PAIRINGS)
def test_64_anchors(pairing):
    cpu_seconds(constellation("random-3-64"), (50, 50, 1), pairing)
