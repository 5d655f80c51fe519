"""plan of a hall in which a tag hears the anchors within the radio's reach."""

from dataclasses import replace
import json

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_tools.commands.plan import main
from uwb_tdoa_tools.planning.goal import Goal
from uwb_tdoa_tools.planning.hall import Hall, summary
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.planning.maps import Grid, chart
from uwb_tdoa_tools.simulation.walls import Walls

REACH = 15.0  # m


def anchors_of(nx, ny, hole=None, spacing=8.0):
    """A grid of Anchors at three heights; those within 12 m of `hole` (2,) m are missing."""
    x, y = np.meshgrid(np.arange(nx) * spacing, np.arange(ny) * spacing)
    n = x.size
    positions = np.column_stack([x.ravel(), y.ravel(), np.array([0.5, 3.0, 5.5])[(np.arange(n) * 7 // 2) % 3]])
    if hole is not None:
        positions = positions[np.linalg.norm(positions[:, :2] - hole, axis=1) > 12.0]
    return Anchors.from_positions(positions)


def hall_of(anchors, reach=REACH):
    goal = Goal(
        np.empty((0, 3)), Installation(anchors.only([0, 1, 2, len(anchors) // 2 + 1, len(anchors) - 1])), "all_pairs", criterion="round"
    )
    return Hall(goal, anchors, reach)


def test_cells_hear_the_anchors_within_reach():
    anchors = anchors_of(6, 5)
    grid = Grid.slice((-4.0, 44.0), (-4.0, 36.0), 1.2, 8.0)
    found, heard = hall_of(anchors).chart(grid, jobs=1)
    away = np.linalg.norm(grid.points[:, None] - anchors.positions, axis=2)
    np.testing.assert_array_equal(heard, np.sum(away <= REACH, axis=1))
    about = summary(found, heard)
    assert sum(about["heard"].values()) == pytest.approx(1.0) and 0.0 < about["flyable_share"] < 1.0
    assert not found.flyable[heard < 4].any() and np.isinf(found.error[heard < 4]).all()


def test_cells_hear_nothing_through_a_wall():
    anchors, walls = anchors_of(6, 5), Walls(((20.5, -50.0, 20.5, 50.0, np.inf),))
    grid = Grid.slice((-4.0, 44.0), (-4.0, 36.0), 1.2, 8.0)
    hall = replace(hall_of(anchors), walls=walls)
    away = np.linalg.norm(grid.points[:, None] - anchors.positions, axis=2)
    beside = (grid.points[:, None, 0] > 20.5) == (anchors.positions[:, 0] > 20.5)
    np.testing.assert_array_equal([len(rows) for rows in hall.heard(grid.points)], np.sum((away <= REACH) & beside, axis=1))


def test_where_all_are_heard_it_is_the_chart_of_a_room():
    anchors = anchors_of(3, 3)
    grid, hall = Grid.slice((1.0, 15.0), (1.0, 15.0), 1.2, 2.0), hall_of(anchors, 100.0)
    found, heard = hall.chart(grid, jobs=1)
    whole = chart(hall.goal.installed(anchors), grid, "round")
    assert (heard == len(anchors)).all()
    np.testing.assert_allclose(found.error, whole.error, rtol=1e-9)


def test_one_more_anchor_is_proposed_near_the_hole():
    anchors = anchors_of(8, 8, hole=(28.0, 28.0))
    hall = hall_of(anchors)
    found, _ = hall.chart(Grid.slice((4.0, 52.0), (4.0, 52.0), 1.2, 4.0), jobs=1)
    added = hall.addition(found, 0.0)
    assert added["gain"] > 0.0 and np.hypot(*(np.array(added["position"][:2]) - 28.0)) < 2.0 * REACH


def test_the_command_writes_a_picture_and_says_who_hears_how_many(tmp_path, capsys):
    anchors_of(6, 5).to_yaml(tmp_path / "hall.yaml")
    command = [
        str(tmp_path / "hall.yaml"),
        "--radio-reach",
        "15",
        "--height",
        "1.2",
        "--step",
        "8",
        "--jobs",
        "1",
        "--walls",
        str(tmp_path / "walls.yaml"),
        "--out",
        str(tmp_path / "out"),
    ]
    (tmp_path / "walls.yaml").write_text("walls: [[20.5, -50, 20.5, 20]]\n")
    assert main(command) == 0
    assert "anchors heard" in capsys.readouterr().out
    assert {"hall.png", "plan.json", "flyable.npz", "plan.bag"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert json.loads((tmp_path / "out" / "plan.json").read_text())["map"]["heard"]


def test_a_hall_whose_anchors_all_hang_at_one_height_needs_a_side(tmp_path, capsys):
    anchors = anchors_of(6, 5)
    flat = anchors.at(np.column_stack([anchors.positions[:, :2], np.full(len(anchors), 5.0)]))
    points = Grid.slice((4.0, 36.0), (4.0, 28.0), 1.2, 8.0).points
    found = Hall(hall_of(anchors).goal, flat, REACH).side(points)
    assert found["tag_side"] == ["below"] and found["share"] > 0.9
    assert hall_of(anchors).side(points) is None


def test_what_a_hall_does_not_have_is_refused(tmp_path, capsys):
    anchors_of(6, 5).to_yaml(tmp_path / "hall.yaml")
    command = [str(tmp_path / "hall.yaml"), "--radio-reach", "15", "--out", str(tmp_path / "out")]
    assert main([*command, "--check"]) == 2 and "leave out --check" in capsys.readouterr().err
    assert main([command[0], *command[3:], "--walls", "walls.yaml"]) == 2 and "give --radio-reach too" in capsys.readouterr().err
    command[2] = "-1"
    assert main(command) == 2 and "radio reach" in capsys.readouterr().err
