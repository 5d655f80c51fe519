# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, SmoothTerm
from uwb_tdoa_bias.effects.samples import samples_at
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import TdoaResidual
from uwb_tdoa_tools.diagnosis.channels.base import Seen
from uwb_tdoa_tools.diagnosis.references import GroundTruth


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 40.0)


def test_a_drift_that_is_found_knows_for_how_long_it_was_seen(flight):
    drift = EFFECTS["anchor_clock_drift"]({"1": 0.02})
    (found,) = attribute(
        [drift.inject(flight)], GroundTruth(), undeclared=False, kinds=["anchor_clock_drift"]
    ).effects
    low, high = found.domain["time"]
    assert 0.0 <= low < 5.0 and 30.0 < high < 40.0


def residual(flight, low, high):
    """A residual, looked at between two times after the first TDOA."""
    t = flight.tdoa.t
    a, b = (flight.anchors.index(side) for side in (flight.tdoa.a, flight.tdoa.b))
    samples = samples_at(t, a, b, flight.truth, flight.anchors, t[0], lag=None)
    fitted = (t >= t[0] + low) & (t <= t[0] + high)
    return {"tdoa": TdoaResidual(samples, np.zeros(len(t)), fitted, fitted)}


def test_a_domain_is_of_the_flights_that_were_fitted_and_of_the_air(flight):
    seen = Seen([residual(flight, 5.0, 10.0), residual(flight, 8.0, 30.0)])
    time = SmoothTerm({"c0": 0.1}, covariate="time", knots=(0.0, 20.0))
    span = [seen.limited([time], numbers)[0].domain["time"] for numbers in (None, [0], [1])]
    assert np.round(span).tolist() == [[5.0, 30.0], [5.0, 10.0], [8.0, 30.0]]
    near = SmoothTerm({"c0": 0.1}, covariate="range", form="arrival", knots=(0.0, 20.0))
    low, high = seen.limited([near])[0].domain["range"]
    assert 0.0 < low < high < 15.0
    delay = EFFECTS["anchor_delay"]({"1": 0.1})
    known = EFFECTS["anchor_clock_drift"]({"1": 0.01}, domain={"time": (0.0, 5.0)})
    assert seen.limited([delay, known]) == [delay, known]
