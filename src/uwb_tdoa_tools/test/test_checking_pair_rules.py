"""Faults in the TDOAs of one pair."""

from known_effects import clean_flight
from number_faults import FAULTS
import numpy as np
import pytest

from uwb_tdoa_tools.checking import pair_rules
from uwb_tdoa_tools.checking.pair_rules import KnownPath

T = np.arange(600) / 20.0
TRUE = 3.0 * np.sin(0.5 * T)
D = TRUE + 0.1 * np.random.default_rng(0).standard_normal(len(T))


def said(d, true=TRUE):
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


def test_a_sound_pair():
    assert said(D) is None


@pytest.mark.parametrize("grid", [0.1, 0.37, 1.0, 2.5])
def test_rounded_to_any_grid(grid):
    assert said(np.round(D / grid) * grid) == ("rounded", pytest.approx(grid))


def test_a_fine_grid_is_that_of_the_radio():
    assert said(np.round(D / 0.00469) * 0.00469) is None


@pytest.mark.parametrize("every", [2, 3, 8])
def test_interpolated_over_packets_and_over_time(every):
    known = np.arange(0, len(D), every)
    late = T + 0.01 * np.random.default_rng(1).uniform(size=len(T))
    for place in (np.arange(len(D)), late):
        d = np.interp(place, place[known], D[known])
        assert pair_rules._interpolated(d, TRUE, late)[0] == "is interpolated"


@pytest.mark.parametrize("every", [2, 5, 12])
def test_held(every):
    assert said(D[np.arange(len(D)) // every * every])[0] == "repeated"


def test_clipped_at_either_end_or_both():
    for d in (np.minimum(D, 2.0), np.maximum(D, -2.0), np.clip(D, -1.5, 1.5)):
        name, at = said(d)
        assert name == "clipped" and at in (d.max(), d.min())


def test_standing_still_for_a_while():
    name, since = said(stands(200, 300))
    assert name == "frozen" and since == T[199]


def test_the_other_sign_of_a_pair_that_moves():
    assert said(-D)[0] == "sign"
    assert said(-D[:600] + TRUE, np.zeros(600)) is None  # it stands: nobody can tell


def test_a_fault_of_all_pairs_is_one_finding_and_of_some_is_one_of_each():
    path = KnownPath(FAULTS["tdoa_sign"].put_in(clean_flight(100, 20.0), None))
    (found,) = pair_rules.values(path)
    assert found.rule == "tdoa_sign" and "pairs" in found.evidence


@pytest.mark.parametrize("cycle", [(1, 4), (0, 3, 6)])
def test_ids_that_are_exchanged_by_two_or_around(cycle):
    flight = clean_flight(100, 20.0)
    table = dict(zip(cycle, np.roll(cycle, 1).tolist()))
    of = flight.tdoa
    a, b = (np.array([table.get(i, i) for i in ids.tolist()]) for ids in (of.a, of.b))
    renamed = KnownPath(
        type(flight)(flight.name, flight.anchors, type(of)(of.t, a, b, of.d), truth=flight.truth)
    )
    found, before, after = pair_rules.renamed(renamed)
    assert found == {called: anchor for anchor, called in table.items()} and after < 0.4 * before
    (finding,) = pair_rules.ids(renamed)
    assert finding.rule == "ids_exchanged" and str(found[cycle[0]]) in finding.remedy
