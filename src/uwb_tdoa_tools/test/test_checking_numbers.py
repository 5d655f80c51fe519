"""What `numbers` says of a flight as a whole; single rules are in the tests of their modules."""

from known_effects import clean_flight
from number_faults import FAULTS
import numpy as np
import pytest

from uwb_tdoa_tools.checking.flight_rules import judge_flight

HARD = ("pair_late",)  # hidden by the noise in most draws
QUICK = ("tdoa_rounded", "ids_exchanged", "truth_leap")


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 30.0)


def of(flight, fault):
    found = judge_flight(FAULTS[fault].put_in(flight, np.random.default_rng(1)))
    assert all(finding.cause and finding.evidence and finding.remedy for finding in found)
    return [finding.rule for finding in found]


def test_nothing_is_wrong_with_the_numbers_of_a_sound_flight(flight):
    assert judge_flight(flight) == []


@pytest.mark.parametrize("fault", QUICK)
def test_a_fault_is_named_by_its_rule(flight, fault):
    assert set(of(flight, fault)) & set(FAULTS[fault].rules)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [name for name in FAULTS if name not in (*QUICK, *HARD)])
def test_each_fault_is_named_by_its_rule(flight, fault):
    assert set(of(flight, fault)) & set(FAULTS[fault].rules)


def test_what_two_rules_name_is_told_once(flight):
    assert of(flight, "tdoa_rounded").count("tdoa_rounded") == 1
