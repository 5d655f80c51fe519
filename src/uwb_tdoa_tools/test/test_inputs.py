# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace
import os
from pathlib import Path

import numpy as np
import pytest
from recordings import ROWS, SURVEY, log_bytes, small_flight

from uwb_tdoa_bias.common.errors import FOLDER_DEPTH, InputError, TooMuch
from uwb_tdoa_bias.common.files import read_arrays, read_bytes
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_bias.common.survey import read_named_anchors, read_survey
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.bags.files import new_bag, open_bag
from uwb_tdoa_tools.bags.messages import typestore
from uwb_tdoa_tools.readers import inputs, read_flight
from uwb_tdoa_tools.readers.inputs import Reading, find_flights, require_tdoas, survey_for


def make(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("x")


@pytest.fixture
def surveys(tmp_path):
    folder = tmp_path / "surveys"
    make(
        folder,
        *(
            f"anchor_{key}"
            for key in ("0422.txt", "0425.txt", "const1.csv", "const10.csv", "const3.csv")
        ),
    )
    return folder


@pytest.mark.parametrize(
    "recording, survey",
    [
        ("flights/0422/0422-log00", "anchor_0422.txt"),
        ("flights/0425/TDOA2/0425-traj1", "anchor_0425.txt"),
        ("0422/log00", "anchor_0422.txt"),  # the folder determines the survey
        ("backup-0422/flights/0425/traj1", "anchor_0425.txt"),  # the last match counts
        ("util/const1-trial1-tdoa2.csv.gz", "anchor_const1.csv"),
        # the longer key is the better match
        ("util/const10-trial1-tdoa2.csv.gz", "anchor_const10.csv"),
        ("util/const3-trial2-tdoa3-traj1.csv", "anchor_const3.csv"),
    ],
)
def test_a_folder_of_surveys_serves_the_recordings_whose_path_has_the_key(
    tmp_path, surveys, recording, survey
):
    assert survey_for(tmp_path / recording, surveys) == surveys / survey


def test_the_longest_key_wins_where_keys_overlap(tmp_path, surveys):
    """This is documented in the help and in the docstring."""
    make(surveys, "anchor_25.txt")
    assert survey_for(tmp_path / "0425" / "traj1", surveys) == surveys / "anchor_0425.txt"


def test_no_survey_that_fits_is_told_with_those_there_are(tmp_path, surveys):
    with pytest.raises(InputError, match="holds none of .*const1"):
        survey_for(tmp_path / "0607" / "log1", surveys)


def test_files_that_are_no_surveys_do_not_serve(tmp_path, surveys):
    make(surveys, "README.md", "notes-log1.txt", "log1.txt")
    with pytest.raises(InputError):
        survey_for(tmp_path / "0607" / "log1", surveys)


def test_one_survey_serves_all(tmp_path):
    make(tmp_path, "here.txt")
    assert survey_for(tmp_path / "any" / "thing", tmp_path / "here.txt") == tmp_path / "here.txt"
    assert survey_for(tmp_path / "any" / "thing", None) is None


def test_folders_are_searched_in_order_and_hidden_files_left_out(tmp_path):
    make(tmp_path / "b", "2", "1", "deep/er/0", ".hidden", ".cache/x")
    make(tmp_path / "a", "9")
    found = find_flights([tmp_path / "b", tmp_path / "a"])
    assert [str(path.relative_to(tmp_path)) for path, _ in found] == [
        "b/1",
        "b/2",
        "b/deep/er/0",
        "a/9",
    ]
    assert [survey for _, survey in found] == [None] * 4


def test_a_bag_that_no_survey_of_a_folder_fits_keeps_its_own_anchors_and_says_so(
    tmp_path, surveys, capsys, monkeypatch
):
    monkeypatch.setattr(inputs, "_REPORTED", set())  # reported earlier in this process
    make(tmp_path / "flights", "bag1/metadata.yaml", "bag1/bag1_0.mcap", "0422-log")
    for name, magic in (
        ("loose.mcap", b"\x89MCAP0\r\n"),
        ("old", b"SQLite format 3\0"),
    ):  # the content identifies a bag, not its name
        (tmp_path / "flights" / name).write_bytes(magic)
    found = find_flights([str(tmp_path / "flights")], surveys)
    assert [(path.name, survey and survey.name) for path, survey in found] == [
        ("0422-log", "anchor_0422.txt"),
        ("bag1", None),
        ("loose.mcap", None),
        ("old", None),
    ]
    assert find_flights([tmp_path / "flights" / "bag1"]) == [(tmp_path / "flights" / "bag1", None)]
    said = capsys.readouterr().err
    assert said.count("fits; the anchors that it holds count") == 1 == len(said.splitlines())
    make(tmp_path / "flights", "0422/bag/metadata.yaml")
    assert (
        find_flights([tmp_path / "flights" / "0422"], surveys)[0][1] == surveys / "anchor_0422.txt"
    )


def test_nothing_there_is_bad_input(tmp_path):
    with pytest.raises(InputError, match="nowhere: does not exist"):
        find_flights([tmp_path / "nowhere"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: holds no recording"):
        find_flights([tmp_path / "empty"])


def test_of_more_flights_than_are_to_be_held_some_are_drawn(tmp_path, capsys, monkeypatch):
    paths = [tmp_path / f"flight-{k}" for k in range(9)]
    for path in paths:
        path.write_bytes(log_bytes())  # holds two TDOAs
    (tmp_path / "survey.csv").write_text(SURVEY)
    reading, names = Reading(tmp_path / "survey.csv"), [path.name for path in paths]
    assert [flight.name for flight in reading.flights(paths, 18)] == names
    assert not capsys.readouterr().err
    read, read_one = [], Reading.read
    monkeypatch.setattr(
        Reading, "read", lambda self, recording: read.append(recording) or read_one(self, recording)
    )
    drawn = [flight.name for flight in reading.flights(paths, 7)]
    assert len(drawn) == 3 and drawn == sorted(drawn) and set(drawn) < set(names) and len(read) == 4
    assert "3 of 9 flights, drawn at random, are taken" in capsys.readouterr().err
    assert [flight.name for flight in reading.flights(paths, 7)] == drawn
    assert len(reading.flights(paths, 1)) == 1


def test_what_is_missing_in_a_recording_is_told(tmp_path, capsys):
    (tmp_path / "cut").write_bytes(log_bytes()[:-9])
    (tmp_path / "survey.csv").write_text(SURVEY)
    with pytest.raises(InputError, match="cut or damaged: .*--salvage"):
        Reading(tmp_path / "survey.csv").one(tmp_path / "cut")
    flight = Reading(tmp_path / "survey.csv", salvage=True).one(tmp_path / "cut")
    assert len(flight.tdoa) == 2 and "cut: cut or damaged: " in capsys.readouterr().err


def test_a_bag_without_anchors_takes_the_survey_that_is_given(tmp_path):
    flight = small_flight()
    write_bag(flight, tmp_path / "whole")
    with open_bag(tmp_path / "whole") as reader, new_bag(tmp_path / "bag") as writer:
        there = [
            connection for connection in reader.connections if connection.topic != "/uwb/anchors"
        ]
        to = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=typestore()) for c in there
        }
        for connection, stamp, data in reader.messages(there):
            writer.write(to[connection.topic], stamp, data)
    (tmp_path / "survey.csv").write_text(SURVEY)
    reading = Reading(tmp_path / "survey.csv")
    (recording,) = reading.find([tmp_path / "bag"])
    assert np.array_equal(reading.read(recording).anchors.positions, flight.anchors.positions)
    with pytest.raises(InputError, match="give a survey file"):
        Reading().read((tmp_path / "bag", None))


def test_a_survey_that_is_given_counts_whatever_anchors_a_bag_holds_and_that_is_said_once(
    tmp_path, capsys
):
    for name in ("one", "two"):
        write_bag(small_flight(), tmp_path / name)
    survey = tmp_path / "survey.csv"
    survey.write_text(SURVEY.replace("0.1,0.2,0.3", "0.5,0.2,0.3"))
    bags, reading = [tmp_path / "one", tmp_path / "two"], Reading(survey)
    assert [flight.anchors.positions[0, 0] for flight in reading.flights(bags)] == [0.5, 0.5]
    assert [reading.one(bag).anchors.positions[0, 0] for bag in bags] == [0.5, 0.5]
    assert [flight.anchors.positions[0, 0] for flight in Reading().flights(bags)] == [0.1, 0.1]
    said = [
        line for line in capsys.readouterr().err.splitlines() if " flights done, " not in line
    ]  # printed on a slow computer
    assert len(said) == 1 and f"the anchors of {survey} count here" in said[0]


@pytest.mark.parametrize("given", [{"namespace": "tag1"}, {"topics": {"uwb/tdoa": "/theirs"}}])
def test_topics_of_bags_are_refused_where_there_is_no_bag(tmp_path, given):
    (tmp_path / "log").write_bytes(log_bytes())
    (tmp_path / "survey.csv").write_text(SURVEY)
    reading = Reading(tmp_path / "survey.csv", **given)
    for read in (reading.one, lambda path: reading.find([path])):
        with pytest.raises(
            InputError, match="says where topics are in bags, and .*log is none; leave it out"
        ):
            read(tmp_path / "log")


def test_a_bag_that_was_not_closed_is_one(tmp_path):
    make(tmp_path, "bag/bag_0.mcap")
    with pytest.raises(InputError, match="bag: holds no message that can be read"):
        Reading(namespace="tag1").one(tmp_path / "bag")


@pytest.mark.parametrize("kind", ["log", "bag"])
def test_ground_truth_that_is_not_wanted_is_not_read(tmp_path, kind):
    """Not even damage in it is reported."""
    (tmp_path / "survey.csv").write_text(SURVEY)
    if kind == "bag":
        flight = small_flight()
        flight.truth.p[7] = np.nan
        write_bag(flight, tmp_path / "flight")
    else:
        rows = [*ROWS, ("estPose", 1_000_800, (np.nan, 2.0, 0.5, 0.0, 0.0, 0.0, 1.0))]
        (tmp_path / "flight").write_bytes(log_bytes(rows))
    with pytest.raises(InputError, match="must be|not finite|nan"):
        Reading(tmp_path / "survey.csv").one(tmp_path / "flight")
    blind = Reading(tmp_path / "survey.csv", truth=False).one(tmp_path / "flight")
    assert blind.truth is None and len(blind.tdoa) > 1


def test_a_recording_without_tdoas_is_refused_where_they_are_needed():
    flight = small_flight()
    require_tdoas([flight], "survey")
    with pytest.raises(InputError, match=f"{flight.name}: holds no TDOAs, which survey needs"):
        require_tdoas([flight, replace(flight, tdoa=Tdoas(*np.empty((4, 0))))], "survey")


def test_folders_that_link_to_each_other_are_looked_through_once(tmp_path):
    """Twelve folders with links to all twelve have 12^n paths."""
    for k in range(12):
        (tmp_path / f"{k}").mkdir()
    for k in range(12):
        for other in range(12):
            (tmp_path / f"{k}" / f"to{other}").symlink_to(tmp_path / f"{other}")
    (tmp_path / "3" / "flight").write_text("")
    os.mkfifo(tmp_path / "4" / "pipe")
    assert [path.name for path, _ in find_flights([tmp_path], "survey.txt")] == ["flight"]


def test_folders_within_folders_have_a_limit(tmp_path):
    deep = tmp_path
    for _ in range(FOLDER_DEPTH + 2):
        deep = deep / "d"
    deep.mkdir(parents=True)
    with pytest.raises(TooMuch, match="more than 20 levels of folders"):
        find_flights([tmp_path], "survey.txt")


@pytest.mark.parametrize(
    "read",
    [read_survey, read_yaml, read_bytes, lambda path: read_arrays(path, {}, "map", "make it anew")],
)
@pytest.mark.parametrize("what", ["pipe", "device"])
def test_a_pipe_is_refused_at_once(tmp_path, read, what):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a pipe, a device or a folder; give a file"):
        read(tmp_path / "pipe" if what == "pipe" else Path("/dev/zero"))


def test_a_pipe_among_surveys_is_no_survey(tmp_path):
    (tmp_path / "flight_a").write_bytes(log_bytes())
    os.mkfifo(tmp_path / "anchor_a.txt")
    with pytest.raises(InputError, match="is a pipe, a device or a folder"):
        read_flight(tmp_path / "flight_a", survey_for(tmp_path / "flight_a", tmp_path))


@pytest.mark.parametrize(
    "position", ["[1, 2an, 3]", "[1, [2], 3]", "[1, {a: 1}, 3]", "x", "~", "{x: 1}", "[]"]
)
@pytest.mark.parametrize("name", ["0", "NE corner"])
def test_a_position_that_is_no_numbers_is_refused(tmp_path, name, position):
    (tmp_path / "survey.yaml").write_text(f"anchors: {{{name}: {{position: {position}}}}}\n")
    with pytest.raises(InputError, match="survey.yaml: "):
        read_named_anchors(tmp_path / "survey.yaml")
