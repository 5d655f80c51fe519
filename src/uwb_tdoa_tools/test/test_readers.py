# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import gzip
import re
import shlex

import numpy as np
import pytest
from recordings import ANCHORS, SURVEY, csv_text, log_bytes, small_flight

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.readers import read_flight


@pytest.fixture
def survey(tmp_path):
    file = tmp_path / "survey.csv"
    file.write_text(SURVEY)
    return file


@pytest.mark.parametrize(
    "content, kind",
    [
        (log_bytes(), "uSD log version 2"),
        (csv_text().encode(), "UTIL CSV"),
        (gzip.compress(csv_text().encode()), "UTIL CSV"),
    ],
)
def test_kind_is_found_by_content(tmp_path, survey, content, kind):
    file = tmp_path / "flight.txt"  # a meaningless name
    file.write_bytes(content)
    for given in (survey, str(survey), ANCHORS):
        flight = read_flight(file, given)
        assert flight.meta["format"] == kind
        np.testing.assert_array_equal(flight.anchors.positions, ANCHORS.positions)
    with pytest.raises(InputError, match="does not say where the anchors are; give a survey file"):
        read_flight(file)


def test_bag_brings_its_anchors_unless_others_are_given(tmp_path, survey):
    write_bag(small_flight(0.05), tmp_path / "flight.bag")
    assert np.isfinite(read_flight(tmp_path / "flight.bag").anchors.orientations[1]).all()
    (file,) = (tmp_path / "flight.bag").glob("*.mcap")
    assert np.isfinite(read_flight(file).anchors.orientations[1]).all()
    assert np.isnan(read_flight(tmp_path / "flight.bag", survey).anchors.orientations).all()


@pytest.mark.parametrize(
    "content, sentence",
    [
        (b"", "is empty"),
        (b"\x00\x01binary", "of no known kind"),
        (b"#ROSBAG V2.0\n", "is a bag of ROS 1; it needs a profile .*convert .*--suggest"),
        (b"ULog\x01\x12\x35\x01", "is a ULog of PX4; it needs a profile"),
        (b"time,value\n1,2\n", "is a CSV file of another tool; it needs a profile"),
        (b"17.5,3,base_link\r\n", "is a CSV file of another tool; it needs a profile"),
        (b"\x1f\x8bnothing that unpacks", "gzip data is damaged"),
        (gzip.compress(b"time,value\n", mtime=0), "is a CSV file of another tool"),
    ],
)
def test_foreign_files(tmp_path, survey, content, sentence):
    file = tmp_path / "file"
    file.write_bytes(content)
    with pytest.raises(InputError, match=sentence):
        read_flight(file, survey)


@pytest.mark.parametrize(
    "name", ["r1;touch x;.bag", "r1 $(touch x).bag", "r1'`touch x`.bag", "r1\n touch x.bag"]
)
def test_a_line_that_is_printed_to_be_copied_runs_nothing_else(tmp_path, survey, name):
    (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError) as refused:
        read_flight(tmp_path / name, survey)
    line = re.search(r"convert .* --suggest profile.yaml", str(refused.value), re.DOTALL)[0]
    assert shlex.split(line) == ["convert", str(tmp_path / name), "--suggest", "profile.yaml"]


def test_missing_and_directory(tmp_path, survey):
    with pytest.raises(InputError, match="does not exist"):
        read_flight(tmp_path / "nothing", survey)
    with pytest.raises(InputError, match="is a directory without metadata.yaml"):
        read_flight(tmp_path, survey)
