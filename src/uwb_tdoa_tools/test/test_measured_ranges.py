# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measured ranges, as in docs/notebook/ranges.md.

The filter estimates the unknown antenna delay of the tag.
"""

import shutil

import pytest

from uwb_tdoa_bias.common.survey import read_named_anchors
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.choices import FRAME
from uwb_tdoa_tools.diagnosis.self_calibration import self_calibrate
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.readers import load_profile, read_by_profile
from uwb_tdoa_tools.scoring.evaluation import estimate_alignment, evaluate
from uwb_tdoa_tools.scoring.metrics import Score, radio_residuals


@pytest.fixture(params=["1", "2"])
def tag(request, tmp_path, shared_data):
    """Return the flight of one tag of STAR-loc, without the IMU."""
    folder = shared_data / "ranging" / "starloc"
    shutil.copy(folder / "loop-2d-fast_s1" / "uwb.csv.gz", tmp_path)
    survey = read_named_anchors(folder / "uwb_markers_v2.csv")
    return read_by_profile([tmp_path], load_profile("starloc"), survey, tag=request.param)


def test_a_tag_of_which_nobody_knows_the_delay_is_located_and_honest(tag):
    """Without an unknown delay, the filter is wrong by 0.7 m or more, and its covariance is too small."""
    row, wrong = (
        evaluate(tag, config)[0].row() for config in (None, FilterConfig(range_offset_std=0.0))
    )
    assert row["rmse_3d"] < 0.25 < 0.65 < wrong["rmse_3d"]
    assert row["nees_mean"] < 3.0 < 9.0 < wrong["nees_mean"]


@pytest.mark.slow
def test_a_survey_of_ranges_is_applied_and_the_position_gets_better(tag):
    """The flight determines the anchors without its ground truth."""
    found = self_calibrate([tag])
    assert found.why_not is None and found.before > 1.25 * found.left
    before, after = (
        evaluate(flight, effects=effects)[0].row()["rmse_3d"]
        for flight, effects in (
            (tag, None),
            (tag.replaced(anchors=found.anchors), found.effects),
        )
    )
    assert after < before


@pytest.mark.parametrize(("smoothed", "peer"), [(False, 0.454), (True, 0.111)])
def test_a_walk_is_nearer_to_the_truth_than_its_peer(shared_data, smoothed, peer):
    """Online and smoothed, after rigid alignment, without a calibration."""
    bag = shared_data / "ranging" / "isas" / "ISAS-Walk1.bag"
    walk = read_by_profile([bag], load_profile("isas"))
    run = FlightEstimator(smoothed=smoothed)(walk)
    truth = estimate_alignment(walk, run.odometry).applied_to(walk.truth, FRAME)
    score = Score(walk.name, run.odometry, truth, radio_residuals(walk, run), walk.tdoa.t)
    assert score.row()["rmse_3d"] < peer and score.row()["nees_mean"] < 3.0
