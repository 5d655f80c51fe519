"""Ids and signs that are put right."""

from dataclasses import replace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.checking.pair_rules import repairs

IDS, SIGN = EFFECTS["anchor_ids"]({"1": 4, "4": 1}), EFFECTS["pair_sign"]({"2-3": -1.0})


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 20.0)


@pytest.mark.parametrize("put_in", [(), (IDS,), (SIGN,), (IDS, SIGN)])
def test_what_was_put_in_is_undone(flight, put_in):
    changed = flight
    for effect in reversed(put_in):
        changed = effect.inject(changed)
    undone = repairs(changed)
    assert [(effect.name, effect.values) for effect in undone] == [
        (effect.name, effect.values) for effect in put_in
    ]
    back = EffectSet(undone).correct_streams(changed).tdoa
    assert np.array_equal(back.a, flight.tdoa.a) and np.array_equal(back.d, flight.tdoa.d)


def test_all_signs_are_no_exchange_of_ids(flight):
    (effect,) = repairs(replace(flight, tdoa=replace(flight.tdoa, d=-flight.tdoa.d)))
    assert effect.name == "pair_sign" and len(effect.values) > 4


def test_without_ground_truth_nobody_knows(flight):
    assert repairs(replace(flight, truth=None)) == ()
