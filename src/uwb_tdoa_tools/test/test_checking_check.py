# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Findings of `check` on whole recordings: none if healthy, otherwise the mistake."""

from dataclasses import replace

import checking_flights
from checking_flights import QUICK
from known_effects import clean_flight
from mistakes import MISTAKES
import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.checking.check import check, different_surveys, upright
from uwb_tdoa_tools.checking.recording import of_flight, read_recording
from uwb_tdoa_tools.checking.recording_rules import sensor_mistakes
from uwb_tdoa_tools.readers import inputs, read_flight, read_survey
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.rooms import constellation

OTHER_ROOM = constellation("random-5")
NO_TDOAS = Tdoas(*(np.empty(0, kind) for kind in (float, int, int, float)))
# with these errors, `check` examines the streams only
NOTHING_TRIED = ["stamp_zero", "clipped", "jump"]
LONGER = {"mirrored_survey": {"duration": 30.0}}  # visible once the yaw is known
RATE = 200.0  # TDOAs a second: half of what a tag hears, and trials take half of the time
HARMLESS = "clipped_accel"  # a smooth simulated flight does not reach the limits


def recording(seed=0, **settings):
    """Return the Recording of a simulated flight with RATE TDOAs a second."""
    return checking_flights.recording(seed, tdoa_rate=RATE, **settings)


def rules(report):
    return {finding.rule for finding in report.findings}


def with_mistake(name, seed=0):
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
    return check(made, others)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["tdoa2", "tdoa3"])
@pytest.mark.parametrize("live", [False, True])
def test_a_healthy_flight_has_no_finding(protocol, live):
    assert check(recording(0, live=live, protocol=protocol)).findings == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trajectory", "room"),
    [
        ("circle", "corners"),
        ("square", "random-3"),
        ("line_x", "random-8-6"),
        ("rising_circle", "random-3"),
        ("hover", "corners"),
        ("hover", "random-8-6"),
    ],
)
def test_healthy_flights_have_no_error(trajectory, room):
    report = check(
        recording(trajectory=trajectory, constellation=room), [("other.yaml", OTHER_ROOM)]
    )
    assert not report.faulty, report.findings


@pytest.mark.parametrize(
    "name",
    [
        name if name in NOTHING_TRIED else pytest.param(name, marks=pytest.mark.slow)
        for name in MISTAKES
        if name != HARMLESS
    ],
)
def test_a_mistake_is_named(name):
    report = with_mistake(name)
    assert rules(report) & set(MISTAKES[name].named), report.findings


def test_ranges_alone_show_a_survey_upside_down():
    flight = simulate(SimulationConfig(seed=0, range_noise=0.1, **QUICK))
    healthy = of_flight(replace(flight, tdoa=NO_TDOAS))
    upside_down = MISTAKES["upside_down_survey"].make(healthy, None, None)
    assert "survey_upside_down" in rules(check(upside_down))
    assert rules(check(healthy)) == set()


@pytest.mark.slow
def test_two_mistakes_at_once_are_both_named():
    made = MISTAKES["in_g"].make(MISTAKES["sign"].make(recording(), None, None), None, None)
    assert {"imu_force_unit", "tdoa_sign"} <= rules(check(made))


def test_errors_come_first():
    report = with_mistake("three_anchors")
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
    measured = of_flight(read_flight(path, survey))
    assert check(measured, surveys).findings == []
    for mistake in ("sign", "swapped", "another_room"):
        other = dict((p.rsplit("/")[-1], a) for p, a in surveys)["anchor_const1.csv"]
        made = MISTAKES[mistake].make(measured, np.random.default_rng(1), other)
        assert rules(check(made, surveys)) & set(MISTAKES[mistake].named)


# wrong causes that `check` named before
OF_ANOTHER_ROOM = {"ids_swapped", "pair_sign", "imu_rate_unit", "imu_axes", "tdoa_sign"}


@pytest.mark.slow
def test_a_survey_of_another_room_is_named():
    """Eight anchors have other positions but the same ids.

    Many exchanged ids explain most of the error. A slower gyroscope explains the rest.
    """
    flight = clean_flight(702, 40.0)
    elsewhere = flight.anchors.positions[[3, 7, 2, 5, 0, 4, 1, 6]] * [0.8, 1.0, 1.0] + [
        0.5,
        0.0,
        0.2,
    ]
    found = rules(check(of_flight(replace(flight, anchors=flight.anchors.at(elsewhere)))))
    assert "survey_misfit" in found and not found & OF_ANOTHER_ROOM


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
    found = rules(check(of_flight(flight)))
    assert "survey_misfit" in found and not found & OF_ANOTHER_ROOM


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
    assert "range_unit" in rules(check(wrong))
    assert [finding.rule for finding in sensor_mistakes(wrong)][:1] == ["range_unit"]


def test_a_bag_of_ranges_alone_is_read_and_checked(ranged, tmp_path):
    write_bag(ranged, tmp_path / "ranged.bag")
    back = read_bag(tmp_path / "ranged.bag")
    assert len(back.tdoa) == 0
    for one, other in zip(back.range.columns, ranged.range.columns):
        np.testing.assert_array_equal(one, other)
    made = read_recording(Reading(), tmp_path / "ranged.bag")
    assert len(made.sensors["range"]) == len(ranged.range) and not check(made).faulty
