from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.diagnosis import calibration
from uwb_tdoa_tools.diagnosis.attribution import attribute, effects_of
from uwb_tdoa_tools.diagnosis.calibration import LEFT, calibrate
from uwb_tdoa_tools.diagnosis.references import Nothing
from uwb_tdoa_tools.scoring.evaluation import evaluate
from known_effects import clean_flight

DELAYS = {"1": 0.3, "4": -0.2, "6": 0.25}


def calibrated(*effects, seed=100, seconds=40.0):
    flight, reference = clean_flight(seed, seconds), Nothing()
    for effect in effects:
        flight = effect.inject(flight, np.random.default_rng(0))
    flight = reference.prepare(flight)
    attribution = attribute([flight], reference, undeclared=False)
    return calibrate([flight], attribution, EffectSet())


@pytest.fixture(scope="module")
def late():
    return calibrated(EFFECTS["anchor_delay"](DELAYS))


def test_delays_of_several_anchors_are_told_well_enough_from_the_innovations_alone(late):
    assert late.why_not is None and late.explained > 0.5 and late.left < LEFT
    other = EFFECTS["anchor_delay"](DELAYS).inject(clean_flight(101, 30.0), np.random.default_rng(0))
    found = EffectSet(effects_of(late.selection))
    before, after = (evaluate(other, effects=effects)[0].row()["rmse_3d"] for effects in (EffectSet(), found))
    assert after < 0.4 * before


def test_nothing_is_applied_to_a_flight_of_which_nothing_is_wrong():
    calm = calibrated()
    assert calm.explained < 0.1 and "of what is slow in the innovations" in calm.why_not


def test_nothing_is_applied_if_something_else_is_wrong_too():
    blocked = {"2.x": 1.0, "2.y": 0.0, "2.z": 1.0, "2.radius": 1.5, "2.delay": 1.5}
    other = EFFECTS["nlos"](blocked), EFFECTS["anchor_delay"](DELAYS), EFFECTS["noise_correlation"]({"std": 0.2, "time": 1.0})
    assert "leave" in calibrated(*other).why_not


def test_a_flight_that_is_too_short_says_so(late):
    assert "too short" in replace(late, long_enough=False).why_not
    assert not calibrated(EFFECTS["anchor_delay"](DELAYS), seconds=20.0).long_enough
    assert calibration.MIN_BLOCKS * calibration.BLOCK == 30.0
