"""What anchors and motion let anybody know."""

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules
from uwb_tdoa_tools.checking import coverage

BOX = np.array([[x, y, z] for x in (0.0, 6.0) for y in (0.0, 7.0) for z in (0.2, 3.0)])
PLACES = np.random.default_rng(0).uniform([1.0, 1.0, 0.5], [5.0, 6.0, 2.5], (40, 3))


def windows(anchors, heard, seconds=20):
    """TdoaWindows of 100 TDOAs a second; heard(t, a, b) (n,) bool says which come through."""
    t = np.arange(0.0, seconds, 0.01)
    a = np.arange(len(t)) % len(anchors)
    b = (a + 1) % len(anchors)
    rows = heard(t, a, b)
    rules = StreamRules(anchors)
    rules.feed_tdoa(
        t[rows],
        np.full(rows.sum(), np.nan),
        anchors.ids[a[rows]],
        anchors.ids[b[rows]],
        0.1 * np.sin(t[rows]),
    )
    rules.finish()
    return list(rules.tdoa)


def said(positions=BOX, places=PLACES, heard=lambda t, a, b: t >= 0.0, seconds=20):
    anchors = Anchors.from_positions(positions)
    view = coverage.CoverageView(anchors, windows(anchors, heard, seconds), places)
    return {finding.rule: finding for rule in coverage.RULES for finding in rule(view)}


def test_a_room_with_anchors_around_it_is_healthy():
    assert said() == {}


def test_an_anchor_that_is_never_heard():
    assert "3" in said(heard=lambda t, a, b: (a != 3) & (b != 3))["anchor_missing"].cause


def test_an_anchor_that_is_hardly_heard():
    found = said(heard=lambda t, a, b: ((a != 3) & (b != 3)) | (np.floor(t * 100) % 32 == 3))
    assert "anchor 3" in found["anchor_rare"].cause and found["anchor_rare"].severity == "note"


def test_an_anchor_that_falls_silent():
    found = said(heard=lambda t, a, b: ((a != 3) & (b != 3)) | (t < 8.0) | (t > 16.0))[
        "anchor_silent"
    ]
    assert found.value == pytest.approx(8.0, abs=1.0) and "anchor 3" in found.cause


@pytest.mark.parametrize("axis", range(3))
def test_anchors_in_a_plane(axis):
    flat = BOX.copy()
    flat[:, axis] = 1.0 + 0.01 * np.arange(8)
    assert "anchors_flat" in said(positions=flat)


@pytest.mark.parametrize(
    ("axis", "at", "said_of"),
    [
        (2, 3.0, "tag_side:=below"),
        (2, 0.1, "tag_side:=above"),
        (0, 0.0, "tag_side:=+x or -p tag_side:=-x"),
        (1, 0.0, "tag_side:=+y"),
    ],
)
def test_anchors_in_a_plane_across_an_axis_need_a_side(axis, at, said_of):
    flat = BOX.copy()
    flat[:, axis] = at + 0.01 * np.arange(8)
    assert said_of in said(positions=flat)["side_unknown"].remedy


def test_of_a_hall_the_side_is_needed_where_those_that_are_heard_have_one_height():
    hall = np.array([[4.0 * k, 3.0 * (k % 2), 3.0 if k < 12 else 6.0] for k in range(24)])
    turn = lambda t, a, b: (a // 6 == np.floor(t / 5.0)) & (b // 6 == np.floor(t / 5.0))  # noqa: E731
    assert "tag_side:=below" in said(positions=hall, heard=turn)["side_unknown"].remedy


def test_where_something_measures_the_height_no_side_is_needed():
    flat = BOX.copy()
    flat[:, 2] = 3.0
    anchors = Anchors.from_positions(flat)
    view = coverage.CoverageView(
        anchors, windows(anchors, lambda t, a, b: t >= 0.0), PLACES, height_known=True
    )
    assert not list(coverage.unknown_side(view))


def test_anchors_with_z_down():
    assert "survey_z_down" in said(
        positions=BOX * [1.0, 1.0, -1.0], places=PLACES * [1.0, 1.0, -1.0]
    )


def test_a_tag_outside():
    assert "outside" in said(places=PLACES + [5.0, 0.0, 0.0])
    assert "outside" not in said(places=PLACES + [0.0, 0.0, 0.2])


def test_a_tag_that_does_not_move():
    assert said(places=PLACES[:1] + 0.01 * PLACES)["little_motion"].severity == "note"
    assert "little_motion" in said(seconds=5)
    assert said(places=np.empty((0, 3))) == {}  # it was not tried
