# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Hypotheses that `check` tries on a recording without ground truth.

The cause that explains most is named. If a recording determines no cause, none is an error.
"""

from dataclasses import replace
import importlib

import checking_flights
from checking_flights import sparse_recording as recording
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.sensors import Ranges
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_tools.checking import imu_rules, tdoa_rules
from uwb_tdoa_tools.checking.check import _misfit, _try_corrections, check
from uwb_tdoa_tools.checking.coverage import sides_of
from uwb_tdoa_tools.checking.imu_rules import clipped_axes, is_smooth
from uwb_tdoa_tools.checking.ordered import (
    LEAST_MOTION,
    OrderedRecording,
    SurveyFit,
    displacement,
    second_principal_std,
)
from uwb_tdoa_tools.checking.recording import of_flight, read_recording
from uwb_tdoa_tools.checking.recording_rules import sensor_mistakes
from uwb_tdoa_tools.checking.tdoa_rules import GAIN, SAME, apparent_gain, gained
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.readers.streams import make_flight

# --- checking tdoa rules ---


@pytest.fixture(scope="module")
def healthy():
    return OrderedRecording.of(recording())


@pytest.mark.parametrize(
    "scale, unit",
    [
        (1e3, "millimetres"),
        (1.0 / 0.0046917639, "ticks"),
        (1.0 / 0.299792458, "nanoseconds"),
        (1e-6 / 299.792458, "seconds"),
    ],
)
def test_a_unit_is_found_and_undone(healthy, scale, unit):
    finding, undone = tdoa_rules.best_trial(healthy.with_tdoa(d=scale * healthy.tdoa.d))
    assert finding.rule == "tdoa_unit" and unit in finding.cause
    assert np.allclose(undone.tdoa.d, healthy.tdoa.d)


class Fit(list):
    """A survey that does not fit in ten windows."""

    before, all_moved, radio_loss, positions, flat = 0.48, (0.21, None), 1.0, [0] * 8, False
    thin = False

    def __init__(self, seconds):
        super().__init__(range(10))
        self.seconds = seconds


@pytest.mark.parametrize(("seconds", "gain"), [(1.2, None), (3.0, pytest.approx(0.27))])
def test_no_survey_is_judged_by_a_second(seconds, gain):
    """Windows that overlap show one place of the room."""
    assert tdoa_rules.gained(Fit(seconds)) == gain


def test_feet_are_named_beside_nanoseconds(healthy):
    """A foot is 1.017 ns: no recording tells them apart."""
    finding, _ = tdoa_rules.best_trial(healthy.with_tdoa(d=healthy.tdoa.d / 0.3048))
    assert finding.cause == "TDOAs are in nanoseconds or in feet, not in metres"
    assert finding.remedy.endswith("0.299792458  # of nanoseconds; of feet 0.3048")


@pytest.mark.slow
def test_swapped_ids_are_found_and_undone(healthy):
    one, two = healthy.anchors.ids[[2, 5]].tolist()
    swapped = tdoa_rules.relabelled(healthy, {one: two, two: one})
    finding, undone = tdoa_rules.best_trial(swapped)
    assert finding.rule == "ids_exchanged" and finding.severity == "error"
    assert np.array_equal(undone.tdoa.a, healthy.tdoa.a) and np.array_equal(
        undone.tdoa.b, healthy.tdoa.b
    )
    assert str({one: two, two: one}) in finding.remedy


def test_surveys_of_one_room_are_named_together(healthy):
    wrong = replace(
        healthy,
        anchors=Anchors(
            healthy.anchors.ids, healthy.anchors.positions[::-1], healthy.anchors.orientations
        ),
    )
    by_millimetres = Anchors(
        healthy.anchors.ids, healthy.anchors.positions + 0.004, healthy.anchors.orientations
    )
    trials = list(
        tdoa_rules.other_survey(
            wrong, [("monday.yaml", healthy.anchors), ("tuesday.yaml", by_millimetres)]
        )
    )
    assert len(trials) == 1 and "monday.yaml or tuesday.yaml" in trials[0].finding.cause
    assert list(tdoa_rules.other_survey(healthy, [("monday.yaml", by_millimetres)])) == []


def test_ids_are_not_tried_without_motion():
    hovering = OrderedRecording.of(recording(10, trajectory="hover"))
    assert second_principal_std(hovering.survey_fit.places) < LEAST_MOTION
    assert [trial.finding.rule for trial in tdoa_rules.judged(hovering)] == ["tdoa_sign"]


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_positions_are_no_motion(count):
    assert second_principal_std(np.ones((count, 3))) == 0.0


def test_motion_is_measured_across_the_main_direction():
    t = np.linspace(-1.0, 1.0, 101)
    along, across = np.outer(t, [3.0, 0.0, 0.0]), np.outer(t**2, [0.0, 1.0, 0.0])
    assert second_principal_std(along) == pytest.approx(0.0, abs=1e-9)
    assert second_principal_std(along + across) == pytest.approx(np.std(t**2))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, begin, seconds",
    [
        ("0422/0422-log02", 0.0, 16.0),
        ("0425/TDOA2/0425-traj1", 0.0, 12.0),
        ("0426/0426-traj11", 25.0, 25.0),
    ],
)
def test_no_piece_of_a_measured_flight_has_the_survey_of_another_room(
    shared_data, name, begin, seconds
):
    (found,) = Reading(shared_data / "surveys").find([shared_data / "flights" / name])
    whole = OrderedRecording.of(read_recording(Reading(), *found))
    start = whole.tdoa.t[0] + begin
    rows = slice(*np.searchsorted(whole.tdoa.t, [start, start + seconds]))
    piece = replace(whole, tdoa=rows_of(whole.tdoa, rows), imu=None)
    assert tdoa_rules.apparent_gain(piece.survey_fit) > 0.065  # the previous limit
    assert tdoa_rules.gained(piece.survey_fit) is None


# --- checking imu rules ---


T = np.arange(0.0, 20.0, 0.001)
VALUES = np.random.default_rng(0).standard_normal((len(T), 3))


def causes(gyro=VALUES, accel=VALUES):
    return [finding.cause for finding in clipped_axes(Flight("f", None, None, Imu(T, gyro, accel)))]


def test_noise_is_not_clipped_even_if_quantized():
    coarse = np.round(VALUES / 0.3) * 0.3
    assert causes() == causes(coarse, np.zeros_like(VALUES)) == []


@pytest.mark.parametrize("low, high", [(-2.0, 2.0), (-9.0, 1.5), (-1.8, 9.0)])
def test_a_clipped_axis_is_found(low, high):
    accel = VALUES.copy()
    accel[:, 1] = np.clip(accel[:, 1], low, high)
    assert causes(accel=accel) == ["accelerometer y is clipped"]


def test_samples_behind_a_low_pass_are_smooth():
    share = 0.001 / 0.051
    filtered = lfilter([share], [1.0, share - 1.0], VALUES, axis=0)
    assert is_smooth(T, np.cumsum(filtered, axis=0)) and not is_smooth(T, VALUES)
    assert not is_smooth(20.0 * T, np.cumsum(filtered, axis=0))


@pytest.mark.slow
def test_a_turn_about_the_vertical_cannot_be_seen(healthy):
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = healthy.with_imu(
        gyro=healthy.imu.gyro @ quarter.T, accel=healthy.imu.accel @ quarter.T
    )
    assert imu_rules.find_imu_mistake(turned) is None


@pytest.mark.parametrize(
    "accel, gyro, words",
    [
        (np.eye(3), np.diag([1.0, -1.0, 1.0]), "w.x, w.y, w.z = w.x, -w.y, w.z"),
        (
            imu_rules.MIRROR,
            imu_rules.MIRROR,
            "a.x, a.y, a.z = a.x, -a.y, a.z; w.x, w.y, w.z = w.x, -w.y, w.z",
        ),
        (np.eye(3), np.eye(3)[[1, 2, 0]], "w.x, w.y, w.z = w.y, w.z, w.x"),
    ],
)
def test_the_remedy_is_the_matrix_in_words(accel, gyro, words):
    assert imu_rules._finding(accel, gyro).remedy == words


# --- checking ordered ---


BOX = np.array([[x, y, z] for x in (0.0, 6.0) for y in (0.0, 7.0) for z in (0.2, 3.0)])


def measured(positions, seconds=40.0, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.004)
    a = rng.integers(0, 8, len(t))
    b = (a + rng.integers(1, 8, len(t))) % 8
    p = [3.0, 3.5, 1.5] + np.sin(np.outer(t, [0.5, 0.7, 0.3])) * [2.0, 2.5, 1.0]
    return t, a, b, tdoa(p, positions[a], positions[b]) + noise * rng.normal(size=len(t))


def test_a_right_survey_is_not_moved():
    fit = SurveyFit(*measured(BOX), BOX)
    left, anchors = fit.solve()
    assert left <= fit.before and gained(fit) is None
    assert displacement(BOX, anchors).max() < SAME


@pytest.mark.slow
@pytest.mark.parametrize(
    "row, shift", [(0, [1.0, 0.0, 0.0]), (5, [0.0, -1.5, 0.0]), (7, [0.5, 0.5, -1.0])]
)
def test_a_moved_anchor_is_found(row, shift):
    surveyed = BOX.copy()
    surveyed[row] -= shift
    fit = SurveyFit(*measured(BOX), surveyed)
    alone = [fit.solve([k]) for k in range(8)]
    assert int(np.argmin([loss for loss, _ in alone])) == row
    assert np.allclose(alone[row][1][row], BOX[row], atol=0.25)
    others = np.delete(np.arange(8), row)
    assert np.array_equal(alone[row][1][others], surveyed[others])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_rotation_and_translation_are_no_displacement(seed):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-5.0, 5.0, (6, 3))
    moved = Rotation.random(random_state=seed).apply(positions) + rng.normal(size=3)
    assert displacement(positions, moved).max() < 1e-9
    mirrored = moved * [1.0, 1.0, -1.0]
    assert displacement(positions, mirrored).max() > 1e-3  # a mirror image is a different survey


def test_errors_that_depend_on_the_place_are_no_moved_anchors():
    """Each anchor is late or early by up to a metre, as a linear function of the place."""
    t, a, b, d = measured(BOX)
    p = [3.0, 3.5, 1.5] + np.sin(np.outer(t, [0.5, 0.7, 0.3])) * [2.0, 2.5, 1.0]
    slopes = 0.3 * np.random.default_rng(4).normal(size=(8, 3))
    late = (p - BOX.mean(axis=0)) @ slopes.T
    rows = np.arange(len(t))
    fit = SurveyFit(t, a, b, d + late[rows, b] - late[rows, a], BOX)
    assert apparent_gain(fit) > GAIN and fit.held_out_gain > tdoa_rules.HELD
    assert gained(fit) is None


def test_anchors_in_a_plane_tell_nothing_of_the_survey_or_of_the_inertial_sensor():
    level = BOX * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.5]
    assert SurveyFit(*measured(BOX), level).flat and not SurveyFit(*measured(BOX), BOX).flat
    made = OrderedRecording.of(recording(2))
    assert imu_rules.find_imu_mistake(replace(made, anchors=made.anchors.at(level))) is None


def test_an_imu_of_another_tag_is_not_in_another_unit(healthy):
    imu = OrderedRecording.of(recording(1, trajectory="square", yaw="fixed")).imu
    late = imu.t + healthy.tdoa.t[0] - imu.t[0]
    found = imu_rules.find_imu_mistake(replace(healthy, imu=replace(imu, t=late)))
    assert found.rule == "imu_other_body" and found.severity == "error"


@pytest.mark.slow
def test_a_measured_imu_of_another_time_is_named(shared):
    """The TDOAs fit only a sixth better without it."""
    survey = shared / "data/surveys/anchor_0422.txt"
    flight = read_flight(shared / "data/flights/0422/0422-log00", survey)
    made = OrderedRecording.of(of_flight(flight))
    later = int(0.4 * len(made.imu))
    rates, forces = (np.roll(column, later, 0) for column in (made.imu.gyro, made.imu.accel))
    assert imu_rules.find_imu_mistake(made) is None
    found = imu_rules.find_imu_mistake(made.with_imu(gyro=rates, accel=forces))
    assert found.rule == "imu_other_body" and "17 %" in found.evidence


def test_a_gyroscope_that_turns_as_gravity_does_not_is_no_explanation(healthy):
    scale = max(imu_rules.SCALES)
    assert not imu_rules._is_possible(healthy.imu, scale * np.eye(3))
    slow = replace(healthy.imu, gyro=healthy.imu.gyro / scale)
    assert imu_rules._is_possible(slow, scale * np.eye(3))


def test_anchors_in_a_line_have_no_sides():
    along = np.linspace(-4.0, 4.0, 6)
    assert sides_of(np.column_stack([along, 0.5 * along, np.full(6, 2.8)])) == ()


def test_few_tdoas_make_no_window():
    t, a, b, d = (column[:20] for column in measured(BOX))
    assert len(SurveyFit(t, a, b, d, BOX)) == 0
    assert len(SurveyFit(*(column[:0] for column in (t, a, b, d)), BOX)) == 0


# --- checking causes ---


CORNERS = np.stack(np.meshgrid(*([0.0, 1.0],) * 3, indexing="ij"), axis=-1).reshape(-1, 3) * [
    7.0,
    8.0,
    3.0,
]
ROOM = Anchors.from_positions(CORNERS)
STEP = 2.0**32 * 299792458.0 / (128 * 499.2e6)  # m


def rules(report, severity=None):
    return {finding.rule for finding in report.findings if severity in (None, finding.severity)}


def with_positions(made, positions):
    return replace(made, anchors=made.anchors.at(positions))


# The survey


@pytest.mark.slow
def test_a_survey_of_another_scale_is_the_only_error():
    made = recording()
    report = check(with_positions(made, made.anchors.positions * 25.0))
    assert rules(report, "error") == {"survey_scale"}, report.findings


CASES = {
    "mm.csv": "looks like millimetres",
    "all_zero.yaml": "all anchors are at one place",
    "same_place.yaml": "anchors 2 and 3 are at one place",
}


@pytest.fixture
def shared(shared_data):
    if not (shared_data.parent / "cases").is_dir():
        pytest.skip("no cases in ../shared/cases")
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
def test_every_command_refuses_the_cases(command, shared, tmp_path, monkeypatch, capsys):
    """The commands fail before they start workers or write files."""
    name, *rest = command.split()
    main = importlib.import_module(f"uwb_tdoa_tools.commands.{name}").main
    monkeypatch.chdir(tmp_path)
    for case, said in CASES.items():
        survey = ["--survey", str(shared / "cases/anchors" / case)]
        assert main([str(shared / "data/flights/0426/0426-traj5"), *survey, *rest]) == 2
        assert said in capsys.readouterr().err
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def with_errors(recording, errors):
    """Return an OrderedRecording with errors (n, N) m of the anchors at each TDOA."""
    n, (a, b) = np.arange(len(recording.tdoa)), recording.rows()
    return recording.with_tdoa(d=recording.tdoa.d + errors[n, b] - errors[n, a])


@pytest.mark.parametrize("seed", [0, 1])
def test_several_late_anchors_are_named_and_none_is_moved(seed):
    sound = OrderedRecording.of(recording(seed))
    late = np.isin(np.arange(len(sound.anchors)), [1, 4, 6]).astype(float)
    wrong = with_errors(sound, np.tile(late, (len(sound.tdoa), 1)))
    found, _ = _try_corrections(wrong, set(), ())
    assert [one.rule for one in found] == ["anchors_late"]


def test_errors_that_depend_on_the_place_blame_no_anchor():
    made = checking_flights.recording(0)  # half of the TDOAs do not determine the cause
    sound, truth = OrderedRecording.of(made), made.truth
    p = np.stack([np.interp(sound.tdoa.t, truth.t, column) for column in truth.p.T], axis=1)
    slopes = 0.4 * np.random.default_rng(5).standard_normal((len(sound.anchors), 3))
    wrong = with_errors(sound, (p - p.mean(axis=0)) @ slopes.T)
    found = _misfit(wrong)
    assert found is not None and found.rule == "radio_errors"
    assert not list(tdoa_rules.moved_anchor(wrong))


@pytest.mark.slow
def test_the_case_in_feet_names_its_factor(shared):
    flight = read_flight(shared / "data/flights/0426/0426-traj5", shared / "cases/anchors/feet.csv")
    report = check(of_flight(flight))
    assert rules(report, "error") == {"survey_scale"}, report.findings
    assert "3.28" in report.findings[0].cause


@pytest.mark.slow
def test_the_case_of_another_room_has_no_error(shared):
    flight = read_flight(
        shared / "cases/recordings/other_room", shared / "data/surveys/anchor_0425.txt"
    )
    report = check(of_flight(flight))
    assert not report.faulty and "misfit_unclear" in rules(report), report.findings


def flown(seconds=20.0, rate=300.0, seed=0, place=None, errors=(0.0, 0.0), anchors=ROOM):
    """Return an OrderedRecording of TDOAs of a moving tag, or of a tag at rest.

    place : position of a tag at rest (3,), m
    errors : standard deviations of the errors of the pairs, m, in the first and in the second half
    """
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    a = np.arange(len(t)) % 8
    b = (a + 1) % 8
    p = (
        CORNERS.mean(axis=0) + np.sin(np.outer(t, [0.9, 1.1, 0.7])) * [2.0, 2.5, 1.0]
        if place is None
        else np.array(place)
    )
    of_halves = np.array(errors)[:, None] * rng.normal(size=8)
    slow = of_halves[(t > 0.5 * t[-1]).astype(int), a]
    d = tdoa(p, CORNERS[a], CORNERS[b]) + slow + 0.07 * rng.normal(size=len(t))
    return OrderedRecording(anchors, Tdoas(t, a, b, d, np.zeros(len(t))), None)


@pytest.mark.slow
def test_errors_that_change_are_no_errors_of_the_survey():
    """Other anchor positions explain much of one half, but nothing of the other half."""
    fits = [flown(seed=seed, errors=(0.45, -0.3)).survey_fit for seed in range(6)]
    assert sum(apparent_gain(fit) > GAIN for fit in fits) >= 2
    assert [gained(fit) for fit in fits] == [None] * 6


@pytest.mark.parametrize("seed", range(2))
def test_a_survey_of_another_room_fits_both_halves_with_its_anchors_moved(seed):
    off = 1.0 * np.random.default_rng(seed).normal(size=CORNERS.shape)
    assert (
        gained(flown(seed=seed, errors=(0.05, 0.05), anchors=ROOM.at(CORNERS + off)).survey_fit)
        is not None
    )


# The inertial sensor


def standing(seed, bias, errors):
    """Return an OrderedRecording of 12 s of a tag at rest. bias : of the gyroscope, rad/s."""
    rng = np.random.default_rng(seed)
    t = np.arange(2400) / 200.0
    imu = Imu(
        t,
        bias * rng.normal(size=3) + 0.005 * rng.normal(size=(2400, 3)),
        [0.3, -0.2, 9.8] + 0.05 * rng.normal(size=(2400, 3)),
    )
    return replace(flown(12.0, seed=seed, place=(2.0, 5.0, 0.3), errors=errors), imu=imu)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("errors", [(0.1, 0.1), (0.3, 0.3)])
def test_a_tag_that_stands_does_not_determine_the_unit_of_its_gyroscope(seed, errors):
    assert imu_rules.find_imu_mistake(standing(seed, 0.1, errors)) is None


# Time stamps that wrap


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.08, 0.3])
def test_a_time_stamp_that_wraps_is_the_only_finding(share):
    made = recording()
    off = np.random.default_rng(1).random(len(made.tdoa)) < share
    report = check(replace(made, tdoa=replace(made.tdoa, d=made.tdoa.d + STEP * off)))
    assert rules(report) == {"tdoa_wraps"}, report.findings
    assert "2^32 ticks" in report.findings[0].cause


# Unused data is reported


def log(gyro_rate=None, accel_rate=None):
    """Return the Flight of a Crazyflie log. gyro_rate, accel_rate : Hz, or None without
    the sensor.
    """
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
        for finding in sensor_mistakes(of_flight(flight))
        if finding.rule == "range_invalid"
    ]
    assert found == ([severity] if severity else [])


ORDERS = {
    "turned by one": [1, 2, 3, 4, 5, 6, 7, 0],
    "three": [0, 5, 2, 1, 4, 3, 6, 7],
    "two pairs": [2, 1, 0, 3, 7, 5, 6, 4],
    "four": [0, 7, 2, 1, 4, 3, 6, 5],
    "any": [3, 6, 0, 5, 7, 2, 4, 1],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ORDERS)
def test_any_order_of_ids_from_the_start_is_named(name):
    """Four exchanged ids were "TDOAs in nanoseconds", and ids turned by one a wrong sign."""
    sound = OrderedRecording.of(recording(0, constellation="staircase"))
    ids = sound.anchors.ids
    received = dict(zip(ids.tolist(), ids[ORDERS[name]].tolist()))
    (found, *_), _ = _try_corrections(tdoa_rules.relabelled(sound, received), set(), ())
    table = {to: one for one, to in received.items() if one != to}
    assert found.rule == "ids_exchanged" and found.remedy.startswith(
        f"id = {dict(sorted(table.items()))}"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "up", [(0, 1, False), (0, -1, True), (1, 1, False), (1, -1, False), (2, -1, False)]
)
def test_any_axis_of_a_survey_may_point_up(up):
    sound = OrderedRecording.of(recording(0))
    turn = imu_rules._upright(*up)
    wrong = replace(
        sound, anchors=sound.anchors.at(sound.anchors.positions @ np.linalg.inv(turn).T)
    )
    found = imu_rules.find_imu_mistake(wrong)
    words = ", ".join(imu_rules.signed_axis(row) for row in turn)
    assert found.rule == "survey_upside_down" and found.remedy.startswith(f"x, y, z = {words} ")


@pytest.mark.slow
def test_a_left_handed_survey_is_a_mirror_image_and_not_upside_down():
    sound = OrderedRecording.of(recording(0, duration=45.0))
    wrong = replace(sound, anchors=sound.anchors.at(sound.anchors.positions[:, [1, 0, 2]]))
    assert imu_rules.find_imu_mistake(wrong).rule == "survey_mirrored"
