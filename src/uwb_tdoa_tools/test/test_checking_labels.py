"""Frames, senders, topics and anchors of a bag."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import ANCHORS, small_flight
from scipy.spatial.transform import Rotation

from uwb_tdoa_tools.checking import recording_rules
from uwb_tdoa_tools.checking.recording import IMU, TDOA, of_flight


def said(**changes):
    made = replace(of_flight(small_flight()), **changes)
    return {finding.rule: finding for rule in recording_rules.RULES for finding in rule(made)}


@pytest.mark.parametrize("frame", ["base_link", "tag1/base_link", ""])
def test_the_body_frame_is_healthy(frame):
    assert said(frames={IMU: {frame: 5}, TDOA: {frame: 5}}) == {}


def test_a_frame_that_nobody_knows():
    assert said(frames={IMU: {"imu_link": 5}})["frame_unknown"].severity == "warning"


@pytest.mark.parametrize(
    "angle, shift, severity", [(90.0, 0.0, "note"), (0.0, 0.1, "note"), (0.5, 0.0, None)]
)
def test_a_frame_that_is_known(angle, shift, severity):
    place = Rotation.from_euler("z", angle, degrees=True), np.array([shift, 0.0, 0.0])
    found = said(frames={IMU: {"imu_link": 5}}, places={"imu_link": place})
    assert {name: finding.severity for name, finding in found.items()} == (
        {"frame_turned": severity} if severity else {}
    )
    if angle == 90.0:
        assert (
            found["frame_turned"].value == pytest.approx(np.pi / 2)
            and "yaw 90" in found["frame_turned"].evidence
        )


def test_two_frames_are_two_senders():
    assert "senders" in said(frames={TDOA: {"tag1/base_link": 5, "tag2/base_link": 4}})


def test_an_imu_on_another_topic():
    found = said(
        imu=None, topics={"/uwb/tdoa": "uwb_tdoa_msgs/msg/Tdoa", "/imu/raw": "sensor_msgs/msg/Imu"}
    )
    assert "--topic imu/data=/imu/raw" in found["imu_elsewhere"].remedy
    assert "imu_missing" in said(imu=None, topics={"/uwb/tdoa": "uwb_tdoa_msgs/msg/Tdoa"})
    assert said(imu=None) == {}  # a CSV file has no topics


ODOMETRY = "nav_msgs/msg/Odometry"


def test_odometry_that_nothing_reads():
    topics = {
        "/uwb/tdoa": "",
        "/tag1/uwb/tdoa": "",
        "/odometry": ODOMETRY,
        "/tag1/odometry": ODOMETRY,
        "/odometry/debiased": ODOMETRY,
    }
    assert said(topics=topics) == {}  # of filters of ours
    found = said(topics={**topics, "/odom": ODOMETRY})
    assert "--topic velocity/odometry=/odom" in found["odometry_unread"].remedy
    assert said(topics={**topics, "/odom": ODOMETRY}, read=frozenset({"/odom"})) == {}


def test_other_anchors_in_the_bag():
    moved = replace(
        ANCHORS, positions=ANCHORS.positions + [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    )
    assert said(recorded=moved)["survey_differs"].value == pytest.approx(1.0)
    assert said(recorded=ANCHORS) == {}
    assert (
        "no id in common"
        in said(recorded=replace(ANCHORS, ids=[7, 8, 9]))["survey_differs"].evidence
    )
