"""Bags as they were received: order, arrivals, frames, and no look at the truth."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import SURVEY, csv_text, small_flight

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.checking.recording import IMU, TDOA, of_flight, read_recording
from uwb_tdoa_tools.readers.inputs import Reading


def test_a_bag_gives_the_streams_of_the_flight(tmp_path):
    flight = small_flight()
    write_bag(flight, tmp_path / "f.bag")
    made = read_recording(Reading(), tmp_path / "f.bag")
    for stream, other in ((made.tdoa, flight.tdoa), (made.imu, flight.imu)):
        for name, column in vars(stream).items():
            assert np.array_equal(column, getattr(other, name))
    assert made.frames == {
        TDOA: {"base_link": len(flight.tdoa)},
        IMU: {"base_link": len(flight.imu)},
    }
    assert np.array_equal(made.recorded.positions, flight.anchors.positions)
    assert made.topics["/imu/data"] == "sensor_msgs/msg/Imu"


def test_a_converted_bag_has_no_arrivals(tmp_path):
    write_bag(small_flight(), tmp_path / "f.bag")
    made = read_recording(Reading(), tmp_path / "f.bag")
    assert np.isnan(made.tdoa_arrival).all() and np.isnan(made.imu_arrival).all()


def test_ground_truth_is_not_read(tmp_path, monkeypatch):
    flight = small_flight()
    write_bag(flight, tmp_path / "f.bag")
    from uwb_tdoa_tools.bags import topics

    opened = []
    original = topics.readable
    monkeypatch.setattr(
        topics,
        "readable",
        lambda p, r, some: opened.extend(c.topic for c in some) or original(p, r, some),
    )
    read_recording(Reading(), tmp_path / "f.bag")
    assert "/ground_truth/pose" not in opened and "/uwb/tdoa" in opened


def test_a_survey_overrides_the_anchors_of_the_bag(tmp_path):
    write_bag(small_flight(), tmp_path / "f.bag")
    (tmp_path / "survey.csv").write_text(SURVEY.replace("0.1,0.2,0.3", "0.5,0.2,0.3"))
    made = read_recording(Reading(), tmp_path / "f.bag", tmp_path / "survey.csv")
    assert made.anchors.positions[0, 0] == 0.5 and made.recorded.positions[0, 0] == 0.1


def test_falling_stamps_are_counted(tmp_path):
    rows = ["0.020,0,1,0.25", "0.010,0,1,0.35", "0.030,1,5,0.1"]
    (tmp_path / "f.csv").write_text(csv_text("t_tdoa,idA,idB,tdoa_meas", rows))
    (tmp_path / "survey.csv").write_text(SURVEY)
    assert read_recording(Reading(), tmp_path / "f.csv", tmp_path / "survey.csv").falls == 1


def test_a_bag_without_tdoas_is_an_error(tmp_path):
    flight = small_flight()
    write_bag(flight, tmp_path / "f.bag")
    with pytest.raises(
        InputError, match="/tag1/uwb/tdoa; say where they are .--topic uwb/tdoa=/uwb/tdoa"
    ):
        read_recording(Reading(namespace="tag1"), tmp_path / "f.bag")


def test_topics_can_be_renamed(tmp_path):
    write_bag(small_flight(), tmp_path / "f.bag")
    topics = {"uwb/tdoa": "/uwb/tdoa", "uwb/anchors": "/uwb/anchors"}
    made = read_recording(Reading(namespace="tag1", topics=topics), tmp_path / "f.bag")
    assert made.imu is None and len(made.tdoa) == len(small_flight().tdoa)


def test_a_cut_bag_is_salvaged(tmp_path):
    write_bag(small_flight(), tmp_path / "f.bag")
    (file,) = (tmp_path / "f.bag").glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(InputError, match="--salvage"):
        read_recording(Reading(), tmp_path / "f.bag")
    made = read_recording(Reading(salvage=True), tmp_path / "f.bag")
    assert len(made.tdoa) == len(small_flight().tdoa)  # what is cut is its index


def test_a_flight_without_imu_is_read(tmp_path):
    made = of_flight(replace(small_flight(), imu=None))
    assert made.imu is None and len(made.imu_arrival) == 0
