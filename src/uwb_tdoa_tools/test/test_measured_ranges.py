# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measured ranges, as docs/notebook/ranges.md takes them: the filter finds the
antenna delay of a tag that nobody has calibrated.
"""

import shutil

import pytest

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.readers import load_profile, read_by_profile
from uwb_tdoa_tools.readers.names import read_named_anchors
from uwb_tdoa_tools.scoring.evaluation import evaluate


@pytest.fixture(params=["1", "2"])
def tag(request, tmp_path, shared_data):
    """The flight of one tag of STAR-loc, without the inertial sensor."""
    folder = shared_data / "ranging" / "starloc"
    shutil.copy(folder / "loop-2d-fast_s1" / "uwb.csv.gz", tmp_path)
    survey = read_named_anchors(folder / "uwb_markers_v2.csv")
    return read_by_profile([tmp_path], load_profile("starloc"), survey, tag=request.param)


def test_a_tag_of_which_nobody_knows_the_delay_is_located_and_honest(tag):
    """A filter that takes the tag for calibrated is a metre off, and certain."""
    row, wrong = (
        evaluate(tag, config)[0].row() for config in (None, FilterConfig(range_offset_std=0.0))
    )
    assert row["rmse_3d"] < 0.25 < 0.9 < wrong["rmse_3d"]
    assert row["nees_mean"] < 3.0 < 15.0 < wrong["nees_mean"]
