# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Search for anchor layouts, and the maps and pictures of a plan."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_tools.bags.files import open_bag
from uwb_tdoa_tools.bags.messages import typestore
from uwb_tdoa_tools.planning import report
from uwb_tdoa_tools.planning.maps import (
    IMPRECISE,
    OUTSIDE,
    TWO_SOLUTIONS,
    Demand,
    Grid,
    Hall,
)
from uwb_tdoa_tools.planning.optimisation import (
    UNUSABLE,
    AnchorPlaces,
    Goal,
    Layout,
    lattice,
    optimise,
)
from uwb_tdoa_tools.planning.precision import Installation, Subsets
from uwb_tdoa_tools.planning.report import TOPICS, map_messages, write_messages
from uwb_tdoa_tools.scoring.plots import draw_labels
from uwb_tdoa_tools.simulation.config import corners, facing

# --- planning optimisation ---


ROOM = np.array([0.0, 0.0, 0.0]), np.array([6.0, 5.0, 3.0])


def test_places_of_all_shapes():
    places = AnchorPlaces([[0, 0, 0, 1, 2, 3], [5, 5, 5, 5, 5, 5], [7, 0, 1, 9, 0, 1]])
    assert places.numbers == 3
    p = places.positions(np.random.default_rng(0).random((4000, 3)))
    block, post, rail = (
        p[:, 0] <= 1,
        (p == 5).all(axis=1),
        (p[:, 0] >= 7) & (p[:, 1] == 0) & (p[:, 2] == 1),
    )
    assert (block | post | rail).all() and block.any() and rail.any()
    np.testing.assert_allclose(p[block].max(axis=0), [1, 2, 3], atol=0.05)
    np.testing.assert_allclose(
        AnchorPlaces([[5, 5, 5, 5, 5, 5]]).positions(np.array([0.3, 0.9])), [5, 5, 5]
    )


@pytest.mark.parametrize(
    "content",
    [
        "places: []",
        "places: [[1, 2, 3]]",
        "walls: 4",
        "- 1",
        "places: [[0, 0, 0, 1, 1, -1]]",
        "a: [",
        "places: [[0, 0, 0, 1, 1, x]]",
    ],
)
def test_bad_places(content, tmp_path):
    (tmp_path / "places.yaml").write_text(content)
    with pytest.raises(InputError, match="places"):
        AnchorPlaces.from_yaml(tmp_path / "places.yaml")


POINTS = lattice((-3.2, -3.1, 0.5), (2.9, 3.3, 2), 1.6)


def test_anchors_in_one_plane_with_the_points_locate_nothing():
    low = Layout(AnchorPlaces([[0, 0, 1, 6, 5, 1]]), 6, np.zeros(3))
    x, points = low.start(np.random.default_rng(0).random((6, 2))), POINTS * [1, 1, 0] + [0, 0, 1]
    nothing = Goal(POINTS, Installation(corners())).errors(low.anchors(x), points)
    assert (nothing == UNUSABLE).all()


def goal(installation, criterion="pairings"):
    points = lattice((1, 1, 0.5), (5, 4, 2), 1.5)
    return Goal(points, installation, Demand(criterion=criterion))


def bad_anchors():
    """Return anchors that are all in one corner of the room."""
    return facing(
        [[0, 0, 0.2], [1.5, 0, 2.5], [0, 1.5, 1.5], [0.5, 0, 1.0], [0, 0.7, 2.9]], (3, 2.5, 1.5)
    )


def test_a_layout_gets_better():
    aim = goal(Installation(bad_anchors()), "round")
    better = optimise(aim, AnchorPlaces.walls(*ROOM), 5, starts=2)
    before, after = aim.figures(bad_anchors()), aim.figures(better)
    assert after["worst"] < 0.7 * before["worst"] and after["failing"] <= before["failing"]
    p = better.positions
    assert (np.isin(p[:, 0], (0.0, 6.0)) | np.isin(p[:, 1], (0.0, 5.0))).all()
    assert np.isfinite(better.orientations).all() and len(set(better.ids)) == 5


def test_no_layout_at_all():
    aim = goal(Installation(bad_anchors()))
    with pytest.raises(InputError, match="no layout"):
        optimise(aim, AnchorPlaces([[0, 0, 1, 6, 5, 1]]), 5, starts=2)


# box around all flights above 0.3 m on 0422, 0425 and 0426
FLIGHTS = ((-1.6, -1.6, 0.3), (1.6, 1.6, 2.1))


@pytest.mark.slow
def test_the_surveyed_layout_is_beaten_by_a_fifth(shared_data):
    """The search places 8 anchors on the walls of 7 x 8 x 3 m.

    The worst bound in the volume of the shared flights falls by a fifth. The grid is not the grid
    of the search.
    """
    survey = read_survey(shared_data / "surveys" / "anchor_0425.txt")
    lower, upper = np.array([-3.05, -4.2, 0.0]), np.array([3.95, 3.8, 3.0])
    step = 0.09 * (np.array(FLIGHTS[1]) - FLIGHTS[0]).max()
    aim = Goal(lattice(*FLIGHTS, step), Installation(survey), demand=Demand())
    better = optimise(aim, AnchorPlaces.walls(lower, upper), 8, starts=8)
    fine = Goal(lattice(*FLIGHTS, 0.6 * step), Installation(survey), demand=Demand())
    before, after = fine.figures(survey), fine.figures(better)
    assert after["worst"] < 0.8 * before["worst"] and after["mean"] < before["mean"]
    assert after["failing"] <= before["failing"] + 0.02


# --- planning maps ---


def chart(installation, grid, demand):
    return Hall(installation, demand).chart(grid)


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
    for _ in range(2):  # the second file replaces the first
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


# --- planning plots ---


FLOWN = lattice((-1, -1, 0.5), (1, 1, 2), 1.0)


@pytest.fixture
def figures(monkeypatch):
    """Return [(figure, title)] of all pictures to be written."""
    made = []

    def write(path, figure, dpi):
        made.append((figure, figure.get_suptitle()))

    monkeypatch.setattr(report, "write_picture", write)
    return made


@pytest.fixture(scope="module")
def found():
    return chart(Installation(corners()), Grid.box((-3, -3, 0.5), (3, 3, 2.5), 0.5), Demand())


@pytest.mark.parametrize("flyable", [True, False])
def test_what_the_title_calls_hatched_is_hatched(found, flyable, figures):
    one = (
        replace(
            found, status=np.where(np.arange(len(found.status)) % 3 == 0, IMPRECISE, found.status)
        )
        if not flyable
        else found
    )
    report.plot_layouts(
        [("before", Installation(corners()), one), ("after", Installation(corners()), one)],
        FLOWN,
        None,
    )
    (figure, title) = figures[0]
    hatched = figure.findobj(lambda artist: any(getattr(artist, "hatches", ())))
    assert bool(hatched) == ("hatched" in title) == (not flyable)


def test_the_legend_states_the_share_of_each_state_that_there_is(found, figures):
    one = replace(found, status=np.where(np.arange(len(found.status)) % 4 == 0, IMPRECISE, 0))
    report.plot_flyable(corners(), one, None)
    (_, title), texts = (
        figures[0],
        [text.get_text() for text in figures[0][0].legends[0].get_texts()],
    )
    assert (
        "can be flown: 75 %" in texts
        and "imprecise: 25 %" in texts
        and not any("two solutions" in text for text in texts)
    )
    assert "75 % of the room" in title


@pytest.mark.slow
def test_every_picture_is_700_pixels_wide(found, tmp_path):
    anchors = corners()
    report.plot_precision(anchors, found, tmp_path / "precision.png")
    report.plot_flyable(anchors, found, tmp_path / "flyable.png", pairings=Installation(anchors))
    report.plot_heard(anchors, found, tmp_path / "heard.png")
    report.plot_layouts(
        [("before", Installation(anchors), found)] * 2, FLOWN, tmp_path / "layout.png"
    )
    for path in tmp_path.iterdir():
        assert plt.imread(path).shape[1] == 700, path.name


def test_labels_cover_neither_each_other_nor_anchors():
    rng = np.random.default_rng(3)
    figure, ax = plt.subplots(figsize=(7, 5))
    ax.set(xlim=(0, 20), ylim=(0, 14))
    places = np.vstack([[0, 0], [20, 0], [20, 14], [0, 14], rng.uniform([1, 1], [19, 13], (16, 2))])
    figure.draw_without_rendering()
    draw_labels(ax, list(range(20)), places, np.empty((0, 2)))
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in ax.texts]
    covered = sum(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])
    on_anchors = sum(box.contains(*dot) for box in boxes for dot in ax.transData.transform(places))
    plt.close(figure)
    assert len(boxes) >= 19 and covered == 0 and on_anchors == 0
