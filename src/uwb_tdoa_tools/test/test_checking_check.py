# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Findings about whole recordings: none if healthy, otherwise the mistake.

Most tests call the rules of `check`, without its last run of the filter.
"""

from dataclasses import replace
from itertools import product

import checking_flights
from checking_flights import QUICK, sparse_recording as recording
from known_effects import clean_flight
from mistakes import MISTAKES
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_ekf.monitoring.finding import ERROR
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.checking import coverage, imu_rules, recording_rules, tdoa_rules
from uwb_tdoa_tools.checking.check import (
    _misfit,
    _try_corrections,
    _without_stream_mistakes,
    check,
    different_surveys,
    processed_streams,
    upright,
)
from uwb_tdoa_tools.checking.ordered import OrderedRecording
from uwb_tdoa_tools.checking.recording import of_flight, read_recording
from uwb_tdoa_tools.checking.recording_rules import sensor_mistakes
from uwb_tdoa_tools.readers import inputs, read_flight
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import constellation

OTHER_ROOM = constellation("random-5")
NO_TDOAS = Tdoas(*(np.empty(0, kind) for kind in (float, int, int, float)))
# named by trials, which take longer than the rules of streams
TRIED = """sign order pair swapped from_one another_room another_room_alone typing_error mirrored_survey
    upside_down_survey y_up_survey minus_gravity gyro_sign left_handed gyro_exchanged""".split()
LONGER = {"mirrored_survey": {"duration": 30.0}}  # visible once the yaw is known
HARMLESS = "clipped_accel"  # a smooth simulated flight does not reach the limits


def rules(findings):
    return {finding.rule for finding in findings}


def found_by_rules(recording, others=(), of_imu=False):
    """Yield the findings of streams, of coverage, and of trials.

    of_imu : try corrections of the inertial sensor instead of those of TDOAs and survey
    """
    streams = processed_streams(recording)
    found = streams.findings()
    for rule in recording_rules.RULES:
        found += rule(recording)
    yield from found
    view = coverage.CoverageView(recording.anchors, list(streams.tdoa), np.empty((0, 3)))
    for rule in coverage.RULES:
        yield from rule(view)
    ordered = _without_stream_mistakes(OrderedRecording.of(recording), found)
    if of_imu:
        found = [imu_rules.find_imu_mistake(ordered)]
    else:
        found = [tdoa_rules.best_trial(ordered, others)[0], _misfit(ordered)]
    yield from filter(None, found)


def names(mistake, recording, others):
    """Return whether a rule names the Mistake in a Recording. The first that does is the last."""
    found = found_by_rules(recording, others, "imu" in mistake.needs)
    return any(finding.rule in mistake.named for finding in found)


def with_mistake(name, seed=0):
    """Return (Recording with a mistake, other surveys)."""
    mistake = MISTAKES[name]
    protocol = "tdoa3" if mistake.needs == "tdoa3" else "tdoa2"
    healthy = recording(
        seed, live="live" in mistake.needs, protocol=protocol, **LONGER.get(name, {})
    )
    other = (
        OTHER_ROOM
        if mistake.needs == "rooms"
        else recording(seed + 1, protocol=protocol, trajectory="circle")
    )
    made = mistake.make(healthy, np.random.default_rng([seed, *name.encode()]), other)
    others = [] if mistake.alone else [("right.yaml", healthy.anchors), ("wrong.yaml", OTHER_ROOM)]
    return made, others


@pytest.mark.slow
def test_tdoas_in_centimetres_do_not_make_the_survey_look_small():
    healthy = checking_flights.recording(1, duration=40.0, yaw="fixed", speed=1.0)
    centimetres = replace(healthy.tdoa, d=100.0 * healthy.tdoa.d)
    assert "survey_scale" in rules(processed_streams(replace(healthy, tdoa=centimetres)).findings())
    (finding,) = check(replace(healthy, tdoa=centimetres)).findings
    assert finding.rule == "tdoa_unit" and "in centimetres, not in metres" in finding.cause


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "live"), [("tdoa2", False), ("tdoa3", True)])
def test_a_healthy_flight_has_no_finding(protocol, live):
    assert check(recording(0, live=live, protocol=protocol)).findings == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trajectory", "room"),
    [
        ("circle", "corners"),
        ("square", "random-3"),
        ("line_x", "random-8-6"),
        ("hover", "corners"),
    ],
)
def test_healthy_flights_have_no_error(trajectory, room):
    made = recording(trajectory=trajectory, constellation=room)
    for of_imu in (False, True):
        found = found_by_rules(made, [("other.yaml", OTHER_ROOM)], of_imu)
        assert ERROR not in {finding.severity for finding in found}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in TRIED else name
        for name in MISTAKES
        if name != HARMLESS
    ],
)
def test_a_mistake_is_named(name):
    assert names(MISTAKES[name], *with_mistake(name))


def test_ranges_alone_show_a_survey_upside_down():
    flight = simulate(SimulationConfig(seed=0, range_noise=0.1, **QUICK))
    healthy = of_flight(replace(flight, tdoa=NO_TDOAS))
    upside_down = MISTAKES["upside_down_survey"].make(healthy, None, None)
    assert "survey_upside_down" in rules(check(upside_down).findings)
    assert check(healthy).findings == []
    in_feet = replace(flight.range, d=flight.range.d / 0.3048)
    (one,) = check(of_flight(replace(flight, tdoa=NO_TDOAS, range=in_feet))).findings
    assert one.rule == "range_unit" and "0.3048" in one.remedy


@pytest.mark.slow
def test_two_mistakes_at_once_are_both_named():
    made = MISTAKES["in_g"].make(MISTAKES["sign"].make(recording(), None, None), None, None)
    assert {"imu_force_unit", "tdoa_sign"} <= rules(check(made).findings)


def test_errors_come_first():
    report = check(*with_mistake("three_anchors"))
    severities = [finding.severity for finding in report.findings]
    assert (
        severities == sorted(severities, key=["error", "warning", "note"].index) and report.faulty
    )


def test_recordings_of_two_rooms_are_reported():
    one = recording()
    two = replace(one, anchors=OTHER_ROOM)
    (finding,) = different_surveys([one, one, two])
    assert finding.rule == "surveys_differ" and finding.value > 0.1
    assert list(different_surveys([one, one])) == []


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_axis_is_turned_upwards_by_a_rotation(axis, sign):
    up = sign * 9.81 * np.eye(3)[axis] + 0.3
    turn = upright(up)
    assert np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1.0)
    assert (turn @ up)[2] > 9.0


@pytest.mark.slow
def test_a_measured_flight_and_its_mistakes(shared_data):
    """This flight was not used to choose the limits. docs/notebook/checking.md has the
    full table.
    """
    ((path, survey),) = inputs.find_flights(
        [shared_data / "flights/0426/0426-traj5"], shared_data / "surveys"
    )
    surveys = [
        (str(path), read_survey(path))
        for path in sorted((shared_data / "surveys").glob("anchor_?*"))
    ]
    flight = read_flight(path, survey)
    measured = of_flight(between(flight, -np.inf, flight.tdoa.t[0] + 40.0))
    assert check(measured, surveys).findings == []
    for mistake in ("sign", "swapped", "another_room"):
        other = dict((p.rsplit("/")[-1], a) for p, a in surveys)["anchor_const1.csv"]
        made = MISTAKES[mistake].make(measured, np.random.default_rng(1), other)
        assert names(MISTAKES[mistake], made, surveys)


# wrong causes that `check` named before
OF_ANOTHER_ROOM = {"ids_exchanged", "pair_sign", "imu_rate_unit", "imu_axes", "tdoa_sign"}


def assert_of_another_room(flight):
    found = rules(_try_corrections(OrderedRecording.of(of_flight(flight)), set(), ())[0])
    assert "survey_misfit" in found and not found & OF_ANOTHER_ROOM


@pytest.mark.slow
def test_a_survey_of_another_room_is_named():
    """Eight anchors have other positions but the same ids.

    Another order of ids explains the TDOAs as well, up to the width of the room. So both are named.
    """
    flight = clean_flight(702, 40.0)
    elsewhere = flight.anchors.positions[[3, 7, 2, 5, 0, 4, 1, 6]] * [0.8, 1.0, 1.0] + [
        0.5,
        0.0,
        0.2,
    ]
    other = of_flight(replace(flight, anchors=flight.anchors.at(elsewhere)))
    (found,), _ = _try_corrections(OrderedRecording.of(other), set(), ())
    assert found.rule == "ids_exchanged" and "give the survey of this room" in found.remedy


@pytest.mark.slow
@pytest.mark.parametrize(
    ("log", "survey"),
    [
        ("util/const1-trial2-tdoa2.csv.gz", "const4.csv"),
        ("flights/0425/TDOA2/0425-traj2", "const1.csv"),
    ],
)
def test_a_survey_of_another_room_is_named_with_a_measured_log(log, survey, shared_data):
    """For the first recording, `check` reported a wrong sign of all TDOAs."""
    (flight,) = inputs.Reading(str(shared_data / "surveys" / f"anchor_{survey}")).flights(
        [str(shared_data / log)]
    )
    assert_of_another_room(flight)


@pytest.fixture(scope="module")
def ranged():
    """Return a Flight with ranges only."""
    config = SimulationConfig(
        duration=20.0, imu_rate=200.0, truth_rate=20.0, start_in_air=True, range_noise=0.1
    )
    return replace(simulate(config), tdoa=NO_TDOAS)


def test_ranges_without_tdoas_are_judged(ranged):
    report = check(of_flight(ranged))
    assert not report.faulty and report.facts["range"] == "ranges 100 Hz"
    wrong = of_flight(replace(ranged, range=replace(ranged.range, d=1000.0 * ranged.range.d)))
    assert "range_unit" in rules(check(wrong).findings)
    assert [finding.rule for finding in sensor_mistakes(wrong)][:1] == ["range_unit"]


def test_a_bag_of_ranges_alone_is_read_and_checked(ranged, tmp_path):
    write_bag(ranged, tmp_path / "ranged.bag")
    back = read_bag(tmp_path / "ranged.bag")
    assert len(back.tdoa) == 0
    for one, other in zip(back.range.columns, ranged.range.columns):
        np.testing.assert_array_equal(one, other)
    made = read_recording(Reading(), tmp_path / "ranged.bag")
    assert len(made.sensors["range"]) == len(ranged.range) and not check(made).faulty


@pytest.mark.parametrize("protocol", ["tdoa2", "tdoa3"])
def test_two_tags_with_few_tdoas_each_are_named(protocol):
    """Each pair is heard after a second, not twice within 0.1 s."""
    given = {"protocol": protocol, "tdoa_rate": 14.0, "duration": 40.0, "imu_rate": 50.0}
    one = checking_flights.recording(1, trajectory="sines", **given)
    other = checking_flights.recording(2, trajectory="circle", **given)
    both = MISTAKES["second_tag"].make(one, None, other)
    assert "two_tags" in {one.rule for one in processed_streams(both).findings()}
    alone = checking_flights.recording(3, **{**given, "tdoa_rate": 28.0, "speed": 1.8})
    for sound in (one, alone):
        assert "two_tags" not in {one.rule for one in processed_streams(sound).findings()}


def disturbed(sound, std=0.0, share=0.0):
    """Return a Recording with more noise (m), and with a share of its TDOAs off by 1 to 3 m."""
    rng, n = np.random.default_rng(7), len(sound.tdoa)
    off = rng.uniform(1.0, 3.0, n) * rng.choice([-1.0, 1.0], n) * (rng.random(n) < share)
    d = sound.tdoa.d + off + std * rng.standard_normal(n)
    return replace(sound, tdoa=replace(sound.tdoa, d=d))


def errors(recording):
    return {finding.rule for finding in check(recording).findings if finding.severity == ERROR}


def test_outliers_are_no_second_tag():
    """6 % leap and return, as TDOAs of two tags do. One motion explains all others."""
    sound = checking_flights.recording(3, tdoa_rate=28.0, duration=60.0, protocol="tdoa2")
    wrong = disturbed(sound, share=0.06)
    assert "two_tags" in rules(processed_streams(wrong).findings())
    assert not errors(wrong)


def test_a_noisy_radio_is_in_metres():
    noisy = OrderedRecording.of(disturbed(recording(1), std=0.25))
    assert not tdoa_rules.in_metres(noisy) and tdoa_rules.other_unit(noisy) is None
    usual = OrderedRecording.of(recording(1))
    nanoseconds = usual.with_tdoa(d=usual.tdoa.d / 0.299792458)
    assert tdoa_rules.other_unit(nanoseconds)[0].rule == "tdoa_unit"


def test_a_fast_tag_does_not_contradict_its_survey():
    """In half a second it turns by a third of a radian at 10 m/s, which no constant velocity describes."""
    rng, t = np.random.default_rng(3), np.arange(8000) / 200.0
    anchors = Anchors.from_positions(np.array([*product((0.0, 40.0), (0.0, 40.0), (0.3, 6.0))]))
    turned = 10.0 / 9.0 * t
    circles = np.column_stack(
        [20.0 + 9.0 * np.cos(turned), 20.0 + 9.0 * np.sin(turned), 3.0 + 0.0 * t]
    )
    a = rng.integers(0, 8, len(t))
    b = (a + rng.integers(1, 8, len(t))) % 8
    d = tdoa(circles, anchors.positions[a], anchors.positions[b]) + 0.07 * rng.normal(size=len(t))
    fast = OrderedRecording(anchors, Tdoas(t, a, b, d, np.zeros(len(t))), None)
    assert fast.survey_fit.before > tdoa_rules.POOR and _misfit(fast) is None
