from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.effects import true_samples
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_tools.checking.against_truth import against_truth
from uwb_tdoa_tools.checking.numbers import numbers
from uwb_tdoa_tools.studies.diagnosis.bank import clean_flight
from uwb_tdoa_tools.studies.diagnosis.faults import FAULTS


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 40.0)


def test_nothing_is_wrong_with_the_numbers_of_a_sound_flight(flight):
    assert numbers(flight) == []


@pytest.mark.parametrize("fault", [name for name in FAULTS if name != "pair_late"])
def test_a_fault_is_named_by_its_rule(flight, fault):
    found = numbers(FAULTS[fault](flight, np.random.default_rng(1)))
    assert fault in [finding.rule for finding in found]
    assert all(finding.cause and finding.evidence and finding.remedy for finding in found)


def test_a_pair_that_is_late_by_packets_is_named_where_noise_does_not_hide_it(flight):
    samples, rows = true_samples(flight)
    d = flight.tdoa.d.copy()
    d[rows] = tdoa(samples.p, samples.position_a, samples.position_b)
    quiet = replace(flight, tdoa=replace(flight.tdoa, d=d))
    names = [finding.rule for finding in against_truth(FAULTS["pair_late"](quiet, np.random.default_rng(1)))]
    assert names == ["pair_late"]


def test_without_ground_truth_nothing_is_compared_with_it(flight):
    assert against_truth(replace(flight, truth=None)) == []
