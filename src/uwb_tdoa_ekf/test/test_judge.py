# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots of TDOAs show which mistake of the survey, or of all TDOAs, beats its rivals.

What they do not determine is not named.
"""

from flights import corners
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import UNITS, Anchors
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core import workspace
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.ground import KnownHeight
from uwb_tdoa_ekf.core.memory import TDOA, new_state, structured
from uwb_tdoa_ekf.core.startup import locate, room_for
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules

ANCHORS = corners()
RADIO, SYSTEMATIC = 0.07, 0.1  # m, noise of a TDOA, and error of each pair


def flown(positions, seconds=25.0, rate=300.0, moving=1.0, sign=1.0, unit=1.0, seed=0):
    """Return {rule: Finding} of StreamRules with anchors at `positions`.

    The TDOAs come from a tag in the room of ANCHORS.
    """
    rng = np.random.default_rng(seed)
    t = 100.0 + np.arange(int(seconds * rate)) / rate
    a = np.arange(len(t)) % 8
    b = (a + 1) % 8
    path = moving * np.sin(np.outer(t, [0.5, 0.7, 0.3])) * [2.5, 2.5, 1.0]
    p = ANCHORS.positions.mean(axis=0) + (1.0 - moving) * np.array([1.5, -2.0, -1.2]) + path
    d = (
        tdoa(p, ANCHORS.positions[a], ANCHORS.positions[b])
        + SYSTEMATIC * rng.normal(size=8)[a]
        + RADIO * rng.normal(size=len(t))
    )
    rules = StreamRules(ANCHORS.at(positions))
    rules.feed_tdoa(t, t + 0.002, ANCHORS.ids[a], ANCHORS.ids[b], sign * d / unit)
    rules.finish()
    return {finding.rule: finding for finding in rules.findings()}


def scaled(factor):
    return ANCHORS.positions * factor


ROOM = ANCHORS.positions
WRONG = {"survey_scale", "anchor_scale", "tdoa_sign", "ids_exchanged", "tdoa_unit"}
# Cases without a wrong scale: (positions of the survey, options of `flown`).
NO_SCALE = {
    "a right survey": (ROOM, {}),
    "a right survey again": (ROOM, {"seed": 1}),
    "a tag that stands": (ROOM, {"moving": 0.0}),
    "a tag that stands again": (ROOM, {"moving": 0.0, "seed": 1}),
    "sign of the TDOAs": (ROOM, {"sign": -1.0}),
    "TDOAs in nanoseconds": (ROOM, {"unit": 0.299792458}),
    "TDOAs in millimetres": (ROOM, {"unit": 1e-3}),
    "TDOAs in kilometres": (ROOM, {"unit": 1e3}),
    "TDOAs in seconds": (ROOM, {"unit": 299792458.0}),
    "exchanged": (ROOM[[0, 1, 5, 3, 4, 2, 6, 7]], {}),
    "mirrored": (ROOM * [-1.0, 1.0, 1.0], {}),
    "turned": (ROOM[:, [1, 0, 2]] * [-1.0, 1.0, 1.0], {}),
    "planar": (ROOM * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0], {}),
    "another room": (
        np.random.default_rng(3).uniform(-1.0, 1.0, (8, 3)) * [3.0, 5.0, 1.5],
        {},
    ),
}


@pytest.mark.parametrize("name", NO_SCALE)
def test_a_right_survey_and_other_mistakes_are_not_called_a_scale(name):
    positions, options = NO_SCALE[name]
    found = flown(positions, **options)
    assert "survey_scale" not in found and "anchor_scale" not in found


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_of_the_survey_is_named_and_tdoas_are_not_blamed(unit):
    found = flown(scaled(UNITS[unit]))
    assert found.keys() == {"survey_scale"}, found
    assert unit in found["survey_scale"].cause and found["survey_scale"].value == pytest.approx(
        UNITS[unit]
    )


@pytest.mark.parametrize("factor", [25.0, 0.1, 0.001])
def test_any_other_factor_is_named_about(factor):
    found = flown(scaled(factor))
    assert found.keys() == {"survey_scale"}, found
    assert found["survey_scale"].value == pytest.approx(factor, rel=0.3)


@pytest.mark.parametrize(("unit", "row"), [("millimetres", 1), ("inches", 6), ("feet", 1)])
def test_one_anchor_in_another_unit_is_named(unit, row):
    positions = scaled(1.0)
    positions[row] *= UNITS[unit]
    found = flown(positions)
    assert found.keys() == {"anchor_scale"}, found
    assert f"anchor {ANCHORS.ids[row]} is in {unit}" in found["anchor_scale"].cause


@pytest.mark.parametrize("unit", [0.299792458, 0.3048])
def test_tdoas_in_nanoseconds_or_feet_are_named(unit):
    found = flown(scaled(1.0), unit=unit)
    assert (
        "nanoseconds or in feet" in found["tdoa_unit"].cause and found["tdoa_unit"].position_wrong()
    )
    assert not found.keys() & {"tdoa_large", "tdoa_outliers"}


def test_a_tag_that_stands_shows_a_clear_scale_only():
    assert "survey_scale" in flown(scaled(100.0), moving=0.0)


@pytest.mark.usefixtures("must_end")
def test_the_work_of_a_start_does_not_grow_with_the_survey():
    """The number of points of the coarse grid has a bound, however large the workspace is."""
    rows = np.arange(160)
    a, b = rows % 8, (rows + 1) % 8
    window = structured(TDOA, rows * 0.003, a, b, np.ones(160), np.zeros(160))
    config, state, box = FilterConfig(), new_state(scaled(1e6)), np.empty((2, 3))
    workspace.set_bounds(state.record.extent, config.workspace_margin, box)
    assert np.ptp(box, axis=0).min() > 1e6
    locate(
        window,
        state.anchors,
        box,
        config.parameters()[0],
        KnownHeight(np.nan, np.nan),
        room_for(1),
    )


def judged(positions, d_of, seconds=25.0, rate=200.0):
    """Return {rule: Finding} of a tag among anchors at `positions` (8, 3) m as surveyed.

    d_of : callable of the path (n, 3) m and both rows (n,) of the anchors; the TDOAs, m
    """
    t = np.arange(int(seconds * rate)) / rate
    a = np.arange(len(t)) % len(positions)
    b = (a + 1 + np.arange(len(t)) // len(positions) % (len(positions) - 1)) % len(positions)
    p = [0.5, 0.3, 1.2] + np.sin(np.outer(t, [0.5, 0.7, 0.3])) * [1.8, 1.8, 0.4]
    d = d_of(p, a, b) + RADIO * np.random.default_rng(1).normal(size=len(t))
    rules = StreamRules(Anchors.from_positions(positions))
    rules.feed_tdoa(t, t + 0.002, a, b, d)
    rules.finish()
    return {finding.rule: finding for finding in rules.findings()}


ANGLE = 0.25 * np.pi * np.arange(8)
DETERMINE_LITTLE = {
    "a line": np.column_stack([np.full(6, 3.0), np.linspace(-5.0, 5.0, 6), np.full(6, 1.5)]),
    "a ceiling": np.column_stack([5.0 * np.cos(ANGLE), 4.0 * np.sin(ANGLE), np.full(8, 2.8)]),
}


@pytest.mark.parametrize("name", DETERMINE_LITTLE)
def test_anchors_that_determine_little_are_not_blamed(name):
    places = DETERMINE_LITTLE[name]
    assert not judged(places, lambda p, a, b: tdoa(p, places[a], places[b])).keys() & WRONG


def test_anchors_late_behind_a_body_are_no_scale_of_the_survey():
    room = ROOM - ROOM.mean(axis=0) + [0.0, 0.0, 1.5]

    def shadowed(p, a, b):
        ahead = np.gradient(p, axis=0)
        late = [np.sum((room[rows] - p) * ahead, axis=1) < 0.0 for rows in (a, b)]
        return tdoa(p, room[a], room[b]) + 0.4 * (late[1].astype(float) - late[0])

    assert not judged(room, shadowed).keys() & WRONG


def test_two_exchanged_anchors_are_named():
    places = ROOM[[0, 6, 2, 3, 4, 5, 1, 7]]
    found = flown(places)
    one, two = ANCHORS.ids[[1, 6]]
    assert found["ids_exchanged"].cause == f"two anchors are exchanged, {one} and {two}"
