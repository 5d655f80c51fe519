"""Faults in the TDOAs of one pair, and their repair."""

from dataclasses import replace

from known_effects import clean_flight
from number_faults import FAULTS
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.checking import pair_rules
from uwb_tdoa_tools.checking.pair_rules import KnownPath, repairs

T = np.arange(600) / 20.0
TRUE = 3.0 * np.sin(0.5 * T)
D = TRUE + 0.1 * np.random.default_rng(0).standard_normal(len(T))


def fault_of(d, true=TRUE):
    """Name of the first rule that says something of a pair, with its value."""
    for rule in pair_rules.OF_PAIR:
        found = rule(d, true, T)
        if found is not None:
            return rule.__name__[1:], found[3]
    return None


def stands(first, last):
    d = D.copy()
    d[first:last] = d[first - 1]
    return d


def test_a_healthy_pair_has_no_fault():
    assert fault_of(D) is None


@pytest.mark.parametrize("grid", [0.1, 0.37, 1.0, 2.5])
def test_rounding_is_found(grid):
    assert fault_of(np.round(D / grid) * grid) == ("rounded", pytest.approx(grid))


def test_ticks_of_the_radio_are_no_rounding():
    assert fault_of(np.round(D / 0.00469) * 0.00469) is None


@pytest.mark.parametrize("every", [2, 3, 8])
def test_interpolation_is_found(every):
    known = np.arange(0, len(D), every)
    late = T + 0.01 * np.random.default_rng(1).uniform(size=len(T))
    for place in (np.arange(len(D)), late):
        d = np.interp(place, place[known], D[known])
        assert pair_rules._interpolated(d, TRUE, late)[0] == "is interpolated"


@pytest.mark.parametrize("every", [2, 5, 12])
def test_repeated_values_are_found(every):
    assert fault_of(D[np.arange(len(D)) // every * every])[0] == "repeated"


def test_clipping_is_found():
    for d in (np.minimum(D, 2.0), np.maximum(D, -2.0), np.clip(D, -1.5, 1.5)):
        name, at = fault_of(d)
        assert name == "clipped" and at in (d.max(), d.min())


def test_a_frozen_pair_is_found():
    name, since = fault_of(stands(200, 300))
    assert name == "frozen" and since == T[199]


def test_a_wrong_sign_is_found_in_motion():
    assert fault_of(-D)[0] == "sign"
    assert fault_of(-D[:600] + TRUE, np.zeros(600)) is None  # it stands: nobody can tell


def test_a_fault_of_all_pairs_is_one_finding():
    path = KnownPath(FAULTS["tdoa_sign"].put_in(clean_flight(100, 20.0), None))
    (found,) = pair_rules.wrong_values(path)
    assert found.rule == "tdoa_sign" and "pairs" in found.evidence


@pytest.mark.parametrize("cycle", [(1, 4), (0, 3, 6)])
def test_exchanged_ids_are_found(cycle):
    flight = clean_flight(100, 20.0)
    table = dict(zip(cycle, np.roll(cycle, 1).tolist()))
    of = flight.tdoa
    a, b = (np.array([table.get(i, i) for i in ids.tolist()]) for ids in (of.a, of.b))
    renamed = KnownPath(
        type(flight)(flight.name, flight.anchors, type(of)(of.t, a, b, of.d), truth=flight.truth)
    )
    found, before, after = pair_rules.find_exchanges(renamed)
    assert found == {called: anchor for anchor, called in table.items()} and after < 0.4 * before
    (finding,) = pair_rules.exchanged_ids(renamed)
    assert finding.rule == "ids_exchanged" and str(found[cycle[0]]) in finding.remedy


IDS, SIGN = EFFECTS["anchor_ids"]({"1": 4, "4": 1}), EFFECTS["pair_sign"]({"2-3": -1.0})


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 20.0)


@pytest.mark.parametrize("put_in", [(), (IDS,), (SIGN,), (IDS, SIGN)])
def test_injected_faults_are_undone(flight, put_in):
    changed = flight
    for effect in reversed(put_in):
        changed = effect.inject(changed)
    undone = repairs(changed)
    assert [(effect.name, effect.values) for effect in undone] == [
        (effect.name, effect.values) for effect in put_in
    ]
    back = EffectSet(undone).correct_streams(changed).tdoa
    assert np.array_equal(back.a, flight.tdoa.a) and np.array_equal(back.d, flight.tdoa.d)


def test_wrong_signs_are_no_exchange_of_ids(flight):
    (effect,) = repairs(replace(flight, tdoa=replace(flight.tdoa, d=-flight.tdoa.d)))
    assert effect.name == "pair_sign" and len(effect.values) > 4


def test_without_ground_truth_nothing_is_repaired(flight):
    assert repairs(replace(flight, truth=None)) == ()
