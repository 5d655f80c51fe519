# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Distances to anchors: update, start and corrections. Live and offline results agree."""

from dataclasses import replace

from flights import errors_of, fly, only_ranges, rms_error, rms_error as error
from live import IMU, TDOA, assert_same, feed, messages
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import Ranges
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.anchor_table import AnchorTable
from uwb_tdoa_ekf.core import ranges
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import (
    IMU_SAMPLE,
    INVALID,
    ODOMETRY,
    REPEATED,
    SENSOR_ROW,
    TDOA as TDOA_ROW,
    USED,
    Measurements,
    new_state,
)
from uwb_tdoa_ekf.core.sensors import STREAMS
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import SLICE, RadioCorrections, run_offline, without_offset
from uwb_tdoa_ekf.smoother import smooth

# --- ranges ---
CALIBRATED = FilterConfig(range_offset_std=0.0)  # no estimation of the range offset
STD = 0.1  # m


@pytest.fixture(scope="module")
def ranged():
    return only_ranges(STD)


def test_ranges_alone_start_the_filter_and_hold_it(ranged):
    run = run_offline(ranged)
    assert len(run.odometry) > 100 and error(ranged, run.odometry) < STD
    verdict = run.sensors["range"]["verdict"]
    assert np.mean(verdict == USED) > 0.9 and not np.any(verdict == INVALID)
    assert error(ranged, run_offline(ranged, FilterConfig(use_imu=False)).odometry) < 3.0 * STD


def test_without_them_there_is_no_odometry(ranged):
    assert len(run_offline(ranged, FilterConfig(use_range=False)).odometry) == 0


@pytest.mark.parametrize("offset_std", [0.0, 0.3])
def test_live_is_off_line(ranged, offset_std):
    config = FilterConfig(range_offset_std=offset_std)
    estimator = Estimator(ranged.anchors, config)
    odometry, _ = feed(estimator, ranged)
    expected = run_offline(ranged, config)
    assert_same(odometry, expected.odometry)
    assert estimator.counts["range_used"] == np.sum(expected.sensors["range"]["verdict"] == USED)


def test_without_an_imu_time_goes_on_by_ranges(ranged):
    estimator = Estimator(ranged.anchors, FilterConfig(use_imu=False))
    order = [message for message in messages(ranged) if message[1] not in (IMU, TDOA)]
    parts = []
    feed(estimator, ranged, order, lambda: parts.append(len(estimator.waiting)) or True)
    assert estimator.running and max(parts) < 100


def test_what_is_no_range_is_counted(ranged):
    n = len(ranged.range)
    wrong = replace(ranged.range, anchor=np.where(np.arange(n) % 10 == 0, 999, ranged.range.anchor))
    run = run_offline(replace(ranged, range=wrong))
    assert np.sum(run.sensors["range"]["verdict"] == INVALID) == len(range(0, n, 10))
    twice = Ranges(*(np.repeat(column, 2, axis=0) for column in ranged.range.columns))
    run = run_offline(replace(ranged, range=twice))
    assert np.sum(run.sensors["range"]["verdict"] == REPEATED) == n


def test_outliers_are_not_used(ranged):
    rng, n = np.random.default_rng(1), len(ranged.range)
    late = replace(
        ranged.range,
        d=ranged.range.d + np.where(rng.random(n) < 0.1, rng.uniform(2.0, 5.0, n), 0.0),
    )
    assert error(ranged, run_offline(replace(ranged, range=late)).odometry) < 1.5 * STD


def test_the_jacobian_is_that_of_the_distance():
    state, parameters = new_state(np.zeros((1, 3))), FilterConfig().parameters()[0]
    hypothesis, innovation = state.record.hypotheses[0], state.record.innovation
    sensor, anchor = np.zeros(1, SENSOR_ROW)[0], np.array([1.0, -2.0, 3.0])
    sensor["value"][0], x = 4.0, np.array([0.5, 0.7, -0.2])

    def compared(p):
        hypothesis["x"][:3] = p
        ranges.compare(hypothesis, anchor, sensor, parameters, innovation)
        return innovation["value"]

    compared(x)
    row = innovation["row"][:3].copy()
    assert innovation["value"] == pytest.approx(4.0 - np.linalg.norm(x - anchor)) and innovation[
        "noise_variance"
    ] == pytest.approx(0.01)
    slope = [(compared(x + step) - compared(x - step)) / 2e-6 for step in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(row, -np.array(slope), atol=1e-8)


@pytest.mark.parametrize("offset", [0.0, 0.25])
def test_an_offset_of_all_ranges_is_found(ranged, offset):
    longer = replace(ranged, range=replace(ranged.range, d=ranged.range.d + offset))
    known = run_offline(ranged, CALIBRATED).odometry
    found = run_offline(longer).odometry
    assert error(ranged, found) < 1.2 * error(ranged, known)
    assert errors_of(ranged, found)[1].mean() < 3.0  # 3 axes


def test_the_smoother_takes_the_offset_out_that_the_filter_finds(ranged):
    run, known = smooth(without_offset(ranged, -0.25)), smooth(ranged, CALIBRATED)
    offset, std = run.range_offset
    assert abs(offset - 0.25) < 3.0 * std < 0.1 and known.range_offset is None
    assert error(ranged, run.odometry) < 1.2 * error(ranged, known.odometry)


@pytest.mark.parametrize("engine", [run_offline, smooth])
def test_without_ranges_nobody_looks_for_an_offset(engine):
    flight = fly(seed=1, duration=5.0)
    one, other = (engine(flight, FilterConfig(range_offset_std=std)) for std in (0.0, 0.3))
    assert_same(one.odometry, other.odometry)
    assert other.range_offset is None


# --- radio corrections ---
DELAY, MOVED = (
    EFFECTS["anchor_delay"]({"1": 0.3}),
    EFFECTS["anchor_position"]({"2.x": 0.6, "2.z": -0.4}),
)
BOX = Anchors.from_positions([[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5]], ids=[1, 2, 3, 4])


def test_what_is_known_of_ranges_is_taken_out_live_as_off_line():
    flight, moved = only_ranges(), EFFECTS["anchor_position"]({"15.x": 0.6, "15.z": -0.4})
    effects = EFFECTS["anchor_delay"]({"16": 0.3}), moved
    wrong = flight
    for effect in effects:
        wrong = effect.inject(wrong)
    known = EffectSet(effects)
    run = run_offline(wrong, None, Corrector(wrong.anchors, known))
    clean, without = (
        rms_error(flight, run_offline(flight).odometry),
        rms_error(flight, run_offline(wrong).odometry),
    )
    assert without > 1.5 * clean and rms_error(flight, run.odometry) < 1.1 * clean
    odometry, _ = feed(Estimator(wrong.anchors, effects=known), wrong)
    assert_same(odometry, run.odometry)


def measured(t, anchor, value):
    """Return Measurements with ranges only."""
    rows = np.zeros(len(t), SENSOR_ROW)
    rows["t"], rows["kind"], rows["anchor"], rows["value"][:, 0] = (
        t,
        STREAMS.index("range"),
        anchor,
        value,
    )
    return Measurements(np.empty(0, IMU_SAMPLE), np.empty(0, TDOA_ROW), rows)


def odometry_at(t, p):
    """Return ODOMETRY (n,) of a tag at p (n, 3), in m, with an unknown attitude."""
    rows = np.zeros(len(t), ODOMETRY)
    rows["t"], rows["x"] = t, np.nan
    rows["x"][:, :3] = p
    return rows


def test_a_slice_is_corrected_at_the_last_pose_before_it():
    corrections = RadioCorrections(EffectSet((MOVED,)), AnchorTable(BOX))
    moved = BOX.positions[1] + [0.6, 0.0, -0.4]
    places = [np.array([1.0, 1.0, 1.0]), np.array([3.0, 2.0, 1.0])]
    t = np.array([0.01, 0.02, SLICE + 0.01, SLICE + 0.02, 2 * SLICE + 0.01])
    found = []
    for k, part in enumerate(corrections.slices(measured(t, np.ones(5, int), np.full(5, 4.0)))):
        found.append(part.sensors)
        corrections.add_odometry(odometry_at(part.sensors["t"][-1:], places[min(k, 1)]))
    assert [part["t"].tolist() for part in found] == [
        t[:2].tolist(),
        t[2:4].tolist(),
        t[4:].tolist(),
    ]
    # Before the first pose, nothing is corrected.
    np.testing.assert_array_equal(found[0]["value"][:, 0], 4.0)
    for part, place in zip(found[1:], places):
        bias = np.linalg.norm(place - moved) - np.linalg.norm(place - BOX.positions[1])
        np.testing.assert_allclose(part["value"][:, 0], 4.0 - bias, atol=1e-12)


def test_ranges_of_anchors_that_are_gone_stay_as_they_are_and_others_keep_their_rows():
    anchor_table = AnchorTable(BOX)
    corrections = RadioCorrections(
        EffectSet((EFFECTS["anchor_delay"]({"1": 0.3, "4": 0.1}),)), anchor_table
    )
    anchor_table.change(BOX.only(np.array([1, 2, 3])))
    (part,) = corrections.slices(
        measured(np.array([0.01, 0.02, 0.03]), np.array([0, 1, 3]), np.full(3, 4.0))
    )
    np.testing.assert_allclose(part.sensors["value"][:, 0], [4.0, 4.0, 3.9])


def test_what_does_not_act_on_ranges_leaves_everything_in_one_piece():
    others = EFFECTS["pair_offset"]({"1-2": 0.3}), EFFECTS["range_delay"]({"offset": 0.1})
    given = measured(np.array([0.01, 3.0]), np.array([0, 1]), np.full(2, 4.0))
    (part,) = RadioCorrections(EffectSet(others), AnchorTable(BOX)).slices(given)
    assert part is given


def test_what_is_fed_is_not_changed():
    given = measured(np.array([0.01]), np.array([0]), np.array([4.0]))
    (part,) = RadioCorrections(EffectSet((DELAY,)), AnchorTable(BOX)).slices(given)
    assert given.sensors["value"][0, 0] == 4.0 and part.sensors["value"][0, 0] == pytest.approx(3.7)


def test_what_comes_at_once_and_one_by_one_is_corrected_alike():
    """This includes rounding at the border between two slices."""
    t = 1.7e9 + np.arange(400) / 100.0
    whole, single = (RadioCorrections(EffectSet((MOVED,)), AnchorTable(BOX)) for _ in range(2))

    def corrected(corrections, parts):
        out = []
        for part in parts:
            for piece in corrections.slices(part):
                out += piece.sensors["value"][:, 0].tolist()
                last = piece.sensors["t"][-1:]
                corrections.add_odometry(odometry_at(last, last - t[0]))
        return out

    given = measured(t, np.ones(400, int), np.full(400, 4.0))
    one_by_one = [measured(t[k : k + 1], np.ones(1, int), np.full(1, 4.0)) for k in range(400)]
    found = corrected(whole, [given])
    assert len(found) == 400 and len(set(found)) == 80 and found == corrected(single, one_by_one)


def test_four_anchors_on_a_car_locate_a_person_far_away():
    """Ranges at 36/s, without IMU, to anchors that are 2 m apart: they place the tag outside.

    A prior that it is near the anchors must not keep it there, nor make the smoother certain.
    """
    flights = [walk_from_a_car(seed) for seed in range(4)]
    config, found = FilterConfig(use_imu=False), []
    for run in (run_offline, smooth):
        of_each = [errors_of(flight, run(flight, config).odometry, 5.0) for flight in flights]
        rmse = np.sqrt(np.mean([np.mean(np.sum(off[:, :2] ** 2, axis=1)) for off, _ in of_each]))
        found.append((rmse, np.mean([nees.mean() for _, nees in of_each])))
    (online, nees), (smoothed, nees_smoothed) = found
    assert smoothed < online < 0.5 and nees < 5.0 and nees_smoothed < 5.0


def walk_from_a_car(seed):
    """Return a Flight with ranges alone: a walk from 4 m to 30 m and back, 1.4 m/s at most."""
    rng = np.random.default_rng([seed, 739])
    places = np.array([(0.0, 0.9, 0.5), (2.2, 0.2, 1.8), (-0.3, -0.5, 2.0), (0.7, -0.9, 0.6)])
    t = np.arange(0.0, 60.0, 0.02)
    away, bearing = 4.0 + 26.0 * np.sin(np.pi * t / 60.0), 0.3 * np.sin(0.1 * t)
    bearing += rng.uniform(-np.pi, np.pi)
    p = np.column_stack([away * np.cos(bearing), away * np.sin(bearing), np.full(len(t), 1.0)])
    stamps = np.arange(0.1, 59.9, 1.0 / 36.0)
    to = np.arange(len(stamps)) % 4
    own = np.column_stack([np.interp(stamps, t, column) for column in p.T])
    d = np.linalg.norm(own - places[to], axis=1) + 0.05 * rng.standard_normal(len(to))
    return Flight(
        "walk",
        Anchors(np.arange(4), places, np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))),
        Tdoas(*np.empty((4, 0))),
        None,
        Truth(t, p, np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))),
        range=Ranges(stamps, to, d, np.zeros(len(to))),
    )
