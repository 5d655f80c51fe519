# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of how good a trained bias can be."""

import numpy as np
from training_flights import flight

from studies.training.bounds import oracle, repeatability, rmse
from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools.training.labels import labels

PLAIN = {"bias": False, "outlier_probability": 0.0, "trajectory": "circle"}


def late(seed, anchor="3", **changes):
    return EFFECTS["anchor_delay"]({anchor: 0.4}).inject(flight(seed, **PLAIN, **changes))


def test_the_oracle_bounds_what_a_model_can_reach():
    one = late(0)
    assert rmse(one, oracle(one, 1.0)) < 0.5 * rmse(one)


def test_flights_with_the_same_error_are_alike():
    one, same, other = labels(late(0)), labels(late(1)), labels(late(2, anchor="6"))
    (alike, cells), (unlike, _) = repeatability(one, same), repeatability(one, other)
    assert cells > 20 and alike > 0.8 and abs(unlike) < 0.6


def test_too_few_places_in_common_tell_nothing():
    found, cells = repeatability(labels(late(0)), labels(late(1, radius=0.2)))
    assert np.isnan(found) and cells < 20
