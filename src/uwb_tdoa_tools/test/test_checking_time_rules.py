"""Delays of series, and stamps of TDOAs against the ground truth."""

from dataclasses import replace

from known_effects import clean_flight
from number_faults import FAULTS
import numpy as np
import pytest

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import true_samples
from uwb_tdoa_tools.checking.pair_rules import KnownPath
from uwb_tdoa_tools.checking.time_rules import delays, wrong_stamps

T = np.arange(0.0, 60.0, 0.02)
SERIES = np.arange(len(T)) % 3


def course(t):
    return np.sin(1.3 * t) + 0.5 * np.sin(0.7 * t + SERIES)


def delays_of(late, noise=0.1):
    """Delays of three series with noise and constant errors of their own, each sample `late` (n,)
    s.
    """
    measured = course(T - late) + SERIES + noise * np.random.default_rng(0).standard_normal(len(T))
    return delays(SERIES, T, lambda delay: measured - course(T - delay))


def test_no_delay_is_found_without_one():
    of = delays_of(np.zeros(len(T)))
    assert of.constant() == (1.0, pytest.approx(0.0))
    assert min(of.drift()[0], of.jump()[0]) > 0.99


@pytest.mark.parametrize("late", [-0.4, 0.25])
def test_a_common_delay_is_found(late):
    ratio, delay = delays_of(np.full(len(T), late)).constant()
    assert ratio < 0.9 and delay == pytest.approx(late)


def test_a_late_series_is_found():
    of = delays_of(0.3 * (SERIES == 1))
    assert [of.of_series(k)[1] for k in range(3)] == pytest.approx([0.0, 0.3, 0.0])
    assert of.of_series(1)[0] < 0.6 and of.of_series(0)[0] == 1.0


def test_a_clock_that_drifts_and_one_that_jumps():
    drifting, jumping = delays_of(T / 60.0), delays_of(0.6 * (T > 30.0))
    (ratio, by), (other, _, _) = drifting.drift(), drifting.jump()
    assert ratio < 0.9 and ratio < other and by == pytest.approx(0.95, abs=0.1)
    (other, _), (ratio, step, block) = jumping.drift(), jumping.jump()
    assert ratio < 0.9 and ratio < other and step == pytest.approx(0.6) and block == 6


def test_gross_errors_do_not_count():
    rng, late = np.random.default_rng(1), np.full(len(T), 0.25)
    measured = course(T - late) + np.where(
        rng.random(len(T)) < 0.1, rng.uniform(-50.0, 50.0, len(T)), 0.0
    )
    assert delays(SERIES, T, lambda delay: measured - course(T - delay)).constant()[
        1
    ] == pytest.approx(0.25)


def test_series_with_few_samples_are_not_judged():
    """As of most pairs of a hall: of a few samples some delay explains nearly all."""
    few, together = np.arange(3, 60), np.array([0, 1, 2, 3, 4, 5])
    t = np.concatenate([T, 7.0 * few, T[:300:50][together]])
    series = np.concatenate([SERIES, np.full(len(few), 3), np.full(len(together), 4)])
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(t))
    of = delays(series, t, lambda delay: np.sin(1.3 * t) + noise - np.sin(1.3 * (t - delay)))
    assert [of.of_series(k) for k in (3, 4)] == [(1.0, 0.0)] * 2 and of.of_series(0)[0] == 1.0


def test_few_samples_have_no_delay():
    few = np.arange(0.0, 600.0, 7.0)  # never five in a block
    of = delays(
        np.zeros(len(few), int), few, lambda delay: np.sin(1.3 * few) - np.sin(1.3 * (few - delay))
    )
    assert of.constant() == (1.0, 0.0) and of.exact() == 0.0
    assert of.drift() == (1.0, 0.0) and of.jump()[:2] == (1.0, 0.0)


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 30.0)


def rules_found(flight):
    return {finding.rule: finding.value for finding in wrong_stamps(KnownPath(flight))}


def test_a_healthy_flight_has_no_finding(flight):
    assert rules_found(flight) == {}


def with_stamps(flight, t):
    return replace(flight, tdoa=replace(flight.tdoa, t=t))


@pytest.mark.slow
def test_late_drifting_and_jumping_stamps_are_found(flight):
    t = flight.tdoa.t
    assert rules_found(with_stamps(flight, t + 0.3)) == {"tdoa_late": pytest.approx(0.3)}
    assert list(rules_found(with_stamps(flight, t + 0.6 * (t - t[0]) / np.ptp(t)))) == [
        "tdoa_drift"
    ]
    assert rules_found(with_stamps(flight, t + 0.4 * (t > t.mean())))["tdoa_jump"] == pytest.approx(
        0.4
    )


def test_tdoas_out_of_order_are_found(flight):
    t = flight.tdoa.t
    order = np.lexsort((np.random.default_rng(0).random(len(t)), np.floor(t)))
    columns = {name: column[order] for name, column in vars(flight.tdoa).items()}
    assert list(rules_found(replace(flight, tdoa=replace(flight.tdoa, **{**columns, "t": t})))) == [
        "tdoa_reordered"
    ]


def test_a_late_pair_is_named(flight):
    samples, rows = true_samples(flight)
    d = flight.tdoa.d.copy()
    d[rows] = tdoa(samples.p, samples.position_a, samples.position_b)
    d[rows] += 1e-3 * np.random.default_rng(0).standard_normal(len(rows))
    quiet = replace(flight, tdoa=replace(flight.tdoa, d=d))
    assert list(rules_found(FAULTS["pair_late"].put_in(quiet, np.random.default_rng(1)))) == [
        "pair_late"
    ]
