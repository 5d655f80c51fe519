# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from importlib import import_module

from known_effects import clean_flight, sparse_flight
import numpy as np
import pytest
import undeclared

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.attribution import Attribution, residuals_of
from uwb_tdoa_tools.diagnosis.findings import Refused
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.regression.fit import fit
from uwb_tdoa_tools.diagnosis.regression.select import Selection
from uwb_tdoa_tools.diagnosis.regression.table import table_of
from uwb_tdoa_tools.diagnosis.single_axes import beside, functions_of_axes
from uwb_tdoa_tools.diagnosis.validation import ValidatedSelection


def residuals(*flights):
    return residuals_of(flights, GroundTruth(), EffectSet())


def labels(selections):
    return [one.label for found in selections for one in found.chosen]


@pytest.fixture(scope="module")
def wandering():
    """Two flights in which x and y of the accelerometer wander, and z errs by the place."""
    return [
        undeclared.accel_of_place_beside_drift(sparse_flight(seed, 40.0)) for seed in (100, 101)
    ]


@pytest.fixture(scope="module")
def found(wandering):
    return functions_of_axes(residuals(*wandering), [])


@pytest.mark.slow
def test_an_axis_is_searched_with_its_own_noise(found):
    assert "accel.z over y" in labels(found)
    (of_accel,) = found
    x, y, z = of_accel.fit.inflation[np.unique(of_accel.table.group)]
    assert 4.0 * z < min(x, y)


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is():
    flights = [clean_flight(seed, 30.0, aided=True) for seed in range(2)]
    assert functions_of_axes(residuals(*flights), []) == []


def test_flights_without_inertial_samples_have_no_axes(wandering):
    assert functions_of_axes(residuals(wandering[0].without("imu")), []) == []


@pytest.mark.slow
def test_what_one_of_both_flights_shows_is_left_out(wandering):
    alone = functions_of_axes(residuals(wandering[0]), [])
    both = functions_of_axes(residuals(wandering[0], sparse_flight(101, 40.0)), [])
    assert "accel.z over y" in labels(alone) and "accel.z over y" not in labels(both)


def test_functions_join_a_selection_with_the_noise_that_they_leave(wandering, found):
    table = table_of(residuals(*wandering))
    alone = Selection(table, (), fit(table, []), (), ())
    both = beside(alone, found)
    (of_accel,) = found
    groups = np.unique(of_accel.table.group)
    assert labels([both]) == labels(found)
    assert both.fit.inflation[groups] == pytest.approx(of_accel.fit.inflation[groups])
    others = np.setdiff1d(np.unique(table.group), groups)
    assert both.fit.inflation[others] == pytest.approx(alone.fit.inflation[others])
    assert (
        both.fit.residual[table.rows_of("accel")].std()
        < 0.95 * table.y[table.rows_of("accel")].std()
    )


@pytest.mark.slow
def test_a_diagnosis_names_the_axis_first_and_takes_its_error_out(wandering):
    """Without functions of single axes the error stays, and the axis is not named."""
    other = undeclared.accel_of_place_beside_drift(sparse_flight(102, 40.0))
    diagnosis = diagnose(wandering, holdout=[other])
    first = max(diagnosis.findings, key=lambda one: one.worth or 0.0)
    assert first.added and first.effect.label == "accel.z over y"
    before, after = (side["pooled"]["rmse_3d"] for side in (diagnosis.before, diagnosis.after))
    assert after < 0.7 * before


@pytest.mark.parametrize("error, taken", [(0.969, True), (0.971, False)])
def test_functions_are_taken_only_with_a_clear_gain(wandering, found, monkeypatch, error, taken):
    module = import_module("uwb_tdoa_tools.diagnosis.diagnose")
    table = table_of(residuals(*wandering))
    nothing = Selection(table, (), fit(table, []), (), ())
    attribution = Attribution([], nothing, (), [], (), ())
    refused = (Refused("nlos", "as before"), Refused("noise_level", "as before"))
    first = ValidatedSelection(nothing, (), refused, {}, 1.0)
    second = ValidatedSelection(nothing, (), (Refused("noise_level", "anew"),), {}, error)
    monkeypatch.setattr(module.validation, "select_by_error", lambda *_, **__: second)
    monkeypatch.setattr(module, "functions_of_axes", lambda *_: found)
    work = module._Work(GroundTruth(), EffectSet(), None, lambda what: None, map)
    searched = module._with_functions_of_axes(work, wandering, EffectSet(), attribution, first)
    if taken:
        assert labels([searched[0].selection]) == labels(found)
        assert [one.why for one in searched[1].refused] == ["as before", "anew"]
    else:
        assert searched == (attribution, first)
