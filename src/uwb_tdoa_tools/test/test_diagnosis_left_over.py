# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace
from types import SimpleNamespace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.report.reasons import left_over


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 30.0)


def remaining(*flights):
    reference = GroundTruth()
    left = [residuals(reference.prepare(flight), reference, EffectSet()) for flight in flights]
    return SimpleNamespace(flights=flights, remaining=left)


def test_nothing_stands_out_of_noise(flight):
    assert left_over(remaining(flight)) == ()


def test_the_pair_the_time_and_the_place_are_named(flight):
    of, t = flight.tdoa, flight.tdoa.t - flight.tdoa.t[0]
    a, b = int(of.a[0]), int(of.b[0])
    late = (of.a == a) & (of.b == b) & (t > 15.0) & (t < 20.0)
    odd = replace(flight, tdoa=replace(of, d=of.d + 1.3 * late))
    (sentence,) = left_over(remaining(odd))
    assert f"{a}-{b} from 15 to 20 s, around (" in sentence and "130 cm" in sentence
    (sentence,) = left_over(remaining(flight, replace(odd, name="other")))
    assert "from 15 to 20 s of other, around" in sentence


def test_flights_without_tdoas_to_judge_are_passed_over(flight):
    assert left_over(SimpleNamespace(flights=(flight,), remaining=[{}])) == ()
    assert np.isfinite(flight.tdoa.d).all()
