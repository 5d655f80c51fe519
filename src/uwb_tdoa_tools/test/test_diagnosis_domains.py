from dataclasses import replace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.samples import samples_at
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import TdoaResidual
from uwb_tdoa_tools.diagnosis.domains import REACH, Seen
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


def test_a_function_fades_to_nothing_away_from_the_places_where_it_was_observed(flight):
    """Three circles of one height gave functions that made flights at other heights worse."""
    near = SmoothTerm({"c0": 0.3, "c1": 0.3}, covariate="tilt", knots=(0.0, 2.0), shape="line")
    (known,) = Seen([residual(flight, 5.0, 30.0)]).limited([near])
    low, high = known.domain["height"]
    assert set(known.domain) == {"tilt", "x", "y", "height"} and low < high

    def at(height):
        t = np.full(1, flight.tdoa.t[0] + 10.0)
        a, b = (np.array([row]) for row in (0, 1))
        samples = samples_at(t, a, b, flight.truth, flight.anchors, t[0], lag=None)
        return replace(samples, p=np.full((1, 3), [[0.0, 0.0, height]]))

    inside, far = (
        (EffectSet((known,)), at(0.5 * (low + high))),
        (EffectSet((known,)), at(high + 5.0)),
    )
    full = near.bias(far[1])
    assert inside[0].bias(inside[1]) == pytest.approx(full, rel=0.05) and abs(full[0]) > 0.1
    assert abs(far[0].bias(far[1])[0]) < 0.01 * abs(full[0])
    assert far[0].noise_std(far[1])[0] > 0.99 * abs(full[0])


def test_take_off_and_landing_do_not_widen_a_domain(flight):
    part = residual(flight, 0.0, 40.0)
    heights = part["tdoa"].covariate("height")
    near = SmoothTerm({"c0": 0.1}, covariate="speed", knots=(0.0, 2.0))
    low, high = Seen([part]).limited([near])[0].domain["height"]
    assert 0.01 < np.mean((heights < low) | (heights > high)) < 0.05


def test_a_level_path_leaves_room_for_errors_of_the_estimate(flight):
    part = residual(flight, 10.0, 20.0)["tdoa"]
    place = part.samples.p.copy()
    place[:, 2] = 0.25
    level = replace(part, samples=replace(part.samples, p=place))
    near = SmoothTerm({"c0": 0.1}, covariate="speed", knots=(0.0, 2.0))
    (known,) = Seen([{"tdoa": level}]).limited([near])
    assert known.domain["height"] == pytest.approx((0.25 - REACH, 0.25 + REACH))
