# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from known_effects import AIDED, SIZES, effect_of, names_found, sparse_flight
import numpy as np
import pytest
import undeclared

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, LabelEffect, SmoothTerm
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.diagnosis import attribution, refinement
from uwb_tdoa_tools.diagnosis.attribution import EffectSearch, attribute, residuals_of
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.findings import Refused
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import _simpler, effects_of, relinearised
from uwb_tdoa_tools.diagnosis.regression.fit import fit
from uwb_tdoa_tools.diagnosis.regression.select import select
from uwb_tdoa_tools.diagnosis.regression.table import table_of
from uwb_tdoa_tools.diagnosis.regression.terms import candidates_of

TRUTH = GroundTruth()
TOGETHER = (  # effects of AIDED in one flight
    ("height_offset", "barometer_drift", "velocity_scale"),
    ("height_scale", "velocity_misalignment"),
    ("floor_step", "velocity_delay"),
    ("velocity_slip", "barometer_drift"),
    ("yaw_rate_scale", "height_offset"),
)


@pytest.fixture(scope="module")
def flight():
    return sparse_flight(100, 40.0)


def quick(flight):
    """Return the Attribution of declared effects only, without unnamed functions."""
    return attribute([flight], TRUTH, undeclared=False)


def test_nothing_is_found_where_nothing_is(flight):
    assert quick(flight).effects == ()


def assert_found(flight, names, large=False):
    """Put effects into a flight. All of them must be found with their sizes, and no other."""
    put_in = {name: effect_of(name, large, 1) for name in names}
    for effect in put_in.values():
        flight = effect.inject(flight)
    found = {effect.name: effect for effect in quick(flight).effects}
    assert found.keys() == put_in.keys()
    for name, effect in put_in.items():
        times = {key for key in effect.values if key.endswith(("start", "end"))}
        assert found[name].values.keys() == effect.values.keys() == found[name].std.keys() | times
        for key, value in effect.values.items():
            allowed = 1.0 if key in times else 0.0
            assert found[name].values[key] == pytest.approx(value, rel=0.1, abs=allowed)


@pytest.mark.parametrize(
    "names",
    [
        ("anchor_delay", "gyro_scale", "truth_time_offset"),
        pytest.param(("pair_offset", "imu_misalignment"), marks=pytest.mark.slow),
        pytest.param(("tag_lever_arm", "gyro_scale"), marks=pytest.mark.slow),
        pytest.param(("tdoa_time_offset",), marks=pytest.mark.slow),
    ],
)
def test_declared_effects_are_found_with_their_sizes(flight, names):
    assert_found(flight, names)


def test_an_anchor_that_is_far_off_is_fitted_where_it_is(flight):
    """A fit about the surveyed position misses the change of direction.

    The fit must be repeated about the fitted position.
    """
    far = EFFECTS["anchor_position"]({"3.z": -1.3})

    def at(model):
        return [residuals(TRUTH.prepare(far.inject(flight)), TRUTH, EffectSet(model))]

    candidates = candidates_of(far, flight.anchors, [])
    table = table_of(at(())).with_terms(
        [term for candidate in candidates for term in candidate.terms]
    )
    selection = select(table, candidates, np.ones(3 * len(table.channels)))
    before = np.std(table_of(at(effects_of(selection))).y - selection.fit.residual)
    after = relinearised(selection, at, candidates)
    assert before > 0.02
    assert np.std(table_of(at(effects_of(after))).y - after.fit.residual) < 0.002
    (effect,) = effects_of(after)
    assert effect.values["3.z"] == pytest.approx(-1.3, abs=0.05)


def test_every_declared_effect_is_in_the_bank():
    of_numbers = {
        name for name, effect in EFFECTS.items() if issubclass(effect, LabelEffect)
    }  # see test_checking_flight.py
    assert set(SIZES) == set(EFFECTS) - of_numbers


def test_an_interval_of_nlos_is_found_with_its_anchor_and_time(flight):
    effect = effect_of("nlos", True, 2)
    (finding,) = quick(effect.inject(flight)).findings()
    for key, value in effect.values.items():
        assert finding.effect.values[key] == pytest.approx(
            value, abs=0.02 if key.endswith("delay") else 1.0
        )


@pytest.mark.parametrize("name", ["noise_level", "outlier_rate"])
def test_noise_is_told_from_bias(flight, name):
    rng = np.random.default_rng(0)
    assert names_found(quick(effect_of(name, True, 3).inject(flight, rng))) == [name]


@pytest.mark.slow
def test_a_search_goes_on_without_an_effect_and_keeps_the_others(flight):
    both = effect_of("anchor_delay", True, 3).inject(
        effect_of("accel_bias", True, 1).inject(flight)
    )
    search = EffectSearch([both], TRUTH, undeclared=False)
    found = search.found()
    assert set(names_found(found)) == {"accel_bias", "anchor_delay"}
    fewer = search.without({"anchor_delay"})
    refused = (Refused("nlos of 7", "before"), Refused("accel_bias", "before"))
    other = fewer.found(replace(found, refused=refused))
    assert refused[0] in other.refused
    accel_bias = next(one for one in other.selection.chosen if one.name == "accel_bias")
    assert accel_bias.label not in {one.what for one in other.refused}
    assert "accel_bias" in names_found(other) and "anchor_delay" not in names_found(other)
    assert "anchor_delay" not in {one.name for one in other.candidates}
    assert names_found(search.found(found)) == names_found(found)
    assert "anchor_position" not in names_found(fewer.without({"anchor_position"}).found())


@pytest.mark.slow
def test_an_undeclared_effect_is_found_by_its_covariate(flight):
    dragged = undeclared.drag_on_cable(flight)
    attribution = attribute([dragged], TRUTH)
    assert names_found(attribution) == ["tdoa/speed"]
    term = attribution.effects[0]
    assert isinstance(term, SmoothTerm) and term.usable
    left = residuals(dragged, TRUTH, EffectSet(attribution.effects))["tdoa"]
    assert 1.4826 * np.median(np.abs(left.residual[left.airborne])) == pytest.approx(0.06, rel=0.1)


@pytest.fixture(scope="module")
def of_slow_wave(flight):
    """Return the Attribution of undeclared.slow_wave, and its variance inflation of TDOAs.

    The inflation is that before and after an undeclared effect is separated from noise.
    """
    inflation, original = [], attribution.with_measured_noise

    def noted(selection, *rest):
        after = original(selection, *rest)
        inflation.append((selection.fit.inflation[0], after.fit.inflation[0]))
        return after

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attribution, "with_measured_noise", noted)
        found = attribute([undeclared.slow_wave(flight)], TRUTH)
    return found, inflation[0]


@pytest.mark.slow
def test_a_wave_over_time_is_named_first(of_slow_wave):
    first, *_ = of_slow_wave[0].findings()
    assert first.effect.label.startswith("tdoa of anchor 3 over time")


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect, named",
    [
        ("fast_and_high", "tdoa of anchor 3 over "),
        ("late_by_speed", "tdoa of anchor 5 over speed"),
        ("leaning_accel", "accel.z over height"),
    ],
)
def test_what_was_missed_once_is_named_first(flight, effect, named):
    """No function has two covariates.

    If an anchor is late when fast and high, the anchor is named.
    """
    first, *_ = attribute([getattr(undeclared, effect)(flight)], TRUTH).findings()
    assert first.effect.label.startswith(named)


@pytest.mark.slow
def test_a_function_does_not_hide_itself_as_noise(flight, of_slow_wave):
    """An undeclared effect is correlated in time, like noise."""
    (before, after), alone = of_slow_wave[1], inflation_alone(flight)
    assert before > 2.0 * alone and after < 1.1 * alone


def inflation_alone(flight):
    """Return the variance inflation of the TDOAs of a Flight, fitted with all declared effects."""
    under_base = residuals_of([flight], TRUTH, EffectSet())
    declared = attribution._declared(under_base, TRUTH, None, attribution._installation([flight]))
    table = refinement.linearised(under_base, declared, ())
    return refinement.inflation_of(table, declared, lambda *_: [])[0]


@pytest.mark.slow
def test_measured_flight(shared_data):
    from uwb_tdoa_tools.readers import read_flight

    survey = shared_data / "surveys" / "anchor_const1.csv"
    whole = (
        read_flight(shared_data / "util" / f"const1-trial{k}-tdoa2.csv.gz", survey) for k in (1, 2)
    )
    one, two = (between(each, each.tdoa.t[0], each.tdoa.t[0] + 40.0) for each in whole)
    effects = EffectSet(attribute([one], TRUTH).effects)
    before, after = (
        residuals(two, TRUTH, model)["tdoa"] for model in (EffectSet(), effects)
    )  # of a hold-out flight
    assert np.median(np.abs(after.residual[after.airborne])) < 0.7 * np.median(
        np.abs(before.residual[before.airborne])
    )


@pytest.fixture(scope="module")
def aided():
    return sparse_flight(101, 40.0, aided=True)


@pytest.mark.slow
@pytest.mark.parametrize("names", TOGETHER)
def test_what_is_wrong_with_height_pressure_and_velocity_is_found_with_its_size(aided, names):
    assert set().union(*TOGETHER) == set(AIDED)
    assert_found(aided, names, large=True)


@pytest.mark.slow
def test_nothing_is_found_in_sound_heights_pressures_and_velocities(aided):
    assert attribute([aided], TRUTH).effects == ()


def test_of_two_models_that_tell_the_same_the_one_of_fewer_parameters_counts(flight):
    """Models: a frame shifted along z, the same with useless delays of all anchors, and none."""
    shifted = EFFECTS["truth_frame"]({"z": 0.3}).inject(flight)
    frame, delays = (
        candidates_of(EFFECTS[name](), flight.anchors, None)
        for name in ("truth_frame", "anchor_delay")
    )
    along_z = next(one for one in frame if one.terms[0].keys == ("z",))
    table = table_of(residuals_of([shifted], TRUTH, EffectSet())).with_terms(
        [*along_z.terms, *delays[0].terms]
    )
    found = select(table, [along_z], None)
    for other in (found.plus(delays[0]), found.only(())):
        assert _simpler(other, found, 10) is _simpler(found, other, 10) is found


def test_of_two_models_of_the_same_things_the_one_that_is_worth_more_counts(flight, monkeypatch):
    """Models: a frame shifted along z and slightly along x, and a frame shifted along z only.

    Both shift the frame. The smaller model explains three quarters of the shift.
    """
    shifted = EFFECTS["truth_frame"]({"z": 0.3, "x": 0.02}).inject(flight)
    frame = candidates_of(EFFECTS["truth_frame"](), flight.anchors, None)
    whole, along_z = (
        next(one for one in frame if one.terms[0].keys == keys)
        for keys in (("x", "y", "z"), ("z",))
    )
    table = table_of(residuals_of([shifted], TRUTH, EffectSet())).with_terms(whole.terms)
    inflation = fit(table, list(whole.columns)).inflation
    more, fewer = (select(table, [one], inflation) for one in (whole, along_z))
    monkeypatch.setattr(refinement, "SAME_STORY", 0.3)
    assert _simpler(more, fewer, 10) is _simpler(fewer, more, 10) is more


@pytest.mark.slow
def test_maps_of_the_place_are_looked_for_in_three_flights_or_more(monkeypatch):
    looked = []
    monkeypatch.setattr(
        attribution,
        "with_maps",
        lambda selection, *_: looked.append(selection.table.flights) or selection,
    )
    flights = [sparse_flight(seed, 17.0) for seed in (100, 101, 102)]
    for number in (2, 3):
        attribute(flights[:number], TRUTH)
    assert looked == [3]
