"""Frames, senders, topics, anchors, publishers and ranges of a recording."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import ANCHORS, small_flight
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_tools.checking import recording_rules
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import IMU, TDOA, of_flight
from uwb_tdoa_tools.checking.recording_rules import RULES, tag_delay, window_offsets
from uwb_tdoa_tools.live.record import End
from uwb_tdoa_tools.simulation import SimulationConfig, simulate


def rules_found(**changes):
    made = replace(of_flight(small_flight()), **changes)
    return {finding.rule: finding for rule in recording_rules.RULES for finding in rule(made)}


@pytest.mark.parametrize("frame", ["base_link", "tag1/base_link", ""])
def test_the_body_frame_has_no_finding(frame):
    assert rules_found(frames={IMU: {frame: 5}, TDOA: {frame: 5}}) == {}


def test_a_frame_without_a_transform_is_a_warning():
    assert rules_found(frames={IMU: {"imu_link": 5}})["frame_unknown"].severity == "warning"


@pytest.mark.parametrize(
    "angle, shift, severity", [(90.0, 0.0, "note"), (0.0, 0.1, "note"), (0.5, 0.0, None)]
)
def test_a_frame_with_a_transform_is_a_note(angle, shift, severity):
    place = Rotation.from_euler("z", angle, degrees=True), np.array([shift, 0.0, 0.0])
    found = rules_found(frames={IMU: {"imu_link": 5}}, places={"imu_link": place})
    assert {name: finding.severity for name, finding in found.items()} == (
        {"frame_turned": severity} if severity else {}
    )
    if angle == 90.0:
        assert (
            found["frame_turned"].value == pytest.approx(np.pi / 2)
            and "yaw 90" in found["frame_turned"].evidence
        )


def test_two_frames_are_two_senders():
    assert "senders" in rules_found(frames={TDOA: {"tag1/base_link": 5, "tag2/base_link": 4}})


def test_an_imu_on_another_topic_is_named():
    found = rules_found(
        imu=None, topics={"/uwb/tdoa": "uwb_tdoa_msgs/msg/Tdoa", "/imu/raw": "sensor_msgs/msg/Imu"}
    )
    assert "--topic imu/data=/imu/raw" in found["imu_elsewhere"].remedy
    assert "imu_missing" in rules_found(imu=None, topics={"/uwb/tdoa": "uwb_tdoa_msgs/msg/Tdoa"})
    assert rules_found(imu=None) == {}  # a CSV file has no topics


def test_an_empty_topic_of_the_imu_is_not_mapped_to_itself():
    found = rules_found(
        imu=None, topics={"/imu/data": "sensor_msgs/msg/Imu"}, read=frozenset({"/imu/data"})
    )
    assert found.keys() == {"imu_empty"} and "--topic" not in found["imu_empty"].remedy


ODOMETRY = "nav_msgs/msg/Odometry"


def test_unread_odometry_is_named():
    topics = {
        "/uwb/tdoa": "",
        "/tag1/uwb/tdoa": "",
        "/odometry": ODOMETRY,
        "/tag1/odometry": ODOMETRY,
        "/odometry/debiased": ODOMETRY,
    }
    assert rules_found(topics=topics) == {}  # of filters of ours
    found = rules_found(topics={**topics, "/odom": ODOMETRY})
    assert "--topic velocity/odometry=/odom" in found["odometry_unread"].remedy
    assert rules_found(topics={**topics, "/odom": ODOMETRY}, read=frozenset({"/odom"})) == {}


def test_other_anchors_in_the_bag_are_named():
    moved = replace(
        ANCHORS, positions=ANCHORS.positions + [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    )
    assert rules_found(recorded=moved)["survey_differs"].value == pytest.approx(1.0)
    assert rules_found(recorded=ANCHORS) == {}
    assert (
        "no id in common"
        in rules_found(recorded=replace(ANCHORS, ids=[7, 8, 9]))["survey_differs"].evidence
    )


IMU_TYPE, TDOA_TYPE = "sensor_msgs/msg/Imu", "uwb_tdoa_msgs/msg/Tdoa"
DRIVER = End("/imu/data", "/driver", IMU_TYPE, True, False, False)
NODE = End("/imu/data", "/ekf_node", IMU_TYPE, False, False, False)
STRICT = replace(NODE, reliable=True)
ANCHORS_END = End(
    "/tag1/uwb/anchors", "/tag1/driver", "uwb_tdoa_msgs/msg/AnchorArray", True, True, False
)


@pytest.mark.parametrize(
    "ends, expected",
    [
        ([DRIVER, NODE], set()),
        ([DRIVER, STRICT], {"qos_unmatched"}),
        ([DRIVER, STRICT, NODE], set()),  # one node that asks in both ways, as ours do for anchors
        ([replace(DRIVER, reliable=True), STRICT], set()),
        ([replace(DRIVER, reliable=True), replace(NODE, latched=True)], {"qos_unmatched"}),
        ([DRIVER, replace(DRIVER, node="/other"), NODE], {"publishers_several"}),
        (
            [
                replace(DRIVER, topic="/tf_static"),
                replace(DRIVER, topic="/tf_static", node="/other"),
            ],
            set(),
        ),
        ([DRIVER, replace(NODE, kind=TDOA_TYPE)], {"type_other"}),
        ([ANCHORS_END], {"anchors_volatile"}),
        ([replace(ANCHORS_END, latched=True)], set()),
        ([], set()),
    ],
)
def test_publishers_and_subscriptions_are_judged(ends, expected):
    recording = replace(of_flight(small_flight()), ends=tuple(ends))
    found = [finding for rule in RULES for finding in rule(recording)]
    assert {finding.rule for finding in found} == expected
    for finding in found:
        assert all(
            node in finding.sentence
            for node in {end.node for end in ends if end.node != "/ekf_node"}
        )


@pytest.fixture(scope="module", params=["sines", "circle"])
def ranged(request):
    """A Flight of ranges alone, without systematic errors."""
    config = SimulationConfig(
        seed=7,
        trajectory=request.param,
        duration=20.0,
        imu_rate=100.0,
        truth_rate=20.0,
        range_noise=0.1,
        bias=False,
        multipath=False,
    )
    return replace(simulate(config), tdoa=Tdoas(*np.empty((4, 0))))


def longer(flight, by):
    return replace(flight, range=replace(flight.range, d=flight.range.d + by))


@pytest.mark.parametrize("by", [0.25, -0.2])
def test_a_common_error_of_ranges_is_found(ranged, by):
    (found,) = tag_delay(of_flight(longer(ranged, by)))
    assert found.severity == "note" and found.value == pytest.approx(by, abs=0.03)
    assert ("too long" if by > 0.0 else "too short") in found.cause
    report = check(of_flight(longer(ranged, by)))
    assert not report.faulty and "tag_delay" in {finding.rule for finding in report.findings}


def test_healthy_ranges_have_no_finding_with_a_tape_measured_survey(ranged):
    assert not [*tag_delay(of_flight(ranged))]
    shaken = ranged.anchors.positions + 0.1 * np.random.default_rng(3).standard_normal(
        ranged.anchors.positions.shape
    )
    assert not [*tag_delay(of_flight(replace(ranged, anchors=ranged.anchors.at(shaken))))]


def test_outliers_of_ranges_do_not_count(ranged):
    rng, d = np.random.default_rng(0), longer(ranged, 0.25).range.d
    d = np.where(rng.random(len(d)) < 0.1, d + rng.exponential(2.0, len(d)), d)
    d[::50] = np.nan
    (found,) = tag_delay(of_flight(replace(ranged, range=replace(ranged.range, d=d))))
    assert found.value == pytest.approx(0.25, abs=0.08)


def test_ranges_that_determine_no_delay_have_no_finding(ranged):
    offsets = window_offsets(ranged.range, ranged.anchors.only(np.arange(4)))  # as many as unknowns
    assert len(offsets) == 0
    flat = ranged.anchors.at(ranged.anchors.positions * [1.0, 1.0, 0.0])
    assert np.isfinite(window_offsets(ranged.range, flat)).all()
    assert not [*tag_delay(of_flight(replace(ranged, range=None)))]
    millimetres = replace(ranged.range, d=1000.0 * ranged.range.d)
    assert not [*tag_delay(of_flight(replace(ranged, range=millimetres)))]
