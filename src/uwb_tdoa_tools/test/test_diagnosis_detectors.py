import numpy as np
import pytest

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis.detectors import DETECTORS
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.regression.fit import fit
from uwb_tdoa_tools.diagnosis.channels import CHANNELS, residuals
from uwb_tdoa_tools.diagnosis.regression.table import table_of
from uwb_tdoa_tools.studies.diagnosis.bank import clean_flight, effect_of

OF_NOISE = ("outlier_rate", "noise_level", "noise_correlation", "floor_multipath")


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


def searched(*flights):
    table = table_of(seen(*flights))
    return DETECTORS["nlos"].search(table, fit(table, [], np.ones(3 * len(CHANNELS))), [])


def test_an_interval_without_sight_is_searched_in_a_single_flight(clean):
    effect = effect_of("nlos", True, 2)
    (key,) = (key for key in effect.values if key.endswith("delay"))
    anchor = key.partition(".")[0]
    intervals = [c for c in searched(effect.inject(clean)) if f"{anchor}.start" in c.terms[0].effect.values]
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
