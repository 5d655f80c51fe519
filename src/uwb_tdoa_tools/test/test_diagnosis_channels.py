# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.covariates import ImuFeatures
from uwb_tdoa_bias.effects.samples import samples_at
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import CHANNELS, TdoaResidual, base, residuals
from uwb_tdoa_tools.diagnosis.channels.base import Seen
from uwb_tdoa_tools.diagnosis.references import GroundTruth, Nothing


@pytest.fixture(scope="module")
def parts():
    return residuals(clean_flight(100, 40.0, aided=True, ranged=True), GroundTruth(), EffectSet())


def test_residuals_of_a_clean_flight_are_its_noise(parts):
    assert np.std(parts["gyro"].residual) < 0.002 and np.std(parts["accel"].residual) < 0.01
    for name, noise in (
        ("height", 0.01),
        ("pressure", 0.1),
        ("velocity", 0.05),
    ):  # medians of the 6 or 7 in a cell
        assert np.std(parts[name].residual) == pytest.approx(1.2 * noise / np.sqrt(6.25), rel=0.15)
    ranges = parts["range"]
    assert np.std(ranges.residual[ranges.airborne]) == pytest.approx(0.1, rel=0.05)
    tdoa = parts["tdoa"]
    assert 1.4826 * np.median(np.abs(tdoa.residual[tdoa.airborne])) == pytest.approx(0.06, rel=0.05)


def test_features_of_inertial_samples_are_computed_once_for_all_channels(monkeypatch):
    made = []

    class Counted(ImuFeatures):
        def __init__(self):
            made.append(self)
            super().__init__()

    monkeypatch.setattr(base, "ImuFeatures", Counted)
    assert {"tdoa", "gyro", "accel"} <= set(
        residuals(clean_flight(100, 20.0), GroundTruth(), EffectSet())
    )
    assert len(made) == 1


@pytest.mark.parametrize("name", CHANNELS)
def test_rows_and_columns_fit_together(parts, name):
    rows = parts[name].rows()
    assert len(rows.y) == len(rows.series) == len(rows.t) == len(rows.count) == len(rows.place)
    for effect in EFFECTS.values():
        if effect.fitted and name in effect.channels:
            keys = effect().groups(parts["tdoa"].samples.anchors, np.array([[0, 1], [1, 2]]))[0]
            assert parts[name].columns(effect(), keys).shape == (len(rows.y), len(keys))


@pytest.mark.parametrize("name", CHANNELS)
def test_every_function_that_is_looked_for_has_columns(parts, name):
    anchors = parts["tdoa"].samples.anchors
    terms = CHANNELS[name].smooth_terms([parts[name]])
    assert terms
    for term in terms:
        keys = term.keys(anchors)
        assert np.isfinite(parts[name].columns(term, keys)).all()


@pytest.mark.parametrize(
    "channel, covariate",
    [("height", "vibration"), ("velocity.x", "vibration"), ("gyro.x", "extra.battery.voltage")],
)
def test_a_function_of_what_a_flight_does_not_hold_adds_nothing(channel, covariate):
    flight, name = clean_flight(100, 40.0, aided=True), channel.partition(".")[0]
    flight = flight if name == "gyro" else replace(flight, imu=None)
    term = SmoothTerm(
        {"c0": 0.3, "c1": 0.3, "c2": 0.3}, channel=channel, covariate=covariate, knots=(0.0, 1.0)
    )
    plain, part = (
        residuals(flight, GroundTruth(), EffectSet(effects))[name] for effects in ((), (term,))
    )
    np.testing.assert_array_equal(part.residual, plain.residual)
    assert part.covariate(covariate) is None and not part.columns(term, term.keys()).any()


def test_without_reference_the_residual_is_the_innovation_and_a_shift_of_all_leaves_little_trace():
    flight, reference = clean_flight(103, 30.0), Nothing()
    part = residuals(reference.prepare(flight), reference, EffectSet())["tdoa"]
    np.testing.assert_array_equal(part.residual, part.innovations.value)
    shift, delay = (
        part.columns(EFFECTS[name](), keys)
        for name, keys in (("truth_frame", "xyz"), ("anchor_delay", "3"))
    )
    assert np.sqrt(np.mean(shift**2)) < 0.1 < np.sqrt(np.mean(delay**2))


def test_at_rest_the_gyroscope_is_no_function_of_what_it_measures_itself():
    part = residuals(Nothing().prepare(clean_flight(103, 30.0)), Nothing(), EffectSet())["gyro"]
    names = {term.covariate for term in CHANNELS["gyro"].smooth_terms([part])}
    assert not {name for name in names if name == "turning_rate" or name.startswith("rate_")}
    assert not part.samples.reading.any() and part.residual.any()


def test_without_attitude_the_gyroscope_is_judged_at_rest_and_the_accelerometer_not_at_all():
    # slow rotation, soon after take-off
    reference, flight = (Nothing(), clean_flight(110, 30.0))
    parts = residuals(reference.prepare(flight), reference, EffectSet())
    assert (
        "accel" not in parts
        and len(parts["gyro"].residual) > 15
        and np.abs(parts["gyro"].residual).max() < 0.003
    )


def test_without_reference_height_pressure_and_velocity_are_not_judged():
    reference, flight = Nothing(), clean_flight(103, 30.0, aided=True)
    assert not {"height", "pressure", "velocity"} & set(
        residuals(reference.prepare(flight), reference, EffectSet())
    )


def test_a_component_of_the_velocity_that_is_not_measured_has_no_rows():
    flight = clean_flight(100, 30.0, aided=True)
    flight.velocity.std[:, 2], flight.velocity.v[:, 2] = np.inf, np.nan
    part = residuals(flight, GroundTruth(), EffectSet())["velocity"]
    rows = part.rows()
    assert set(rows.series) == {0, 1} and np.isfinite(rows.y).all()
    assert len(part.columns(EFFECTS["velocity_scale"](), ("scale",))) == len(rows.y)
    series = part.series()
    assert len(series) == 2 and all(np.isfinite(values).all() for _, values in series.values())


def test_a_drift_that_is_found_knows_for_how_long_it_was_seen():
    drift = EFFECTS["anchor_clock_drift"]({"1": 0.02})
    (found,) = attribute(
        [drift.inject(clean_flight(100, 40.0))],
        GroundTruth(),
        undeclared=False,
        kinds=["anchor_clock_drift"],
    ).effects
    low, high = found.domain["time"]
    assert 0.0 <= low < 5.0 and 30.0 < high < 40.0


def residual(flight, low, high):
    """Return a residual. The fit uses the time from `low` to `high`, s after the first TDOA."""
    t = flight.tdoa.t
    a, b = (flight.anchors.index(side) for side in (flight.tdoa.a, flight.tdoa.b))
    samples = samples_at(t, a, b, flight.truth, flight.anchors, t[0], lag=None)
    fitted = (t >= t[0] + low) & (t <= t[0] + high)
    return {"tdoa": TdoaResidual(samples, np.zeros(len(t)), fitted, fitted)}


def test_a_domain_is_of_the_flights_that_were_fitted_and_of_the_air():
    flight = clean_flight(100, 40.0)
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


def test_functions_of_the_place_know_the_heights_that_were_seen():
    """A flight at one height determines a function only within a few centimetres of this height."""
    flight = clean_flight(100, 40.0)
    seen = Seen([residual(flight, 5.0, 30.0)])
    height = SmoothTerm({"c0": 0.1}, covariate="height", knots=(0.0, 2.0))
    heights = seen.limited([height])[0].domain["height"]

    over_x = SmoothTerm({"c0": 0.1}, covariate="x", knots=(-2.0, 2.0))
    low, high = seen.limited([over_x])[0].domain["height"]
    assert high - low == pytest.approx(max(heights[1] - heights[0], 1.0))

    truth = replace(flight.truth, p=flight.truth.p * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.2])
    level = Seen([residual(replace(flight, truth=truth), 5.0, 30.0)])
    assert level.limited([over_x])[0].domain["height"] == pytest.approx((0.7, 1.7))
    assert level.limited([height])[0].domain["height"] == pytest.approx((1.2, 1.2))

    turned = SmoothTerm({"c0": 0.1}, covariate="bearing_in_tag", form="arrival", knots=(-3.0, 3.0))
    assert list(seen.limited([turned])[0].domain) == ["bearing_in_tag"]
