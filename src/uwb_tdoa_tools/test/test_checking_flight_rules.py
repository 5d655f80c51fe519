"""Findings about a flight: its streams alone, and against its ground truth."""

from dataclasses import replace

from known_effects import clean_flight
from number_faults import FAULTS
import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Truth
from uwb_tdoa_tools.checking.flight_rules import judge_against_truth, judge_flight, judge_truth


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 30.0)


def test_holes_and_jumps_of_the_truth_are_found(flight):
    of = flight.truth
    hidden = (of.t > 8.0) & (of.t < 10.5)
    (hole,) = judge_truth(replace(flight, truth=Truth(of.t[~hidden], of.p[~hidden], of.q[~hidden])))
    assert hole.rule == "truth_hole" and hole.value == pytest.approx(2.5, abs=0.1)
    (leap,) = judge_truth(replace(flight, truth=Truth(of.t, of.p + 0.5 * hidden[:, None], of.q)))
    assert leap.rule == "truth_leap" and "0.87 m" in leap.evidence
    assert list(judge_truth(flight)) == []


def test_missing_streams_are_not_judged(flight):
    assert judge_against_truth(replace(flight, truth=None)) == []
    bare = Truth(flight.truth.t, flight.truth.p, np.full_like(flight.truth.q, np.nan))
    assert (
        judge_against_truth(replace(flight, truth=bare))
        == judge_against_truth(replace(flight, imu=None))
        == []
    )


def test_ids_are_corrected_before_signs_are_judged(flight):
    of = flight.tdoa
    a, b = (np.where(ids == 2, 3, np.where(ids == 3, 2, ids)) for ids in (of.a, of.b))
    assert [
        finding.rule for finding in judge_against_truth(replace(flight, tdoa=replace(of, a=a, b=b)))
    ] == ["ids_exchanged"]


HARD = ("pair_late",)  # hidden by the noise in most draws
QUICK = ("tdoa_rounded", "ids_exchanged", "truth_leap")


def rules_of(flight, fault):
    found = judge_flight(FAULTS[fault].put_in(flight, np.random.default_rng(1)))
    assert all(finding.cause and finding.evidence and finding.remedy for finding in found)
    return [finding.rule for finding in found]


def test_a_healthy_flight_has_no_finding(flight):
    assert judge_flight(flight) == []


@pytest.mark.parametrize("fault", QUICK)
def test_a_fault_is_named_by_its_rule(flight, fault):
    assert set(rules_of(flight, fault)) & set(FAULTS[fault].rules)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [name for name in FAULTS if name not in (*QUICK, *HARD)])
def test_each_fault_is_named_by_its_rule(flight, fault):
    assert set(rules_of(flight, fault)) & set(FAULTS[fault].rules)


def test_a_fault_of_two_rules_is_reported_once(flight):
    assert rules_of(flight, "tdoa_rounded").count("tdoa_rounded") == 1
