# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The search for effects: declared ones, functions without a name, and the scan that proposes them."""

from dataclasses import replace

from known_effects import AIDED, SIZES, clean_flight, effect_of, names_found, sparse_flight
import numpy as np
import pytest
import undeclared

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, LabelEffect, SmoothTerm
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.diagnosis import attribution, refinement
from uwb_tdoa_tools.diagnosis.attribution import EffectSearch, attribute, residuals_of
from uwb_tdoa_tools.diagnosis.channels import CHANNELS, residuals
from uwb_tdoa_tools.diagnosis.findings import Refused
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import _simpler, effects_of, relinearised
from uwb_tdoa_tools.diagnosis.regression.confounding import levels
from uwb_tdoa_tools.diagnosis.regression.fit import fit
from uwb_tdoa_tools.diagnosis.regression.products import FINE, _Bins, _Subset
from uwb_tdoa_tools.diagnosis.regression.scan import Scan, _held
from uwb_tdoa_tools.diagnosis.regression.select import select
from uwb_tdoa_tools.diagnosis.regression.table import table_of
from uwb_tdoa_tools.diagnosis.regression.terms import Candidate, Term, candidates_of
from uwb_tdoa_tools.diagnosis.report.entries import Entry

# --- attribution ---

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


@pytest.mark.parametrize(
    "name, values, delay, moved",
    [
        ("anchor_delay", {"4": 0.28}, 0.28, False),
        ("anchor_delay", {"4": -0.28}, -0.28, False),
        ("anchor_position", {"4.x": 0.3, "4.y": -0.2}, None, True),
    ],
)
def test_functions_of_an_anchor_have_one_level(flight, name, values, delay, moved):
    """Both functions share it, and neither names it. A move of the anchor explains the rest."""
    wrong = EFFECTS[name](values).inject(flight)
    declared = [
        one for effect in ("anchor_delay", "anchor_position")
        for one in candidates_of(EFFECTS[effect](), flight.anchors, None)
    ]  # fmt: skip
    terms = [
        SmoothTerm(covariate=covariate, form="anchor", knots=(-2.0, 2.0), shape="line")
        for covariate in ("x", "y", "height", "bearing")
    ]
    functions = [Candidate((Term(term, term.keys_of(("4",))),)) for term in terms]
    found = residuals_of([wrong], TRUTH, EffectSet())
    table = refinement.linearised(found, [*declared, *functions], ())
    selection = select(table, [], fit(table, []).inflation, start=functions)
    ((anchor, level),) = levels(selection, declared).items()
    assert anchor == "4" and (level.explained > 0.7) == moved
    if moved:
        assert level.shift[0] == pytest.approx(0.3, abs=0.1)
    else:
        assert level.delay == pytest.approx(delay, abs=0.04)
    (finding, *others) = attribution._findings(selection, declared, ("flight",))
    assert finding.levels == {"4": level} and not any(one.levels for one in others)
    (said,) = Entry((finding,), "", "", "").levels
    assert ("farther" in said) == (level.delay > 0.0) and ("a move by" in said) == moved


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


# --- the scan of functions ---


@pytest.fixture(scope="module")
def scanned_flight():
    return sparse_flight(106, 40.0)


def scanned(scanned_flight):
    """Return (Table, Fit of the empty model, Scan) of a flight."""
    found = [residuals(scanned_flight, TRUTH, EffectSet())]
    table = table_of(found)
    views = {
        name: channel.views([found[0][name]])
        for name, channel in CHANNELS.items()
        if name in found[0]
    }
    return table, fit(table, [], np.ones(3 * len(table.channels))), Scan(table, views)


def put_in(form, key, covariate, knots, shape, size):
    return SmoothTerm(
        {f"{key}.c1".lstrip("."): size}, {}, "", "tdoa", covariate, form, knots, shape
    )


def product(key, first, second, size):
    """Return a product of two intervals or steps, each (covariate, knots)."""
    (covariate, knots), (factor, factor_knots) = first, second
    shapes = {3: "step", 4: "interval"}
    return SmoothTerm(
        {f"{key}.c1": size},
        covariate=covariate,
        form="anchor",
        knots=knots,
        shape=shapes[len(knots)],
        factor=factor,
        factor_shape=shapes[len(factor_knots)],
        factor_knots=factor_knots,
    )


RARE = [
    product("3", ("x", (-3.0, 0.0, 3.0)), ("height", (0.0, 1.2, 3.0)), 0.5),
    product("5", ("range", (2.0, 4.5, 8.0)), ("y", (-3.0, -1.0, 1.5, 3.0)), 0.6),
]


@pytest.mark.slow
@pytest.mark.parametrize("term", RARE, ids=lambda term: f"{term.covariate}-{term.shape}")
def test_a_product_of_two_covariates_is_proposed_first(scanned_flight, term):
    table, model, scan = scanned(term.inject(scanned_flight))
    proposals = scan._products(model.information(table), model.residual)
    first = proposals[0]
    assert {*first.term.arguments} == {*term.arguments}
    assert first.key[2] == next(iter(term.values)).rpartition(".")[0]
    simple = scan.gains(table, _held(table, model, ()))[0]
    assert first.gain > 1.2 * simple[0]  # with the weights of the fit
    assert first.candidate.label in {one.label for one in scan(table, model, ())}
    # two explanations of the same rows may have different knots
    inner = zip(term.knots[1:-1], first.term.knots[1:-1])
    alike = first.term.arguments == term.arguments and len(first.term.knots) == len(term.knots)
    assert all(abs(one - other) < 0.15 for one, other in inner if alike)


@pytest.mark.slow
@pytest.mark.parametrize("term", RARE, ids=lambda term: term.covariate)
def test_a_finer_search_of_a_product_never_loses_gain(scanned_flight, term):
    table, model, scan = scanned(term.inject(scanned_flight))
    weights, products = model.information(table), scan._products
    found = [one for one in products(weights, model.residual) if one.term.factor]
    assert found
    for one in found:
        (subset,) = (each for each, _ in products._subsets if each.key == one.key)
        bins = [_Bins.of(name, subset.values[name], FINE) for name in one.term.arguments]
        gain, _ = subset.best_product(subset.weighted(weights, model.residual), bins)
        assert one.gain >= gain


@pytest.mark.parametrize("form", ["anchor", "pair"])
def test_the_gain_of_a_product_counts_the_rows_that_a_fit_uses(form):
    """A fit has no level of an anchor where a covariate is unknown, but a level of a pair."""
    rng, n = np.random.default_rng(0), 400
    x, y = rng.exponential(1.0, (2, n))
    known = np.arange(n) < 300
    x[~known] = np.nan
    residual = np.where((x > 1.0) & (y > 0.7), 0.5, 0.1) + 0.1 * rng.standard_normal(n)
    residual[~known] += 0.3
    subset = _Subset(("tdoa", form, "3"), np.arange(n), np.ones(n), {}, 0.5)
    pair = [_Bins.of(name, values, 8) for name, values in (("x", x), ("y", y))]
    weights = np.full(n, 100.0)
    gain, indices = subset.best_product(subset.weighted(weights, residual), pair)
    shapes = [bins.shapes[bins.cell, k] for bins, k in zip(pair, indices)]
    level = np.where(known, 1.0, 0.0 if form == "anchor" else 1.0)
    columns = np.stack([level, shapes[0] * shapes[1]], axis=1)
    gram, vector = 100.0 * columns.T @ columns + 0.5 * np.eye(2), 100.0 * columns.T @ residual
    assert gain == pytest.approx(vector @ np.linalg.solve(gram, vector))


@pytest.mark.slow
def test_what_changes_fast_is_no_noise_of_its_series():
    """A wave with a period of 4 s moves the TDOAs between two rows by more than their noise."""
    wave = put_in("anchor", "3", "time", (0.0, 4.0), "wave", 0.4)
    scanned_flight = clean_flight(106, 40.0)  # with all TDOAs of its protocol
    (table, _, scan), (_, _, plain) = scanned(wave.inject(scanned_flight)), scanned(scanned_flight)
    rows = table.rows_of("tdoa")
    assert np.quantile(scan.even[rows] / plain.even[rows], 0.02) > 0.5


TERMS = [
    put_in("anchor", "3", "x", (-3.0, 0.5, 3.0), "step", 0.3),
    put_in("pair", "0-1", "time", (0.0, 15.0, 22.0, 40.0), "interval", 0.4),
    put_in("anchor", "5", "range", (2.0, 8.0), "line", 0.6),
]


@pytest.mark.slow
@pytest.mark.parametrize("term", TERMS, ids=lambda term: f"{term.form}-{term.covariate}")
def test_of_thousands_the_right_function_is_proposed_first(scanned_flight, term):
    table, model, scan = scanned(term.inject(scanned_flight))
    first = scan(table, model, ())[0].terms[0]
    assert (first.effect.form, first.effect.covariate, first.effect.shape) == (
        term.form,
        term.covariate,
        term.shape,
    )
    assert {key.rpartition(".")[0] for key in first.keys} == {
        key.rpartition(".")[0] for key in term.values
    }


def test_the_gain_is_that_of_normal_equations_with_the_same_weights(scanned_flight):
    """The closed form for thousands of functions agrees with one fit.

    The model already holds another effect.
    """
    effect = effect_of("anchor_delay", True, 1)
    table, _, scan = scanned(TERMS[2].inject(effect.inject(scanned_flight)))
    chosen = (Candidate((Term(effect, tuple(effect.values)),)),)
    table = table.with_terms(chosen[0].terms)
    model = fit(table, chosen[0].columns, np.ones(3 * len(table.channels)))
    gain, shapes, shape, knots, _ = scan.gains(table, _held(table, model, chosen))[0]
    term = SmoothTerm(
        covariate=shapes.view.covariate, form=shapes.view.form, knots=knots, shape=shape
    )
    candidate = Candidate((Term(term, term.keys_of((shapes.view.key,))),))
    table = table.with_terms(candidate.terms)
    columns, information = [*chosen[0].columns, *candidate.columns], model.information(table)
    x, sizes = table.matrix(columns), np.array([column.typical for column in columns])

    def explained(k):
        gram = (x[:, :k] * information[:, None]).T @ x[:, :k] + np.diag(1.0 / sizes[:k] ** 2)
        vector = x[:, :k].T @ (information * table.y)
        return vector @ np.linalg.solve(gram, vector)

    # the function of a mean differs slightly from the mean of the function in a cell
    assert gain == pytest.approx(explained(len(columns)) - explained(1), rel=0.05)


@pytest.mark.slow
def test_what_acts_on_a_few_rows_alone_is_not_taken_for_outliers(scanned_flight):
    imu = scanned_flight.imu
    accel = imu.accel.copy()
    accel[:, 1] += 1.0 * ((imu.t > 20.0) & (imu.t < 23.0))
    table, model, scan = scanned(replace(scanned_flight, imu=replace(imu, accel=accel)))
    first = scan(table, model, ())[0].terms[0].effect
    assert (first.channel, first.covariate, first.shape) == ("accel.y", "time", "interval")


@pytest.mark.slow
def test_a_function_of_one_pair_is_found_added_and_said(scanned_flight):
    attribution = attribute([TERMS[1].inject(scanned_flight)], TRUTH)
    (finding,) = attribution.findings()
    assert (finding.effect.form, finding.effect.covariate, finding.effect.shape) == (
        "pair",
        "time",
        "interval",
    )
    assert finding.effect.values["0-1.c1"] == pytest.approx(0.4, abs=0.05)
    what, why = finding.effect.advice()
    assert "the TDOA of 0-1 is 0." in what and "larger from" in what
    assert why.startswith("Likely causes: ")
