# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import json

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import localize
from uwb_tdoa_tools.localizing.areas import (
    LEAST,
    PARKED,
    Track,
    circle_of,
    depth,
    parked,
    read_areas,
    sentences,
    visits,
)
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])


def track(x, y=2.0, std=0.05, circle=0.1):
    x = np.asarray(x, dtype=float)
    p = np.column_stack([x, np.broadcast_to(y, x.shape)])
    ones = np.ones(len(x))
    return Track(np.arange(len(x), dtype=float), p, std * ones, circle * ones)


@given(st.floats(0.0, 3.0), st.floats(0.01, 3.0), st.floats(0.0, np.pi))
@settings(max_examples=40, deadline=None)
def test_95_of_100_positions_are_in_the_circle(one, other, angle):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = turn @ np.diag([one**2, other**2]) @ turn.T
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(2), covariance, 20_000)
    inside = np.linalg.norm(drawn, axis=1) < circle_of(covariance[None])[0]
    assert inside.mean() == pytest.approx(0.95, abs=0.008)


@given(st.floats(-3.0, 7.0), st.floats(-3.0, 7.0))
def test_the_depth_is_the_distance_to_the_edge_and_negative_outside(x, y):
    outside = np.hypot(max(-x, 0.0, x - 4.0), max(-y, 0.0, y - 4.0))
    expected = -outside if outside else min(x, y, 4.0 - x, 4.0 - y)
    assert depth(SQUARE, np.array([[x, y]]))[0] == pytest.approx(expected, abs=1e-9)
    assert depth(SQUARE[::-1], np.array([[x, y]]))[0] == pytest.approx(expected, abs=1e-9)


def test_an_area_that_is_not_convex():
    corner = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [1.0, 1.0], [1.0, 4.0], [0.0, 4.0]])
    found = depth(corner, np.array([[0.5, 3.0], [3.0, 0.5], [3.0, 3.0]]))
    np.testing.assert_allclose(found, [0.5, 0.5, -2.0])


def test_a_tag_enters_and_leaves_once_although_it_wavers_at_the_edge():
    waver = 0.5 * LEAST * np.tile([1.0, -1.0], 10)
    found = list(
        visits(track(np.concatenate([[-2.0], waver, [2.0, 2.0], waver, [-2.0]])), {"a": SQUARE})
    )
    assert [(stay.area, stay.begin, stay.end) for stay in found] == [("a", 21.0, 43.0)]


def test_an_uncertain_tag_neither_enters_nor_leaves():
    x = [-3.0, 1.0, 1.0, -3.0]
    assert len(list(visits(track(x), {"a": SQUARE}))) == 1
    assert not list(visits(track(x, std=5.0), {"a": SQUARE}))
    assert not list(visits(track([2.0, -3.0], std=5.0), {"a": SQUARE}))


def test_a_visit_lasts_from_the_first_to_the_last_estimate_if_the_tag_never_was_outside():
    (stay,) = visits(track(np.full(30, 2.0)), {"a": SQUARE, "far": SQUARE + 100.0})
    assert (stay.begin, stay.end, stay.seconds, stay.x) == (0.0, 29.0, 29.0, 2.0)


def test_a_tag_that_stays_for_a_minute_is_parked_and_one_that_walks_is_not():
    x = np.concatenate(
        [np.arange(40.0), np.full(90, 40.0), 40.0 + np.arange(40.0), np.full(30, 80.0)]
    )
    (stay,) = parked(track(x))
    assert (stay.area, stay.x) == (PARKED, pytest.approx(40.0)) and 88.0 <= stay.seconds <= 92.0
    assert not list(parked(track(0.7 * np.arange(600.0))))
    assert not list(parked(track(0.02 * np.arange(200.0), circle=4.0)))  # it is lost
    assert list(sentences([stay])) == ["parked at (40.0, 2.0) m for 91 s"]


def test_without_estimates_there_are_no_stays():
    assert not list(visits(track([]), {"a": SQUARE})) and not list(parked(track([])))


@pytest.mark.parametrize(
    "text, named",
    [
        ("", "no areas"),
        ("dock: 3", "dock"),
        ("parked: [[0, 0], [1, 1], [2, 0]]", "another"),
        ("dock: [[0, 0], [1, 1]]", "dock"),
        ("dock: [[0, 0], [1, 1], [2]]", "dock"),
        ("dock: [[0, 0], [1, 1], [2, .nan]]", "line 1"),
        ("dock: [[0, 0], [1, 1], [2, left]]", "dock"),
    ],
)
def test_files_that_are_no_areas_are_refused_by_name(tmp_path, text, named):
    (tmp_path / "areas.yaml").write_text(text)
    with pytest.raises(InputError, match=named):
        read_areas(tmp_path / "areas.yaml")


@pytest.mark.slow
def test_two_tags_and_an_area_by_the_command(tmp_path, capsys):
    """One of two tags flies through the area; both are in one picture."""
    for name, seed in (("one", 1), ("two", 2)):
        flight = simulate(
            SimulationConfig(seed=seed, duration=14.0, floor_time=1.0, imu_rate=200.0, bias=False)
        )
        write_bag(flight, tmp_path / name)
    (tmp_path / "areas.yaml").write_text(
        "everywhere: [[-50, -50], [50, -50], [50, 50], [-50, 50]]\n"
        "nowhere: [[90, 90], [91, 90], [91, 91]]\n"
    )
    arguments = ["--areas", tmp_path / "areas.yaml", "--json", tmp_path / "all.json"]
    arguments = [tmp_path / "one", tmp_path / "two", *arguments, "--out", tmp_path / "out"]
    assert localize.main([*map(str, arguments)]) in (0, 1)
    for told in json.loads((tmp_path / "all.json").read_text())["flights"]:
        assert [stay["area"] for stay in told["stays"]] == ["everywhere"]
        assert told["stays"][0]["seconds"] > 8.0
        table = np.genfromtxt(tmp_path / "out" / f"{told['flight']}.csv", delimiter=",", names=True)
        assert (table["circle"] > 1.9 * np.maximum(table["std_x"], table["std_y"])).all()
    lines = (tmp_path / "out" / "one_stays.csv").read_text().splitlines()
    assert lines[0] == "area,begin,end,seconds,x,y" and lines[1].startswith('"everywhere",')
    assert (tmp_path / "out" / "tags.png").stat().st_size > 10_000
    assert "in everywhere for " in capsys.readouterr().out
