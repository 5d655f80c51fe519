# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The scale of a survey is found in TDOAs, before TDOAs are blamed; what they do not determine is
not named.
"""

import time

from flights import corners
import numpy as np
import pytest

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.survey import UNITS
from uwb_tdoa_ekf.core import workspace
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.ground import KnownHeight
from uwb_tdoa_ekf.core.memory import TDOA, new_state, structured
from uwb_tdoa_ekf.core.startup import locate, room_for
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules
from uwb_tdoa_ekf.monitoring.survey_scale import SurveyScale

ANCHORS = corners()
RADIO, SYSTEMATIC = 0.07, 0.1  # m, noise of a TDOA, and error of each pair


def flown(positions, seconds=25.0, rate=300.0, moving=1.0, sign=1.0, unit=1.0, seed=0):
    """{rule: Finding} of what StreamRules say with the anchors at `positions`, of TDOAs in the room
    of ANCHORS.
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


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("moving", [0.0, 1.0])
def test_a_right_survey_is_left_alone(seed, moving):
    found = flown(scaled(1.0), moving=moving, seed=seed)
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


ELSEWHERE = {
    "sign": dict(sign=-1.0),
    "nanoseconds": dict(unit=0.299792458),
    "millimetres": dict(unit=1e-3),
    "kilometres": dict(unit=1e3),
    "seconds": dict(unit=299792458.0),
}


@pytest.mark.parametrize("mistake", ELSEWHERE)
def test_mistakes_of_the_tdoas_are_not_blamed_on_the_survey(mistake):
    found = flown(scaled(1.0), **ELSEWHERE[mistake])
    assert "survey_scale" not in found and "anchor_scale" not in found


@pytest.mark.parametrize("unit", [0.299792458, 0.3048])
def test_tdoas_in_nanoseconds_or_feet_are_named(unit):
    found = flown(scaled(1.0), unit=unit)
    assert (
        "nanoseconds or in feet" in found["tdoa_unit"].cause and found["tdoa_unit"].position_wrong()
    )
    assert not found.keys() & {"tdoa_large", "tdoa_outliers"}


@pytest.mark.parametrize("name", ["exchanged", "mirrored", "turned", "planar", "another room"])
def test_other_mistakes_of_the_survey_are_not_called_a_scale(name):
    positions = scaled(1.0)
    if name == "exchanged":
        positions[[2, 5]] = positions[[5, 2]]
    elif name == "mirrored":
        positions[:, 0] *= -1.0
    elif name == "turned":
        positions = positions[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
    elif name == "planar":
        positions[:, 2] = 2.0
    else:
        positions = np.random.default_rng(3).uniform(-1.0, 1.0, (8, 3)) * [3.0, 5.0, 1.5]
    found = flown(positions)
    assert "survey_scale" not in found and "anchor_scale" not in found


def test_a_tag_that_stands_shows_a_clear_scale_only():
    assert "survey_scale" in flown(scaled(100.0), moving=0.0)


def test_a_snapshot_takes_little_time():
    """In a node one comes each second: a turn must not take 50 ms.

    Of the best of some tries: this machine does other things too.
    """
    snapshot = np.array([(a, b, 0.5 * (a - b)) for a in range(8) for b in range(8) if a != b])
    watch, taken = SurveyScale(ANCHORS.at(scaled(1000.0))), []
    for _ in range(6):
        begin = time.process_time()
        watch.add(snapshot)
        _ = watch.finding
        taken.append(time.process_time() - begin)
    assert min(taken) < 0.05


@pytest.mark.parametrize("factor", [1.0, 1e6])
def test_the_work_of_a_start_does_not_grow_with_the_survey(factor):
    """A coarse grid over the workspace: of a bound, however wide and high that is."""
    positions = scaled(factor)
    rows = np.arange(160)
    a, b = rows % 8, (rows + 1) % 8
    window = structured(TDOA, rows * 0.003, a, b, np.ones(160), np.zeros(160))
    config, state, box, taken = FilterConfig(), new_state(positions), np.empty((2, 3)), []
    workspace.set_bounds(state.record.extent, config.workspace_margin, box)
    for _ in range(4):
        begin = time.process_time()
        locate(
            window,
            state.anchors,
            box,
            config.parameters()[0],
            KnownHeight(np.nan, np.nan),
            room_for(1),
        )
        taken.append(time.process_time() - begin)
    assert min(taken) < 0.05
