"""Stamps of TDOAs against the geometry of the ground truth."""

from dataclasses import replace

from known_effects import clean_flight
from number_faults import FAULTS
import numpy as np
import pytest

from uwb_tdoa_bias.effects import true_samples
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_tools.checking.pair_rules import KnownPath
from uwb_tdoa_tools.checking.time_rules import tdoas


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 30.0)


def said(flight):
    return {finding.rule: finding.value for finding in tdoas(KnownPath(flight))}


def test_a_sound_flight(flight):
    assert said(flight) == {}


def with_stamps(flight, t):
    return replace(flight, tdoa=replace(flight.tdoa, t=t))


@pytest.mark.slow
def test_all_late_drifting_and_jumping(flight):
    t = flight.tdoa.t
    assert said(with_stamps(flight, t + 0.3)) == {"tdoa_late": pytest.approx(0.3)}
    assert list(said(with_stamps(flight, t + 0.6 * (t - t[0]) / np.ptp(t)))) == ["tdoa_drift"]
    assert said(with_stamps(flight, t + 0.4 * (t > t.mean())))["tdoa_jump"] == pytest.approx(0.4)


def test_out_of_order(flight):
    t = flight.tdoa.t
    order = np.lexsort((np.random.default_rng(0).random(len(t)), np.floor(t)))
    columns = {name: column[order] for name, column in vars(flight.tdoa).items()}
    assert list(said(replace(flight, tdoa=replace(flight.tdoa, **{**columns, "t": t})))) == [
        "tdoa_reordered"
    ]


def test_a_pair_that_is_late_is_named_where_noise_does_not_hide_it(flight):
    samples, rows = true_samples(flight)
    d = flight.tdoa.d.copy()
    d[rows] = tdoa(samples.p, samples.position_a, samples.position_b)
    d[rows] += 1e-3 * np.random.default_rng(0).standard_normal(len(rows))
    quiet = replace(flight, tdoa=replace(flight.tdoa, d=d))
    assert list(said(FAULTS["pair_late"].put_in(quiet, np.random.default_rng(1)))) == ["pair_late"]
