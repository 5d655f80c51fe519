# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""plan of a hall, in which a tag receives the anchors within the radio reach."""

from dataclasses import replace
import json

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_tools.cli import Progress
from uwb_tdoa_tools.commands.plan import main
from uwb_tdoa_tools.planning.maps import TOO_FEW, Demand, Grid, Hall
from uwb_tdoa_tools.planning.optimisation import best_addition, with_one
from uwb_tdoa_tools.planning.precision import Installation
from uwb_tdoa_tools.planning.report import summary
from uwb_tdoa_tools.planning.run import places_in_hall
from uwb_tdoa_tools.simulation.config import Room

REACH = 15.0  # m


def anchors_of(nx, ny, hole=None, spacing=8.0):
    """Return a grid of Anchors at three heights, without anchors within 12 m of `hole` (2,), m."""
    x, y = np.meshgrid(np.arange(nx) * spacing, np.arange(ny) * spacing)
    n = x.size
    positions = np.column_stack(
        [x.ravel(), y.ravel(), np.array([0.5, 3.0, 5.5])[(np.arange(n) * 7 // 2) % 3]]
    )
    if hole is not None:
        positions = positions[np.linalg.norm(positions[:, :2] - hole, axis=1) > 12.0]
    return Anchors.from_positions(positions)


def hall_of(anchors, reach=REACH, accuracy=1.0):
    room = Room(np.array([-4.0, -4.0, 0.0]), np.array([60.0, 60.0, 6.0]))
    return Hall(
        Installation(anchors, pairing="all_pairs", hall=True), Demand(room, accuracy), reach
    )


def test_cells_hear_the_anchors_within_reach():
    anchors = anchors_of(6, 5)
    grid = Grid.slice((-4.0, 44.0), (-4.0, 36.0), 1.2, 8.0)
    found = hall_of(anchors).chart(grid, jobs=1)
    heard = found.heard
    away = np.linalg.norm(grid.points[:, None] - anchors.positions, axis=2)
    np.testing.assert_array_equal(heard, np.sum(away <= REACH, axis=1))
    about = summary(found)
    assert sum(about["heard"].values()) == pytest.approx(1.0) and 0.0 < about["flyable_share"] < 1.0
    np.testing.assert_array_equal(found.status == TOO_FEW, heard < 4)
    assert np.isinf(found.error[heard < 4]).all()
    assert sum(
        about[f"{name}_share"]
        for name in ("flyable", "two_solutions", "imprecise", "too_few", "outside")
    ) == pytest.approx(1.0)


def test_where_all_are_heard_it_is_the_chart_of_a_room():
    anchors = anchors_of(3, 3)
    grid, hall = Grid.slice((1.0, 15.0), (1.0, 15.0), 1.2, 2.0), hall_of(anchors, 100.0)
    found, whole = hall.chart(grid, jobs=1), replace(hall, reach=np.inf).chart(grid)
    np.testing.assert_array_equal(found.heard, whole.heard)
    np.testing.assert_allclose(found.error, whole.error, rtol=1e-9)
    np.testing.assert_array_equal(found.status, whole.status)


@pytest.mark.slow
def test_one_more_anchor_is_proposed_near_the_hole_and_gains_what_is_promised():
    anchors = anchors_of(8, 8, hole=(28.0, 28.0))
    hall = hall_of(anchors, accuracy=0.4)
    grid = Grid.slice((4.0, 52.0), (4.0, 52.0), 1.2, 4.0)
    found = hall.chart(grid, jobs=1)
    places = places_in_hall(hall.demand.room, hall.reach)
    added = best_addition(hall, found, places, Progress("plan"))
    assert (
        added["gain"] > 0.02 and np.hypot(*(np.array(added["position"][:2]) - 28.0)) < 2.0 * REACH
    )
    assert np.linalg.norm(anchors.positions - added["position"], axis=1).min() >= 1.0
    again = hall.with_anchors(with_one(anchors, np.array(added["position"]))).chart(grid, jobs=1)
    assert again.flyable.mean() == pytest.approx(added["flyable_share"], abs=1e-12)
    assert summary(again)["bound_flyable"] == pytest.approx(added["bound_flyable"], abs=1e-12)


def test_what_differs_in_one_place_is_judged_as_the_whole_is():
    anchors = anchors_of(7, 6)
    hall, points = hall_of(anchors), Grid.slice((-4.0, 52.0), (-4.0, 44.0), 1.2, 2.0).points
    before, rest = hall.judge(points)[0], anchors.only(np.delete(np.arange(len(anchors)), 17))
    changed, anew = (
        hall.changed(before, points, rest, anchors.positions[[17]]),
        hall.with_anchors(rest).judge(points)[0],
    )
    np.testing.assert_array_equal(changed.status, anew.status)
    np.testing.assert_allclose(changed.error, anew.error, rtol=1e-9)
    assert (changed.status != before.status).any()


@pytest.mark.slow
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
    assert {
        "heard.png",
        "precision.png",
        "flyable.png",
        "plan.json",
        "flyable.npz",
        "plan_bag",
    } == {path.name for path in (tmp_path / "out").iterdir()}
    assert json.loads((tmp_path / "out" / "plan.json").read_text())["map"]["heard"]


def test_a_hall_whose_anchors_all_hang_at_one_height_needs_a_side(tmp_path, capsys):
    anchors = anchors_of(6, 5)
    flat = anchors.at(np.column_stack([anchors.positions[:, :2], np.full(len(anchors), 5.0)]))
    points = Grid.slice((4.0, 36.0), (4.0, 28.0), 1.2, 8.0).points
    found = hall_of(flat).side(points)
    assert found["tag_side"] == ["below"] and found["share"] > 0.9
    assert hall_of(anchors).side(points) is None


def test_what_a_hall_does_not_have_is_refused(tmp_path, capsys):
    anchors_of(6, 5).to_yaml(tmp_path / "hall.yaml")
    command = [str(tmp_path / "hall.yaml"), "--radio-reach", "15", "--out", str(tmp_path / "out")]
    assert main([*command, "--improve"]) == 2
    assert "leave out --improve" in capsys.readouterr().err
    assert (
        main([command[0], *command[3:], "--walls", "walls.yaml"]) == 2
        and "give --radio-reach too" in capsys.readouterr().err
    )
    assert (
        main([*command, "--flyable", "pairings"]) == 2
        and "every anchor is heard" in capsys.readouterr().err
    )
    command[2] = "-1"
    assert main(command) == 2 and "radio reach" in capsys.readouterr().err


def test_the_reach_is_asked_for_where_a_room_is_larger_than_30_m(tmp_path, capsys):
    anchors_of(6, 5).to_yaml(tmp_path / "hall.yaml")
    assert main([str(tmp_path / "hall.yaml"), "--out", str(tmp_path / "out")]) == 2
    assert "40 m long" in (said := capsys.readouterr().err) and "--radio-reach 25" in said
    assert (
        main(["--hall", "--room", "0", "40", "0", "20", "0", "6", "--out", str(tmp_path / "out")])
        == 2
    )
    assert "--radio-reach 25" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_anchors_of_a_hall_are_designed_and_give_what_was_wanted(tmp_path, capsys):
    """The design is the smallest sufficient number of anchors, behind a wall too.

    A table compares other numbers of anchors. A plan of the design gives the same figures.
    """
    (tmp_path / "walls.yaml").write_text("walls: [[14, 0, 14, 10]]\n")
    asked = [
        "--room",
        "0",
        "28",
        "0",
        "18",
        "0",
        "6",
        "--height",
        "1.2",
        "--step",
        "1.5",
        "--radio-reach",
        "14",
        "--accuracy",
        "0.5",
    ]
    asked += ["--walls", str(tmp_path / "walls.yaml"), "--jobs", "1"]
    assert main(["--hall", *asked, "--share", "0.9", "--out", str(tmp_path / "out")]) == 0
    found, said = json.loads((tmp_path / "out" / "plan.json").read_text()), capsys.readouterr().out
    anchors = read_survey(tmp_path / "out" / "hall.yaml")
    steps = found["design"]
    assert found["map"]["flyable_share"] >= 0.9 and len(anchors) == found["anchors"]
    counts = [step["count"] for step in steps]
    assert (
        counts == sorted(counts)
        and counts[0] < len(anchors) <= counts[-1]
        and steps[0]["share"] < 0.9
    )
    assert (
        np.isfinite(anchors.orientations).all()
        and (anchors.positions >= 0.0).all()
        and (anchors.positions <= [28.0, 18.0, 6.0]).all()
    )
    assert f"{len(anchors):8d}" in said and "wanted 90 %" in said and "low and" in said
    assert (
        main([str(tmp_path / "out" / "hall.yaml"), *asked, "--out", str(tmp_path / "again")]) == 0
    )
    again = json.loads((tmp_path / "again" / "plan.json").read_text())
    assert again["map"]["flyable_share"] == pytest.approx(found["map"]["flyable_share"], abs=0.001)


@pytest.mark.slow
def test_a_hall_that_cannot_be_had_is_refused_with_what_can(tmp_path, capsys):
    asked = [
        "--hall",
        "--room",
        "0",
        "20",
        "0",
        "20",
        "0",
        "6",
        "--height",
        "1.2",
        "--step",
        "2",
        "--radio-reach",
        "14",
    ]
    assert main([*asked, "--accuracy", "0.001", "--jobs", "1", "--out", str(tmp_path / "out")]) == 2
    assert (
        "cannot be flown at an accuracy of 0.001 m" in (said := capsys.readouterr().err)
        and "--accuracy" in said
    )
    for wrong, named in (
        (["--share", "1.5"], "share: 1.5"),
        (["--accuracy", "0"], "accuracy: 0"),
        (["anchors.yaml"], "ANCHORS"),
    ):
        assert (
            main([*asked, *wrong, "--out", str(tmp_path / "out")]) == 2
            and named in capsys.readouterr().err
        )
    assert main(["--out", str(tmp_path / "out")]) == 2 and "or --hall" in capsys.readouterr().err
    assert (
        main(["--hall", "--radio-reach", "14", "--out", str(tmp_path / "out")]) == 2
        and "--room X0 X1" in capsys.readouterr().err
    )
