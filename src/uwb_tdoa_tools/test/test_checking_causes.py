"""Causes compete: the one that explains the most is named, and where a recording determines none,
none is an error.
"""

from dataclasses import replace
import subprocess
import sys
import time

from checking_flights import recording
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.sensors import Ranges
from uwb_tdoa_bias.common.survey import UNITS
from uwb_tdoa_tools.checking import imu_rules
from uwb_tdoa_tools.checking.check import check, sensor_findings
from uwb_tdoa_tools.checking.ordered import OrderedRecording
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.checking.tdoa_rules import GAIN, apparent_gain, gained
from uwb_tdoa_tools.readers import read_flight, read_survey
from uwb_tdoa_tools.readers.streams import make_flight

BOX = np.stack(np.meshgrid(*([0.0, 1.0],) * 3, indexing="ij"), axis=-1).reshape(-1, 3) * [
    7.0,
    8.0,
    3.0,
]
ROOM = Anchors.from_positions(BOX)
STEP = 2.0**32 * 299792458.0 / (128 * 499.2e6)  # m


def rules(report, severity=None):
    return {finding.rule for finding in report.findings if severity in (None, finding.severity)}


def with_positions(made, positions):
    return replace(made, anchors=made.anchors.at(positions))


# The survey


@pytest.mark.parametrize("unit", ["feet", "decimetres", "inches"])
def test_a_survey_in_another_unit_is_the_only_error(unit):
    made = recording()
    report = check(with_positions(made, made.anchors.positions * UNITS[unit]))
    assert rules(report, "error") == {"survey_scale"}, report.findings
    assert unit in report.findings[0].cause


@pytest.mark.parametrize("factor", [25.0])
def test_a_survey_of_any_scale_is_the_only_error(factor):
    made = recording()
    report = check(with_positions(made, made.anchors.positions * factor))
    assert rules(report, "error") == {"survey_scale"}, report.findings


@pytest.mark.parametrize("name", ["millimetres", "one place", "same place"])
def test_a_survey_that_is_wrong_by_itself_is_refused_with_its_file(name, tmp_path):
    positions = {
        "millimetres": 1000.0 * BOX,
        "one place": 0.0 * BOX,
        "same place": BOX[[0, 1, 2, 2, 4, 5, 6, 7]],
    }[name]
    Anchors.from_positions(positions).to_yaml(tmp_path / "survey.yaml")
    with pytest.raises(InputError, match="survey.yaml: "):
        read_survey(tmp_path / "survey.yaml")


CASES = {
    "mm.csv": "looks like millimetres",
    "all_zero.yaml": "all anchors are at one place",
    "same_place.yaml": "anchors 2 and 3 are at one place",
}


@pytest.fixture
def shared(shared_data):
    return shared_data.parent


@pytest.mark.parametrize(
    "command",
    [
        "check",
        "evaluate",
        "localize --out out",
        "calibrate --out out",
        "diagnose --out out",
        "convert --out out.bag",
    ],
)
@pytest.mark.parametrize("case", CASES)
def test_every_command_refuses_the_cases(command, case, shared, tmp_path):
    if not (shared / "cases").is_dir():
        pytest.skip("no cases in ../shared/cases")
    name, *rest = command.split()
    line = [
        sys.executable,
        "-m",
        f"uwb_tdoa_tools.commands.{name}",
        str(shared / "data/flights/0426/0426-traj5"),
    ]
    line += ["--survey", str(shared / "cases/anchors" / case), *rest]
    begin = time.monotonic()
    done = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert done.returncode == 2 and CASES[case] in done.stderr, done.stderr
    assert time.monotonic() - begin < 20.0  # 2 s on a machine that does nothing else


def test_the_case_in_feet_names_its_factor(shared):
    if not (shared / "cases").is_dir():
        pytest.skip("no cases in ../shared/cases")
    flight = read_flight(shared / "data/flights/0426/0426-traj5", shared / "cases/anchors/feet.csv")
    report = check(of_flight(flight))
    assert rules(report, "error") == {"survey_scale"}, report.findings
    assert "3.28" in report.findings[0].cause


def test_the_case_of_another_room_has_no_error(shared):
    if not (shared / "cases").is_dir():
        pytest.skip("no cases in ../shared/cases")
    flight = read_flight(
        shared / "cases/recordings/other_room", shared / "data/surveys/anchor_0425.txt"
    )
    report = check(of_flight(flight))
    assert not report.faulty and "misfit_unclear" in rules(report), report.findings


def flown(seconds=20.0, rate=300.0, seed=0, place=None, errors=(0.0, 0.0), anchors=ROOM):
    """OrderedRecording of TDOAs of a tag that moves, or that stands at place (3,) m; errors : m, of
    each pair, in the first half of the time and in the second.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    a = np.arange(len(t)) % 8
    b = (a + 1) % 8
    p = (
        BOX.mean(axis=0) + np.sin(np.outer(t, [0.9, 1.1, 0.7])) * [2.0, 2.5, 1.0]
        if place is None
        else np.array(place)
    )
    of_halves = np.array(errors)[:, None] * rng.normal(size=8)
    slow = of_halves[(t > 0.5 * t[-1]).astype(int), a]
    d = tdoa(p, BOX[a], BOX[b]) + slow + 0.07 * rng.normal(size=len(t))
    return OrderedRecording(anchors, Tdoas(t, a, b, d, np.zeros(len(t))), None)


def test_errors_that_change_are_no_errors_of_the_survey():
    """Anchors elsewhere explain much of each half, and nothing of the other."""
    fits = [flown(seed=seed, errors=(0.45, -0.3)).survey_fit for seed in range(6)]
    assert sum(apparent_gain(fit) > GAIN for fit in fits) >= 2
    assert [gained(fit) for fit in fits] == [None] * 6


@pytest.mark.parametrize("seed", range(4))
def test_a_survey_of_another_room_fits_both_halves_with_its_anchors_moved(seed):
    off = 1.0 * np.random.default_rng(seed).normal(size=BOX.shape)
    assert (
        gained(flown(seed=seed, errors=(0.05, 0.05), anchors=ROOM.at(BOX + off)).survey_fit)
        is not None
    )


# The inertial sensor


def standing(seed, bias, errors):
    """OrderedRecording of 12 s of a tag that stands, with a gyroscope of some bias, rad/s."""
    rng = np.random.default_rng(seed)
    t = np.arange(2400) / 200.0
    imu = Imu(
        t,
        bias * rng.normal(size=3) + 0.005 * rng.normal(size=(2400, 3)),
        [0.3, -0.2, 9.8] + 0.05 * rng.normal(size=(2400, 3)),
    )
    return replace(flown(12.0, seed=seed, place=(2.0, 5.0, 0.3), errors=errors), imu=imu)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("errors", [(0.1, 0.1), (0.3, 0.3)])
def test_a_tag_that_stands_does_not_determine_the_unit_of_its_gyroscope(seed, errors):
    assert imu_rules.find_imu_mistake(standing(seed, 0.1, errors)) is None


# Time stamps that wrap


@pytest.mark.parametrize("share", [0.08, 0.3])
def test_a_time_stamp_that_wraps_is_the_only_finding(share):
    made = recording()
    off = np.random.default_rng(1).random(len(made.tdoa)) < share
    report = check(replace(made, tdoa=replace(made.tdoa, d=made.tdoa.d + STEP * off)))
    assert rules(report) == {"tdoa_wraps"}, report.findings
    assert "2^32 ticks" in report.findings[0].cause


# What is lost is told


def log(gyro_rate=None, accel_rate=None):
    """Flight of a Crazyflie's log with sensors of some rates, Hz, or without one."""
    t = np.arange(4000) / 200.0
    streams = {
        "tdoa": {
            "t": t,
            "a": np.arange(4000) % 8,
            "b": (np.arange(4000) + 1) % 8,
            "d": np.zeros(4000),
        }
    }
    for name, rate in (("gyro", gyro_rate), ("acc", accel_rate)):
        if rate is not None:
            stamps = np.arange(int(20 * rate)) / rate
            streams[name] = {
                "t": stamps,
                **{
                    axis: 0.01 * np.random.default_rng(1).normal(size=len(stamps)) for axis in "xyz"
                },
            }
    return make_flight("log", ROOM, streams, {}, {"source": "log"})


@pytest.mark.parametrize(
    ("rates", "words"),
    [
        ((500.0, None), "the gyroscope is not used"),
        ((None, 500.0), "the accelerometer is not used"),
        ((500.0, 100.0), "gyroscope 500 Hz, accelerometer 100 Hz"),
        ((100.0, 500.0), "gyroscope 100 Hz, accelerometer 500 Hz"),
    ],
)
def test_half_an_inertial_sensor_and_unequal_rates_are_told(rates, words):
    found = {finding.rule: finding for finding in check(of_flight(log(*rates))).findings}
    assert found["imu_lost"].severity == "warning" and words in found["imu_lost"].sentence


def test_equal_rates_are_not_told():
    assert not {"imu_rates", "imu_cut"} & rules(check(of_flight(log(500.0, 500.0))))


@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.parametrize(("share", "severity"), [(0.005, None), (0.12, "warning"), (0.6, "error")])
def test_ranges_that_are_no_distances_are_told(value, share, severity):
    n = 2000
    d = np.where(np.random.default_rng(0).random(n) < share, value, 4.0)
    ranges = Ranges(np.arange(n) * 0.01, np.arange(n) % 8, d, np.zeros(n))
    flight = Flight("ranged", ROOM, Tdoas(*np.empty((4, 0))), None, range=ranges)
    found = [
        finding.severity
        for finding in sensor_findings(of_flight(flight))
        if finding.rule == "range_invalid"
    ]
    assert found == ([severity] if severity else [])
