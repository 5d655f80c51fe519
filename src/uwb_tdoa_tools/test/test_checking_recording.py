# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags as received, and findings about frames, topics, anchors, publishers, ranges and motion."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import ANCHORS, SURVEY, csv_text, small_flight
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.sensors import Ranges
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.checking import coverage, recording_rules
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import IMU, TDOA, of_flight, read_recording
from uwb_tdoa_tools.checking.recording_rules import RULES
from uwb_tdoa_tools.checking.watch import tag_delay
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.live.session import End
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

# --- checking recording ---


@pytest.fixture
def bag(tmp_path):
    write_bag(small_flight(), tmp_path / "f.bag")
    return tmp_path / "f.bag"


def test_a_bag_gives_the_streams_of_the_flight_without_arrivals(bag):
    flight, made = small_flight(), read_recording(Reading(), bag)
    for stream, other in ((made.tdoa, flight.tdoa), (made.imu, flight.imu)):
        for name, column in vars(stream).items():
            assert np.array_equal(column, getattr(other, name))
    assert made.frames == {
        TDOA: {"base_link": len(flight.tdoa)},
        IMU: {"base_link": len(flight.imu)},
    }
    assert np.array_equal(made.recorded.positions, flight.anchors.positions)
    assert made.topics["/imu/data"] == "sensor_msgs/msg/Imu"
    assert np.isnan(made.tdoa_arrival).all() and np.isnan(made.imu_arrival).all()


def test_without_ground_truth_the_other_findings_are_the_same(bag):
    made = read_recording(Reading(), bag)
    assert made.truth is not None
    found = {one.rule: one for one in check(made).findings}
    left = {one.rule: one for one in check(replace(made, truth=None)).findings}
    assert {rule for rule in found if rule not in left} <= {"truth_unit", "truth_attitude"}
    assert all(repr(found[rule]) == repr(one) for rule, one in left.items())


def test_a_survey_overrides_the_anchors_of_the_bag(bag, tmp_path):
    (tmp_path / "survey.csv").write_text(SURVEY.replace("0.1,0.2,0.3", "0.5,0.2,0.3"))
    made = read_recording(Reading(), bag, tmp_path / "survey.csv")
    assert made.anchors.positions[0, 0] == 0.5 and made.recorded.positions[0, 0] == 0.1


def test_falling_stamps_are_counted(tmp_path):
    rows = ["0.020,0,1,0.25", "0.010,0,1,0.35", "0.030,1,5,0.1"]
    (tmp_path / "f.csv").write_text(csv_text("t_tdoa,idA,idB,tdoa_meas", rows))
    (tmp_path / "survey.csv").write_text(SURVEY)
    assert read_recording(Reading(), tmp_path / "f.csv", tmp_path / "survey.csv").falls == 1


def test_topics_can_be_renamed(bag):
    with pytest.raises(
        InputError, match="/tag1/uwb/tdoa; say where they are .--topic uwb/tdoa=/uwb/tdoa"
    ):
        read_recording(Reading(namespace="tag1"), bag)
    topics = {"uwb/tdoa": "/uwb/tdoa", "uwb/anchors": "/uwb/anchors"}
    made = read_recording(Reading(namespace="tag1", topics=topics), bag)
    assert made.imu is None and len(made.tdoa) == len(small_flight().tdoa)


def test_a_cut_bag_is_read(bag):
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-40])
    made = read_recording(Reading(), bag)
    assert len(made.tdoa) == len(small_flight().tdoa)  # the truncated part is its index


def test_a_flight_without_imu_is_read(tmp_path):
    made = of_flight(replace(small_flight(), imu=None))
    assert made.imu is None and len(made.imu_arrival) == 0


# --- checking recording rules ---


def rules_found(**changes):
    made = replace(of_flight(small_flight()), **changes)
    return {finding.rule: finding for rule in recording_rules.RULES for finding in rule(made)}


def at(angle, shift):
    return Rotation.from_euler("z", angle, degrees=True), np.array([shift, 0.0, 0.0])


def moved(by):
    return ANCHORS.at(ANCHORS.positions + [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [by, 0.0, 0.0]])


BODY = [{IMU: {frame: 5}, TDOA: {frame: 5}} for frame in ("base_link", "tag1/base_link", "")]
MOUNTED = {IMU: {"imu_link": 5}}
IMU_TYPE, TDOA_TYPE = "sensor_msgs/msg/Imu", "uwb_tdoa_msgs/msg/Tdoa"
ODOMETRY = "nav_msgs/msg/Odometry"
TOPICS = {
    "/uwb/tdoa": "",
    "/tag1/uwb/tdoa": "",
    "/odometry": ODOMETRY,
    "/tag1/odometry": ODOMETRY,
    "/odometry/debiased": ODOMETRY,
}
OTHER_TOPICS = {**TOPICS, "/odom": ODOMETRY}


@pytest.mark.parametrize(
    ("changes", "rule", "words"),
    [
        *(({"frames": frames}, None, "") for frames in BODY),
        ({"frames": MOUNTED}, "frame_unknown", "no transform to imu_link"),
        ({"frames": MOUNTED, "places": {"imu_link": at(90.0, 0.0)}}, "frame_turned", "yaw 90"),
        ({"frames": MOUNTED, "places": {"imu_link": at(0.0, 0.1)}}, "frame_turned", "(0.10,"),
        ({"frames": MOUNTED, "places": {"imu_link": at(0.5, 0.0)}}, None, ""),
        ({"frames": {TDOA: {"base_link": 5, "tag2/base_link": 4}}}, "senders", "tag2"),
        (
            {"imu": None, "topics": {"/uwb/tdoa": TDOA_TYPE, "/imu/raw": IMU_TYPE}},
            "imu_elsewhere",
            "--topic imu/data=/imu/raw",
        ),
        ({"imu": None, "topics": {"/uwb/tdoa": TDOA_TYPE}}, "imu_missing", "use_imu:=false"),
        (
            {"imu": None, "topics": {"/imu/data": IMU_TYPE}, "read": frozenset({"/imu/data"})},
            "imu_empty",
            "without a message",
        ),
        ({"imu": None}, None, ""),  # a CSV file has no topics
        ({"topics": TOPICS}, None, ""),  # topics of our filters
        ({"topics": OTHER_TOPICS}, "odometry_unread", "--topic velocity/odometry=/odom"),
        ({"topics": OTHER_TOPICS, "read": frozenset({"/odom"})}, None, ""),
        ({"recorded": moved(1.0)}, "survey_differs", "up to 1.00 m apart"),
        ({"recorded": replace(ANCHORS, ids=[7, 8, 9])}, "survey_differs", "no id in common"),
        ({"recorded": ANCHORS}, None, ""),
    ],
)
def test_frames_topics_and_anchors_are_judged(changes, rule, words):
    found = rules_found(**changes)
    assert found.keys() == ({rule} if rule else set())
    assert not rule or words in found[rule].sentence


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
        # one node that subscribes twice, as our nodes do for anchors
        ([DRIVER, STRICT, NODE], set()),
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
    """Return a Flight with ranges only, without systematic errors."""
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


def delays_in(flight, **columns):
    """Return the findings on the delay of the tag in a Flight with other ranges."""
    flight = replace(flight, range=replace(flight.range, **columns))
    return [*tag_delay(flight, FlightEstimator()(flight))]


@pytest.mark.parametrize("by", [0.25, -0.2])
def test_a_common_error_of_ranges_is_found(ranged, by):
    (found,) = delays_in(longer(ranged, by))
    assert found.severity == "note" and found.value == pytest.approx(by, abs=0.03)
    assert ("too long" if by > 0.0 else "too short") in found.cause
    report = check(of_flight(longer(ranged, by)))
    assert not report.faulty and "tag_delay" in {finding.rule for finding in report.findings}


def test_ranges_in_another_scale_are_not_called_a_delay_alone(ranged):
    (found,) = delays_in(ranged, d=0.8 * ranged.range.d)
    assert found.severity == "warning" and "or all are 0.8" in found.cause


def test_healthy_ranges_have_no_finding_with_a_tape_measured_survey(ranged):
    assert not delays_in(ranged)
    shaken = ranged.anchors.positions + 0.1 * np.random.default_rng(3).standard_normal(
        ranged.anchors.positions.shape
    )
    assert not delays_in(replace(ranged, anchors=ranged.anchors.at(shaken)))


def test_outliers_of_ranges_do_not_count(ranged):
    rng, d = np.random.default_rng(0), longer(ranged, 0.25).range.d
    d = np.where(rng.random(len(d)) < 0.1, d + rng.exponential(2.0, len(d)), d)
    d[::50] = np.nan
    (found,) = delays_in(ranged, d=d)
    assert found.value == pytest.approx(0.25, abs=0.03)


def test_ranges_that_determine_no_delay_have_no_finding(ranged):
    assert not delays_in(ranged, d=1000.0 * ranged.range.d)
    some = np.arange(2)
    few = replace(ranged, range=Ranges(*(column[some] for column in vars(ranged.range).values())))
    assert not delays_in(few)


# --- checking coverage ---


BOX = np.array([[x, y, z] for x in (0.0, 6.0) for y in (0.0, 7.0) for z in (0.2, 3.0)])
PLACES = np.random.default_rng(0).uniform([1.0, 1.0, 0.5], [5.0, 6.0, 2.5], (40, 3))


def windows(anchors, heard, seconds=20):
    """Return TdoaWindows of 100 TDOAs per second. heard(t, a, b) selects the received ones, (n,)
    bool.
    """
    t = np.arange(0.0, seconds, 0.01)
    a = np.arange(len(t)) % len(anchors)
    b = (a + 1) % len(anchors)
    rows = heard(t, a, b)
    rules = StreamRules(anchors)
    rules.feed_tdoa(
        t[rows],
        np.full(rows.sum(), np.nan),
        anchors.ids[a[rows]],
        anchors.ids[b[rows]],
        0.1 * np.sin(t[rows]),
    )
    rules.finish()
    return list(rules.tdoa)


def said(positions=BOX, places=PLACES, heard=lambda t, a, b: t >= 0.0, seconds=20):
    anchors = Anchors.from_positions(positions)
    view = coverage.CoverageView(anchors, windows(anchors, heard, seconds), places)
    return {finding.rule: finding for rule in coverage.RULES for finding in rule(view)}


def without_3(t, a, b):
    return (a != 3) & (b != 3)


@pytest.mark.parametrize(
    ("options", "rule", "words"),
    [
        ({}, None, ""),
        ({"heard": without_3}, "anchor_missing", "never hears: 3"),
        (
            {"heard": lambda t, a, b: without_3(t, a, b) | (np.floor(t * 100) % 32 == 3)},
            "anchor_rare",
            "anchor 3",
        ),
        (
            {"heard": lambda t, a, b: without_3(t, a, b) | (t < 8.0) | (t > 16.0)},
            "anchor_silent",
            "anchor 3 falls silent (7 s from 8.1 s on",
        ),
        (
            {"positions": BOX * [1.0, 1.0, -1.0], "places": PLACES * [1.0, 1.0, -1.0]},
            "survey_z_down",
            "z seems to point down",
        ),
        ({"places": PLACES + [5.0, 0.0, 0.0]}, "outside", "outside of its anchors"),
        ({"places": PLACES + [0.0, 0.0, 0.2]}, None, ""),
        ({"places": PLACES[:1] + 0.01 * PLACES}, "little_motion", "across their main direction"),
        ({"seconds": 5}, "little_motion", "5 s"),
        ({"places": np.empty((0, 3))}, None, ""),  # it was not tried
    ],
)
def test_what_anchors_and_motion_determine(options, rule, words):
    found = said(**options)
    assert found.keys() == ({rule} if rule else set())
    assert not rule or words in found[rule].sentence


@pytest.mark.parametrize("axis", range(3))
def test_anchors_in_a_plane(axis):
    flat = BOX.copy()
    flat[:, axis] = 1.0 + 0.01 * np.arange(8)
    assert "anchors_flat" in said(positions=flat)


@pytest.mark.parametrize(
    ("axis", "at", "said_of"),
    [
        (2, 3.0, "tag_side:=below"),
        (2, 0.1, "tag_side:=above"),
        (0, 0.0, "tag_side:=+x or -p tag_side:=-x"),
        (1, 0.0, "tag_side:=+y"),
    ],
)
def test_anchors_in_a_plane_across_an_axis_need_a_side(axis, at, said_of):
    flat = BOX.copy()
    flat[:, axis] = at + 0.01 * np.arange(8)
    assert said_of in said(positions=flat)["side_unknown"].remedy


def test_of_a_hall_the_side_is_needed_where_those_that_are_heard_have_one_height():
    hall = np.array([[4.0 * k, 3.0 * (k % 2), 3.0 if k < 12 else 6.0] for k in range(24)])
    turn = lambda t, a, b: (a // 6 == np.floor(t / 5.0)) & (b // 6 == np.floor(t / 5.0))  # noqa: E731
    assert "tag_side:=below" in said(positions=hall, heard=turn)["side_unknown"].remedy


def test_where_something_measures_the_height_no_side_is_needed():
    flat = BOX.copy()
    flat[:, 2] = 3.0
    anchors = Anchors.from_positions(flat)
    view = coverage.CoverageView(
        anchors, windows(anchors, lambda t, a, b: t >= 0.0), PLACES, height_known=True
    )
    assert not list(coverage.unknown_side(view))
