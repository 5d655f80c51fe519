"""Distances to anchors: their update, the start from them, and that live and off line are the same."""

from dataclasses import replace

from flights import fly
from live import IMU, TDOA, assert_same, feed, messages
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_bias.foundation.sensors import Ranges
from uwb_tdoa_ekf.core import ranges
from uwb_tdoa_ekf.core.auxiliary import RANGE
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import AID, new_state
from uwb_tdoa_ekf.core.verdicts import INVALID, REPEATED, USED
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline, without_offset
from uwb_tdoa_ekf.smoother import smooth

NO_TDOAS = Tdoas(*(np.empty(0, kind) for kind in (float, int, int, float)))
CALIBRATED = FilterConfig(range_offset_std=0.0)  # no offset is looked for
RATE, STD = 100.0, 0.1  # Hz, m


@pytest.fixture(scope="module")
def ranged():
    """A Flight of ranges alone, each anchor in its turn."""
    flight = fly(seed=1)
    truth, rng = flight.truth, np.random.default_rng(3)
    t = np.arange(truth.t[0], truth.t[-1], 1.0 / RATE)
    p = np.stack([np.interp(t, truth.t, column) for column in truth.p.T], axis=1)
    row = np.arange(len(t)) % len(flight.anchors)
    d = np.linalg.norm(p - flight.anchors.positions[row], axis=1) + STD * rng.standard_normal(
        len(t)
    )
    return replace(
        flight, tdoa=NO_TDOAS, range=Ranges(t, flight.anchors.ids[row], d, np.zeros(len(t)))
    )


def error(flight, odometry):
    truth = np.stack(
        [np.interp(odometry.t, flight.truth.t, column) for column in flight.truth.p.T], axis=1
    )
    late = odometry.t > odometry.t[0] + 2.0
    return float(np.sqrt(np.mean(np.sum((odometry.p - truth)[late] ** 2, axis=1))))


def test_ranges_alone_start_the_filter_and_hold_it(ranged):
    run = run_offline(ranged)
    assert len(run.odometry) > 100 and error(ranged, run.odometry) < STD
    verdict = run.aids["range"]["verdict"]
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
    assert estimator.counts["range_used"] == np.sum(expected.aids["range"]["verdict"] == USED)


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
    assert np.sum(run.aids["range"]["verdict"] == INVALID) == len(range(0, n, 10))
    twice = Ranges(*(np.repeat(column, 2, axis=0) for column in ranged.range.columns))
    run = run_offline(replace(ranged, range=twice))
    assert np.sum(run.aids["range"]["verdict"] == REPEATED) == n


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
    aid, anchor = np.zeros(1, AID)[0], np.array([1.0, -2.0, 3.0])
    aid["value"][0], x = 4.0, np.array([0.5, 0.7, -0.2])

    def compared(p):
        hypothesis["x"][:3] = p
        ranges.compare(hypothesis, anchor, aid, parameters, innovation)
        return innovation["value"]

    compared(x)
    row = innovation["row"][:3].copy()
    assert innovation["value"] == pytest.approx(4.0 - np.linalg.norm(x - anchor)) and innovation[
        "noise_variance"
    ] == pytest.approx(0.01)
    slope = [(compared(x + step) - compared(x - step)) / 2e-6 for step in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(row, -np.array(slope), atol=1e-8)


def test_two_ranges_make_a_tdoa():
    state = new_state(np.zeros((3, 3)))
    one, two = np.zeros(2, AID)
    one["t"], one["anchor"], one["value"][0], one["std"][0] = 1.0, 2, 3.0, 0.3
    two["t"], two["anchor"], two["value"][0], two["std"][0] = 1.05, 1, 4.5, 0.4
    assert not ranges.pair(state.ekf[0], one) and ranges.pair(state.ekf[0], two)
    made = state.ekf[0]["paired"][0]
    assert (made["t"], made["a"], made["b"], made["d"]) == (1.05, 2, 1, 1.5) and made[
        "variance"
    ] == pytest.approx(0.25)
    one["t"] = 2.0  # a second later
    assert not ranges.pair(state.ekf[0], one)


@pytest.mark.parametrize("offset", [0.0, 0.25])
def test_an_offset_of_all_ranges_is_found(ranged, offset):
    longer = replace(ranged, range=replace(ranged.range, d=ranged.range.d + offset))
    known = run_offline(ranged, CALIBRATED).odometry
    found = run_offline(longer).odometry
    assert error(ranged, found) < 1.2 * error(ranged, known)
    truth = np.stack(
        [np.interp(found.t, ranged.truth.t, column) for column in ranged.truth.p.T], axis=1
    )
    away = found.p - truth
    assert (
        np.mean(np.einsum("ni,nij,nj->n", away, np.linalg.inv(found.covariance[:, :3, :3]), away))
        < 3.0
    )  # as many as there are axes


def test_who_knows_of_no_offset_is_wrong_and_certain(ranged):
    """What the offset is for."""
    longer = replace(ranged, range=replace(ranged.range, d=ranged.range.d + 0.25))
    found = run_offline(longer)
    assert error(ranged, run_offline(longer, CALIBRATED).odometry) > 2.0 * error(
        ranged, found.odometry
    )


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


def test_an_offset_is_kept_where_it_was_known_best():
    state = new_state(np.zeros((1, 3)))
    ekf, hypothesis = state.ekf[0], state.ekf[0]["hypotheses"][0]
    for offset, variance in ((0.0, 0.0), (0.3, 0.04), (0.2, 0.01), (0.5, 0.09)):
        hypothesis["offset"][RANGE], hypothesis["offset_P"][RANGE, RANGE] = offset, variance
        ranges.keep_offset(state.ekf[0], hypothesis)
    assert ekf["range_offset"].tolist() == [0.2, 0.01]
