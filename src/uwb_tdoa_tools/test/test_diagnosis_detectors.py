# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from known_effects import clean_flight, effect_of
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.diagnosis.attribution import attribute, near_floor, on_floor
from uwb_tdoa_tools.diagnosis.channels import CHANNELS, residuals
from uwb_tdoa_tools.diagnosis.detectors import DETECTORS
from uwb_tdoa_tools.diagnosis.references import GroundTruth, Nothing
from uwb_tdoa_tools.diagnosis.refinement import effects_of
from uwb_tdoa_tools.diagnosis.regression.fit import fit
from uwb_tdoa_tools.diagnosis.regression.table import table_of

OF_NOISE = ("outlier_rate", "noise_level", "noise_correlation")


@pytest.fixture(scope="module")
def clean():
    return clean_flight(102, 40.0)


def seen(*flights):
    return [residuals(flight, GroundTruth(), EffectSet()) for flight in flights]


@pytest.mark.parametrize("name", OF_NOISE)
def test_what_is_there_is_detected_with_its_size(clean, name):
    effect = effect_of(name, True, 3)
    detection = DETECTORS[name].detect(seen(effect.inject(clean, np.random.default_rng(1))))
    assert detection.channel == "tdoa" and detection.evidence["standard_errors"] > 4.0
    found = detection.effect
    assert found.name == name and set(found.values) == set(effect.values)
    for key, value in effect.values.items():
        assert found.values[key] == pytest.approx(value, rel=0.35), key


@pytest.mark.parametrize("name", OF_NOISE)
def test_nothing_is_detected_in_a_clean_flight(clean, name):
    assert DETECTORS[name].detect(seen(clean)) is None


def test_pairs_among_more_than_a_thousand_anchors_are_called_by_their_ids(clean):
    effect, anchors = effect_of("noise_level", True, 3), clean.anchors
    far = np.column_stack([1000.0 + np.arange(1100), np.zeros((1100, 2))])
    among = Anchors.from_positions(
        np.concatenate([far, anchors.positions]),
        np.concatenate([5000 + np.arange(1100), anchors.ids]),
    )
    noisy = effect.inject(replace(clean, anchors=among), np.random.default_rng(1))
    assert set(DETECTORS["noise_level"].detect(seen(noisy)).effect.values) == set(effect.values)
    (part,) = (one["tdoa"] for one in seen(noisy))
    told = CHANNELS["tdoa"].health([part])
    heard = {f"{a}-{b}" for a, b in zip(noisy.tdoa.a.tolist(), noisy.tdoa.b.tolist())}
    assert {row["pair"] for row in told["pairs"]} <= heard
    assert {pair for row in told["cross_correlation"] for pair in row["pairs"]} <= heard


def searched(*flights):
    table = table_of(seen(*flights))
    return DETECTORS["nlos"].search(table, fit(table, [], np.ones(3 * len(CHANNELS))), [])


def test_an_interval_without_sight_is_searched_in_a_single_flight(clean):
    effect = effect_of("nlos", True, 2)
    (key,) = (key for key in effect.values if key.endswith("delay"))
    anchor = key.partition(".")[0]
    intervals = [
        c for c in searched(effect.inject(clean)) if f"{anchor}.start" in c.terms[0].effect.values
    ]
    limits = intervals[0].terms[0].effect.values
    assert limits[f"{anchor}.start"] == pytest.approx(effect.values[f"{anchor}.start"], abs=1.0)
    assert limits[f"{anchor}.end"] == pytest.approx(effect.values[f"{anchor}.end"], abs=1.0)
    assert intervals[0].price > 0.0 and intervals[0].terms[0].keys == (key,)


def test_time_is_no_limit_where_there_are_several_flights(clean):
    effect = effect_of("nlos", True, 2)
    found = searched(effect.inject(clean), effect.inject(clean_flight(103, 40.0)))
    assert all(".radius" in "".join(c.terms[0].effect.values) for c in found)


def test_an_anchor_that_is_blocked_already_is_not_searched_again(clean):
    flight = effect_of("nlos", True, 2).inject(clean)
    table = table_of(seen(flight))
    model = fit(table, [], np.ones(3 * len(CHANNELS)))
    first = DETECTORS["nlos"].search(table, model, [])
    keys = {c.terms[0].keys for c in first}
    again = DETECTORS["nlos"].search(table, model, first)
    assert not keys & {c.terms[0].keys for c in again}


LATE = {"0.delay": 3.3, "2.delay": 2.8, "5.delay": 3.6, "7.delay": 3.3}
LOW = {f"{i}.height": 0.1 for i in (0, 2, 5, 7)}


def near(*flights):
    return [near_floor(part) for part in seen(*flights)]


def on_the_floor(*flights, named=True):
    """Return the effects found near the floor of some flights."""
    return effects_of(
        on_floor(near(*flights), [DETECTORS["floor_multipath"]] if named else [], True, [])
    )


@pytest.fixture(scope="module")
def landed(clean):
    return EFFECTS["floor_multipath"]({**LATE, **LOW}).inject(clean)


def test_anchors_that_are_late_on_the_floor_are_found_with_their_heights(landed):
    (found,) = on_the_floor(landed)
    assert {key for key in found.values if key.endswith(".delay")} == set(LATE)
    for key, value in LATE.items():
        assert found.values[key] == pytest.approx(value, abs=0.1), key
    for key, height in LOW.items():
        assert height / 1.5 < found.values[key] < height * 1.5, key


def test_the_floor_is_described_without_a_name_for_it(landed):
    """Functions of the height describe low anchors: metres late near the floor, but not above."""
    found = on_the_floor(landed, named=False)
    assert found and all(effect.covariate in ("height", "elevation") for effect in found)
    (part,) = near(landed)
    samples, low = part["tdoa"].samples, part["tdoa"].samples.p[:, 2] < 0.05
    told, true = (
        EffectSet(tuple(effects)).bias(samples)
        for effects in (found, [EFFECTS["floor_multipath"]({**LATE, **LOW})])
    )
    assert np.mean((true - told)[low] ** 2) < 0.3 * np.mean(true[low] ** 2)


def test_nothing_is_found_on_a_floor_that_does_nothing(clean):
    assert not on_the_floor(clean) and not on_the_floor(clean, named=False)


@pytest.mark.slow
def test_one_anchor_that_is_late_there_is_not_the_floor(clean):
    blocked = EFFECTS["floor_multipath"]({"2.delay": 1.9, "2.height": 0.1}).inject(clean)
    assert all(effect.name != "floor_multipath" for effect in on_the_floor(blocked))


@pytest.mark.slow
def test_what_is_found_in_the_air_does_not_depend_on_the_floor(clean, landed):
    assert [
        e.values for e in effects_of(attribute([landed], GroundTruth(), undeclared=False).selection)
    ] == [
        e.values for e in effects_of(attribute([clean], GroundTruth(), undeclared=False).selection)
    ]


def test_a_path_that_is_an_estimate_tells_nothing_of_the_floor(clean):
    reference = Nothing()
    part = residuals(reference.prepare(clean), reference, EffectSet())
    assert near_floor(part) == {}
