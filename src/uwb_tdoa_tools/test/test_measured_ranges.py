"""Measured ranges, as docs/sensors.md takes them: the filter finds the antenna delay of a tag that
nobody has calibrated.
"""

import csv
import gzip

import pytest

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.commands.convert import main as convert
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.scoring.evaluation import evaluate

COLUMNS = "time=time_s,anchor=to_id,range=range,pose_x=tag_pos_x,pose_y=tag_pos_y,pose_z=tag_pos_z"


@pytest.fixture(params=["1", "2"])
def tag(request, tmp_path, shared_data):
    """The flight of one tag of STAR-loc."""
    folder = shared_data / "ranging" / "starloc"
    with gzip.open(folder / "loop-2d-fast_s1" / "uwb.csv.gz", "rt", newline="") as file:
        head, *rows = csv.reader(file)
    with open(tmp_path / "tag.csv", "w", newline="") as file:
        csv.writer(file).writerows([head, *(row for row in rows if row[2] == request.param)])
    survey, bag = str(folder / "uwb_markers_v2.csv"), tmp_path / "tag.bag"
    assert (
        convert(
            [str(tmp_path / "tag.csv"), "--columns", COLUMNS, "--survey", survey, "--out", str(bag)]
        )
        == 0
    )
    return read_flight(bag)


def test_a_tag_of_which_nobody_knows_the_delay_is_located_and_honest(tag):
    """A filter that takes the tag for calibrated is a metre off, and certain."""
    row, wrong = (
        evaluate(tag, config)[0].row() for config in (None, FilterConfig(range_offset_std=0.0))
    )
    assert row["rmse_3d"] < 0.25 < 0.9 < wrong["rmse_3d"]
    assert row["nees_mean"] < 3.0 < 15.0 < wrong["nees_mean"]
