# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Standard deviations of anchor positions, fitted with ground truth, match the actual errors."""

from known_effects import clean_flight, normalised, root
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.deviations import with_deviations
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import effects_of
from uwb_tdoa_tools.readers import inputs

MEASURED = {  # hold-out recordings, and the errors put into their surveys, m
    "util/const1-trial3-tdoa2.csv.gz": 0.1,
    "util/const3-trial2-tdoa2.csv.gz": 0.05,
    "util/const4-trial1-tdoa2-traj2.csv.gz": 0.1,
    "flights/0426/0426-traj7": 0.05,
}


@pytest.mark.slow
def test_deviations_hold_on_simulated_flights():
    told = [
        normalised(clean_flight(seed, 60.0), 0.1, seed)["anchor_position"]["stated"][1]
        for seed in (504, 505)
    ]
    assert 0.6 < root(told) < 1.5 and all(len(one) == 24 for one in told)


@pytest.mark.slow
def test_deviations_hold_on_measured_flights(shared_data):
    """The standard deviations of the fit alone are two to four times too small.

    Other systematic errors last for the whole flight.
    """
    reading = inputs.Reading(str(shared_data / "surveys"))
    told = {name: [] for name in ("stated", "alone", "applied")}
    for path, std in MEASURED.items():
        (flight,) = reading.flights([str(shared_data / path)])
        fits = normalised(flight, std, 12)["anchor_position"]
        for name, several in told.items():
            several.append(fits[name][1])
        assert root([fits["stated"][1]]) < 1.5, path
    assert 0.7 < root(told["stated"]) < 1.5 < root(told["alone"])
    assert 0.7 < root(told["applied"]) < 1.5


def test_what_is_no_anchor_keeps_its_deviation():
    found = attribute([clean_flight(300, 30.0)], GroundTruth(), undeclared=False)
    assert with_deviations(found.selection) is found.selection


@pytest.mark.slow
def test_a_delay_beside_others_that_are_zero_is_stated_as_well_as_it_is_known():
    """TDOAs do not determine the mean delay. It adds nothing to the deviation of a single delay."""
    errors, stated = [], []
    for seed in (305, 306):
        flight = EFFECTS["anchor_delay"]({"5": 0.1}).inject(clean_flight(seed, 30.0))
        found = attribute([flight], GroundTruth(), kinds=("anchor_delay",), undeclared=False)
        (effect,) = effects_of(found.selection)
        assert effect.values.keys() == {"5"}
        errors.append(effect.values["5"] - 0.1)
        stated.append(effect.std["5"])
    assert (np.abs(errors) < 3.0 * np.array(stated)).all()
    assert max(stated) < 0.02


def test_delays_are_stated_apart_from_what_all_have_in_common():
    """TDOAs do not determine the mean delay.

    The fit sets it to 0, and no standard deviation includes it.
    """
    delays = 0.05 * np.random.default_rng(5).standard_normal(8)
    flight = EFFECTS["anchor_delay"](dict(zip("01234567", delays.tolist()))).inject(
        clean_flight(301, 30.0)
    )
    found = attribute([flight], GroundTruth(), kinds=("anchor_delay",), undeclared=False)
    (effect,) = effects_of(found.selection)
    errors = np.array([effect.values[key] for key in "01234567"]) - (delays - delays.mean())
    std = np.array([effect.std[key] for key in "01234567"])
    assert std.max() < 0.015 and (np.abs(errors) < 3.0 * std).all()
