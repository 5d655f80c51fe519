"""Holes and leaps of the ground truth, and flights without one."""

from dataclasses import replace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_tools.checking.flight_rules import judge_against_truth, judge_truth


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 20.0)


def test_holes_and_leaps_in_the_air(flight):
    of = flight.truth
    hidden = (of.t > 8.0) & (of.t < 10.5)
    (hole,) = judge_truth(replace(flight, truth=Truth(of.t[~hidden], of.p[~hidden], of.q[~hidden])))
    assert hole.rule == "truth_hole" and hole.value == pytest.approx(2.5, abs=0.1)
    (leap,) = judge_truth(replace(flight, truth=Truth(of.t, of.p + 0.5 * hidden[:, None], of.q)))
    assert leap.rule == "truth_leap" and "0.87 m" in leap.evidence
    assert list(judge_truth(flight)) == []


def test_what_is_not_there_is_not_compared(flight):
    assert judge_against_truth(replace(flight, truth=None)) == []
    bare = Truth(flight.truth.t, flight.truth.p, np.full_like(flight.truth.q, np.nan))
    assert (
        judge_against_truth(replace(flight, truth=bare))
        == judge_against_truth(replace(flight, imu=None))
        == []
    )


def test_ids_are_put_right_before_signs_are_judged(flight):
    of = flight.tdoa
    a, b = (np.where(ids == 2, 3, np.where(ids == 3, 2, ids)) for ids in (of.a, of.b))
    assert [
        finding.rule for finding in judge_against_truth(replace(flight, tdoa=replace(of, a=a, b=b)))
    ] == ["ids_exchanged"]
