# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from known_effects import clean_flight, effect_of, sparse_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import CHANNELS, residuals
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.regression.fit import fit
from uwb_tdoa_tools.diagnosis.regression.products import FINE, _Bins, _Subset
from uwb_tdoa_tools.diagnosis.regression.scan import Scan, _held
from uwb_tdoa_tools.diagnosis.regression.table import table_of
from uwb_tdoa_tools.diagnosis.regression.terms import Candidate, Term

pytestmark = pytest.mark.slow

TRUTH = GroundTruth()


@pytest.fixture(scope="module")
def flight():
    return sparse_flight(106, 40.0)


def scanned(flight):
    """Return (Table, Fit of the empty model, Scan) of a flight."""
    found = [residuals(flight, TRUTH, EffectSet())]
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
    put_in("anchor", "2", "time", (1.0, 3.0, 7.5), "pulse", 0.4),
    put_in("pair", "0-1", "time", (0.0, 5.3), "wave", 0.3),
    put_in("anchor", "6", "time", (0.0, 2.63), "wave", 0.3),
]


@pytest.mark.parametrize("term", RARE, ids=lambda term: f"{term.covariate}-{term.shape}")
def test_a_product_of_two_covariates_or_what_recurs_is_proposed_first(flight, term):
    table, model, scan = scanned(term.inject(flight))
    proposals = scan._products(model.information(table), model.residual)
    first = proposals[0]
    assert {*first.term.arguments} == {*term.arguments}
    assert first.key[2] == next(iter(term.values)).rpartition(".")[0]
    assert first.term.shape == term.shape or term.factor
    simple = scan.gains(table, _held(table, model, ()))[0]
    assert first.gain > 1.2 * simple[0]  # with the weights of the fit
    assert first.candidate.label in {one.label for one in scan(table, model, ())}
    if term.periodic:
        period, found = (knots[-1] - knots[0] for knots in (term.knots, first.term.knots))
        assert found == pytest.approx(period, rel=0.01)
    else:  # two explanations of the same rows may have different knots
        inner = zip(term.knots[1:-1], first.term.knots[1:-1])
        alike = first.term.arguments == term.arguments and len(first.term.knots) == len(term.knots)
        assert all(abs(one - other) < 0.15 for one, other in inner if alike)


@pytest.mark.parametrize("term", RARE[:2], ids=lambda term: term.covariate)
def test_a_finer_search_of_a_product_never_loses_gain(flight, term):
    table, model, scan = scanned(term.inject(flight))
    weights, products = model.information(table), scan._products
    found = [one for one in products(weights, model.residual) if one.term.factor]
    assert found
    for one in found:
        (subset,) = (each for each in products._subsets if each.key == one.key)
        bins = [_Bins.of(name, subset.values[name], FINE) for name in one.term.arguments]
        gain, _ = subset.best_product(subset.weighted(weights, model.residual), bins)
        assert one.gain >= gain


@pytest.mark.quick
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


def test_what_changes_fast_is_no_noise_of_its_series():
    """A wave with a period of 4 s moves the TDOAs between two rows by more than their noise."""
    wave = put_in("anchor", "3", "time", (0.0, 4.0), "wave", 0.4)
    flight = clean_flight(106, 40.0)  # with all TDOAs of its protocol
    (table, _, scan), (_, _, plain) = scanned(wave.inject(flight)), scanned(flight)
    rows = table.rows_of("tdoa")
    assert np.quantile(scan.even[rows] / plain.even[rows], 0.02) > 0.5


TERMS = [
    put_in("anchor", "3", "x", (-3.0, 0.5, 3.0), "step", 0.3),
    put_in("pair", "0-1", "time", (0.0, 15.0, 22.0, 40.0), "interval", 0.4),
    put_in("anchor", "5", "range", (2.0, 8.0), "line", 0.6),
]


@pytest.mark.parametrize("term", TERMS, ids=lambda term: f"{term.form}-{term.covariate}")
def test_of_thousands_the_right_function_is_proposed_first(flight, term):
    table, model, scan = scanned(term.inject(flight))
    first = scan(table, model, ())[0].terms[0]
    assert (first.effect.form, first.effect.covariate, first.effect.shape) == (
        term.form,
        term.covariate,
        term.shape,
    )
    assert {key.rpartition(".")[0] for key in first.keys} == {
        key.rpartition(".")[0] for key in term.values
    }


@pytest.mark.quick
def test_the_gain_is_that_of_normal_equations_with_the_same_weights(flight):
    """The closed form for thousands of functions agrees with one fit.

    The model already holds another effect.
    """
    effect = effect_of("anchor_delay", True, 1)
    table, _, scan = scanned(TERMS[2].inject(effect.inject(flight)))
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


def test_what_acts_on_a_few_rows_alone_is_not_taken_for_outliers(flight):
    imu = flight.imu
    accel = imu.accel.copy()
    accel[:, 1] += 1.0 * ((imu.t > 20.0) & (imu.t < 23.0))
    table, model, scan = scanned(replace(flight, imu=replace(imu, accel=accel)))
    first = scan(table, model, ())[0].terms[0].effect
    assert (first.channel, first.covariate, first.shape) == ("accel.y", "time", "interval")


def test_a_function_of_one_pair_is_found_added_and_said(flight):
    attribution = attribute([TERMS[1].inject(flight)], TRUTH)
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
