import time

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.files import open_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.planning.bifurcation import Subsets
from uwb_tdoa_tools.planning.installation import PAIRINGS, Installation
from uwb_tdoa_tools.planning.maps import MOST_CELLS, OUTSIDE, TWO_SOLUTIONS, Demand, Grid, chart
from uwb_tdoa_tools.planning.report import TOPICS, map_messages, write_messages
from uwb_tdoa_tools.simulation.rooms import Room, corners


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


INSTALLATION = Installation(corners())
CHART = chart(INSTALLATION, Grid.box((-4, -4.5, 0), (4, 4.5, 3), 0.5), Demand(criterion="pairings"))


def test_the_flyable_slice():
    grid = map_messages(CHART, INSTALLATION.anchors)["plan/flyable"]
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (16, 18, 0.5)
    origin = grid.info.origin.position
    assert (origin.x, origin.y, origin.z) == pytest.approx(
        (-4.0, -4.5, 1.75)
    ) and grid.header.frame_id == "map"
    data = grid.data.reshape(18, 16)
    for (x, y), wanted in (
        ((0.0, 0.0), 0),
        ((3.3, 3.8), 50),
        ((3.8, 0.0), 100),
        ((-3.3, 3.8), 50),
        ((0.1, 4.4), 100),
    ):
        assert data[int((y + 4.5) / 0.5), int((x + 4.0) / 0.5)] == wanted
    middle = CHART.grid.points[:, 2] == CHART.grid.axes[2][3]
    assert np.sum(data == 0) == CHART.flyable[middle].sum()


def test_the_precision_slice_is_in_centimetres():
    found = map_messages(CHART, INSTALLATION.anchors)["plan/precision"]
    layer = CHART.grid.layer(CHART.error, 3)
    np.testing.assert_allclose(
        found.data.reshape(layer.shape), np.minimum(100 * layer, 100), atol=0.51
    )


def test_markers_show_the_surface_and_the_anchors():
    cubes, spheres, *texts = map_messages(CHART, INSTALLATION.anchors)["plan/markers"].markers
    assert [text.text for text in texts] == [str(i) for i in range(8)] and len(spheres.points) == 8
    shown = {(round(p.x, 6), round(p.y, 6), round(p.z, 6)) for p in cubes.points}
    flyable = CHART.flyable.reshape(CHART.grid.shape)
    for index, p in zip(np.ndindex(flyable.shape), CHART.grid.points.round(6).tolist()):
        around = [
            tuple(np.add(index, step))
            for step in np.vstack([np.eye(3, dtype=int), -np.eye(3, dtype=int)])
        ]
        open_side = any(
            min(i) < 0 or (np.array(i) >= flyable.shape).any() or not flyable[i] for i in around
        )
        assert (tuple(p) in shown) == (flyable[index] and open_side)
    assert len(cubes.colors) == len(cubes.points)


def test_nothing_flyable_is_no_error():
    outside = chart(
        INSTALLATION, Grid.box((10, 10, 0), (11, 11, 1), 0.5), Demand(criterion="pairings")
    )
    assert map_messages(outside, INSTALLATION.anchors)["plan/markers"].markers[0].points == []


def test_a_bag_of_them(tmp_path):
    found = map_messages(CHART, INSTALLATION.anchors)
    for _ in range(2):  # the second replaces the first
        write_messages(found, tmp_path / "plan.bag")
    with open_bag(tmp_path / "plan.bag") as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == {
            f"/{name}": kind for name, kind in TOPICS.items()
        }
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            assert qos.durability.name == "TRANSIENT_LOCAL"
        for connection, *_, data in reader.messages():
            back = typestore().deserialize_cdr(data, connection.msgtype)
            if connection.topic == "/plan/flyable":
                np.testing.assert_array_equal(back.data, found["plan/flyable"].data)
