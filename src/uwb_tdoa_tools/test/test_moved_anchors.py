# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors moved or exchanged before or during a recording.

The tools must name these anchors and blame no others.
"""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorDelay, AnchorPosition
from uwb_tdoa_bias.effects.effect_set import Covariance
from uwb_tdoa_ekf.evidence import keys_of
from uwb_tdoa_ekf.monitoring.finding import ERROR, WARNING, Finding
from uwb_tdoa_ekf.results import concatenated, rows_of
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.checking import watch
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.commands import diagnose, evaluate, survey
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.diagnosis.self_calibration.solve import AnchorChange
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.localizing.localize import GOOD, assess
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.vehicles import Trajectory
from uwb_tdoa_tools.surveying.report import as_text

pytestmark = pytest.mark.slow  # diagnoses and surveys whole flights

SHIFT, ROW = np.array([0.4, -0.3, 0.3]), 3
CONFIG = SimulationConfig(
    seed=21,
    duration=40.0,
    tdoa_rate=200.0,
    imu_rate=200.0,
    truth_rate=100.0,
    bias=False,
    multipath=False,
)


def flown(positions=None):
    """Return a flight among the surveyed anchors, or other positions.

    The path is always the same.
    """
    filled, room = CONFIG.complete()
    moved = None if positions is None else filled.anchors.at(positions)
    return replace(
        simulate(
            replace(CONFIG, anchors=moved),
            Trajectory.of_config(filled, room, np.random.default_rng(1)),
        ),
        anchors=filled.anchors,
    )


@pytest.fixture(scope="module")
def sound():
    return flown()


@pytest.fixture(scope="module")
def moved(sound):
    positions = sound.anchors.positions.copy()
    positions[ROW] += SHIFT
    return flown(positions)


@pytest.fixture(scope="module")
def exchanged(sound):
    def other(ids):
        return np.select([ids == 2, ids == 5], [5, 2], ids)

    return replace(sound, tdoa=replace(sound.tdoa, a=other(sound.tdoa.a), b=other(sound.tdoa.b)))


@pytest.fixture(scope="module")
def calibrated(sound):
    """Return a calibration without errors.

    Standard deviations: 2 cm for coordinates, 1 cm for delays.
    """
    keys = keys_of(sound.anchors.ids)
    n = len(sound.anchors)
    known = Covariance(keys, np.diag(np.repeat([0.02**2, 0.01**2], [3 * n, n])))
    none = {
        name: {key: 0.0 for effect, key in keys if effect == name}
        for name in ("anchor_position", "anchor_delay")
    }
    return EffectSet(
        (AnchorPosition(none["anchor_position"]), AnchorDelay(none["anchor_delay"])), known
    )


def far_moved():
    """Return a flight in a random room with one anchor moved by half a metre.

    Returns (Flight, row of the anchor, shift (3,) m).
    """
    rates = {"tdoa_rate": 200.0, "imu_rate": 200.0, "truth_rate": 100.0}
    config = SimulationConfig(seed=2, constellation="random-2-8", bias=False, **rates)
    filled, room = config.complete()
    anchors, row = filled.anchors, 6
    positions = anchors.positions.copy()
    shift = np.array([0.45, 0.1, 0.1])
    positions[row] += shift
    path = Trajectory.of_config(filled, room, np.random.default_rng([2, 1]))
    flight = simulate(replace(config, anchors=anchors.at(positions)), path)
    return replace(flight, anchors=anchors, truth=None), row, shift


def from_the_middle_on(flight, other):
    """Return the first half of one flight and the second half of the other."""
    middle = flight.tdoa.t[0] + 0.5 * np.ptp(flight.tdoa.t)
    return replace(
        flight,
        tdoa=concatenated(
            [
                rows_of(flight.tdoa, flight.tdoa.t < middle),
                rows_of(other.tdoa, other.tdoa.t >= middle),
            ]
        ),
    )


def said(flight, effects=None, line=None):
    return {
        finding.rule: finding
        for finding in check(of_flight(flight), (), FlightEstimator(None, effects), line).findings
    }


def test_nothing_is_said_of_anchors_that_stand_where_they_should(sound, calibrated):
    assert said(sound, calibrated) == {}


def test_an_anchor_that_was_moved_before_the_start_is_named_with_the_command_that_mends_it(
    moved, calibrated
):
    found = said(moved, calibrated, "survey flight.bag --effects effects.yaml")
    (one,) = found.values()
    assert (
        one.rule in ("anchor_displaced", "anchor_moved")
        and "anchor 3 does not stand where the survey has it" in one.cause
    )
    assert one.remedy.startswith("survey flight.bag --effects effects.yaml")


@pytest.mark.quick
def test_what_check_says_of_an_anchor_holds_the_doubt_of_the_monitor():
    """The monitor could not separate two anchors, but `check` named only the first."""
    one = Finding(
        "anchor_moved", ERROR, "anchor 5 is not where the survey has it", "explains", "", 0.0
    )
    cause = "anchor 3 or 5 does not stand where the survey has it, but if it is anchor 3, about"
    remedy = "survey RECORDING --survey anchors.yaml  # or measure them again"
    other = Finding("anchor_displaced", WARNING, cause, "standard deviations", remedy, 0.4)
    assert watch._named(one) == ["5"] and watch._named(other) == ["3", "5"]
    seen = watch._as_seen_by(one, other, "survey flight.bag")
    assert seen.cause == cause and seen.severity == ERROR
    assert seen.remedy == "survey flight.bag  # or measure them again"


def test_localize_doubts_a_flight_with_a_moved_anchor_and_says_why(sound, moved, calibrated):
    estimator = FlightEstimator(None, calibrated)
    good, doubtful = (
        assess(replace(flight, truth=None), estimator(flight), estimator)
        for flight in (sound, moved)
    )
    assert (
        good.level == GOOD
        and doubtful.level != GOOD
        and "anchor 3 does not stand" in doubtful.reasons[0]
    )


def test_what_happens_in_the_middle_of_a_recording_is_named_with_its_time(
    sound, moved, exchanged, calibrated
):
    (change,) = said(from_the_middle_on(sound, moved), calibrated).values()
    assert change.rule in ("anchor_changed", "anchor_displaced") and change.cause.startswith(
        "anchor 3"
    )
    (swap,) = said(from_the_middle_on(sound, exchanged)).values()
    assert (
        swap.rule == "ids_exchanged"
        and swap.cause.endswith("2 and 5")
        and 18.0 < float(swap.evidence.split()[1]) < 34.0
    )


def test_with_exchanged_ids_evaluate_blames_neither_the_truth_nor_itself(
    exchanged, tmp_path, capsys
):
    """`evaluate` reported "tilted by 89.6 degrees" and returned 0."""
    write_bag(exchanged, tmp_path / "flight")
    code = evaluate.main([str(tmp_path / "flight")])
    out, err = capsys.readouterr()
    assert code == int("DIVERGED" in out) and "tilted by" not in err
    assert "two anchors are exchanged, 2 and 5" in err


@pytest.mark.parametrize(("command", "options"), [(survey, ()), (diagnose, ("--no-truth",))])
def test_ids_are_asked_for_before_anchors(exchanged, tmp_path, capsys, command, options):
    """`survey` moved a third anchor by 58, 56 and 91 cm."""
    begin = exchanged.tdoa.t[0]
    write_bag(between(exchanged, begin, begin + 25.0), tmp_path / "flight")
    out = tmp_path / "out"
    assert command.main([str(tmp_path / "flight"), *options, "--out", str(out)]) == 1
    said = capsys.readouterr()
    assert "exchanged, 2 and 5" in said.out and "stopped, and nothing" in said.err
    assert not (out / "anchors.yaml").exists() and not (out / "effects.yaml").exists()


@pytest.fixture(scope="module")
def calibration(moved):
    """Return the self-calibration of the flight with the moved anchor 3, without ground truth."""
    return self_calibrate([replace(moved, truth=None)], Tape(std=0.05))


def test_one_moved_anchor_is_found_as_such_without_ground_truth(calibration):
    """The shift was spread over other anchors, because a tape has errors everywhere."""
    (change,) = calibration.changes
    assert change.effect == "anchor_position" and change.anchor == "3"
    assert np.linalg.norm(calibration.shifts[ROW] - SHIFT) < 0.08
    others, stated = (
        np.delete(values, ROW, axis=0) for values in (calibration.shifts, calibration.position_std)
    )
    assert (np.abs(others) < stated).all()


def test_one_that_the_filter_rejects_is_placed_by_all_of_its_tdoas():
    """Rejected TDOAs were not in the equations. No anchor was named, and 0.4 m remained."""
    flight, row, shift = far_moved()
    found = self_calibrate([flight], Tape(std=0.05))
    (change,) = found.changes
    assert change.anchor == str(flight.anchors.ids[row]) and not change.others
    off, std = found.shifts[row] - shift, found.position_std[row]
    stated = np.linalg.norm(std)
    assert np.linalg.norm(off) < max(0.08, stated) and (np.abs(off) < 3.0 * std).all()
    assert ("The flights determine its place" in change.as_text()) == (stated > 0.08)
    assert found.left < 0.5 * found.before


def test_a_sound_flight_has_no_moved_anchor(sound):
    assert not self_calibrate([replace(sound, truth=None)], Tape(std=0.05)).changes


def test_errors_of_antennas_are_no_moved_anchor(shared_data):
    """One anchor absorbed part of the antenna errors of the others."""
    where = shared_data / "surveys" / "anchor_0426.txt"
    flight = read_flight(shared_data / "flights/0426/0426-traj13", where)
    assert not self_calibrate([replace(flight, truth=None)], Tape(std=0.05)).changes


@pytest.mark.quick
def test_a_place_that_is_hardly_determined_is_stated_as_such():
    sure = AnchorChange("anchor_position", "3", np.full(3, 0.4), np.full(3, 0.02))
    assert sure.as_text().endswith("cm (x, y, z)")
    unsure = replace(sure, std=np.full(3, 0.1), others=("5",))
    assert ", or anchor 5 has moved instead" in unsure.as_text()
    assert "The flights determine its place to 17 cm only" in unsure.as_text()


def test_nothing_is_said_to_be_untold_of_an_anchor_that_has_moved(calibration):
    prior = calibration.prior.covariance
    told = replace(calibration, solution=replace(calibration.solution, covariance=prior))
    (line,) = (
        line for line in as_text(told).splitlines() if line.startswith("the flights do not improve")
    )
    assert "3" not in line and "anchor 3 has moved" in as_text(told)


def test_anchors_of_a_hall_that_are_left_behind_are_no_fault():
    """There were 44 warnings such as "look at its power"."""
    grid = np.array(
        [[10.0 * i, 10.0 * k, 3.0 + 2.0 * ((i + k) % 2)] for i in range(9) for k in range(5)]
    )
    hall = Anchors.from_positions(grid)
    drive = SimulationConfig(
        anchors=hall,
        radio_reach=25.0,
        trajectory="line_x",
        radius=30.0,
        speed=3.0,
        duration=35.0,
        imu_rate=200.0,
        bias=False,
    )
    found = said(simulate(drive))
    assert len(hall) == 45 and not {"anchor_silent", "anchor_missing", "anchor_rare"} & set(found)
