import numpy as np
import pytest

from uwb_tdoa_tools.bags.files import open_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.planning.maps import Demand, Grid, chart
from uwb_tdoa_tools.planning.report import TOPICS, map_messages, write_messages
from uwb_tdoa_tools.simulation.constellations import corners

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
