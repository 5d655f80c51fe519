# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Errors in ids and signs are searched before physical effects."""

from known_effects import clean_flight, effect_of
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.diagnosis import diagnose, output, repairing

IDS, SIGN = (
    EFFECTS["anchor_ids"]({"1": 4, "4": 1}),
    EFFECTS["pair_sign"]({"2-3": -1.0, "5-6": -1.0}),
)
DELAY = EFFECTS["anchor_delay"]({"4": 0.1})


@pytest.fixture(scope="module")
def flights():
    return [clean_flight(seed, 20.0) for seed in (100, 105)]


def wrong(flight, *effects):
    for effect in reversed(effects):
        flight = effect.inject(flight)
    return flight


def found_in(flights, base=EffectSet()):
    return [(one.effect.name, one.effect.values) for one in repairing.repaired(flights, base)]


def test_what_all_flights_have_is_found_and_worth_something(flights):
    found = repairing.repaired([wrong(flight, IDS, SIGN) for flight in flights], EffectSet())
    assert [(one.effect.name, one.effect.values) for one in found] == [
        (IDS.name, IDS.values),
        (SIGN.name, SIGN.values),
    ]
    assert min(found.values()) > 0.01
    assert all(
        one.evidence["median_error_without"] < 0.4 * one.evidence["median_error"] for one in found
    )


def test_sound_flights_need_nothing_nor_do_those_whose_effects_are_known(flights):
    assert found_in(flights) == []
    assert (
        found_in([wrong(flight, IDS, SIGN) for flight in flights], EffectSet((IDS, DELAY, SIGN)))
        == []
    )


def test_signs_that_some_flights_have_are_left_and_so_are_other_ids(flights):
    one, two = flights
    half = EFFECTS["pair_sign"]({"2-3": -1.0})
    assert found_in([wrong(one, SIGN), wrong(two, half)]) == [("pair_sign", {"2-3": -1.0})]
    others = EFFECTS["anchor_ids"]({"1": 5, "5": 1})
    assert found_in([wrong(one, IDS), wrong(two, others)]) == [] == found_in([wrong(one, IDS), two])


def test_flights_are_made_sound_and_the_rest_is_left_in_the_base(flights):
    (found,) = repairing.repaired([wrong(flights[0], IDS, SIGN)], EffectSet((IDS, DELAY)))
    (flight,), base = repairing.sound(
        [wrong(flights[0], IDS, SIGN)], EffectSet((IDS, DELAY)), [found]
    )
    assert (flight.tdoa.a == flights[0].tdoa.a).all() and (flight.tdoa.d == flights[0].tdoa.d).all()
    assert base.effects == (DELAY,)


@pytest.mark.slow
def test_diagnose_offers_it_beside_physics_and_judges_both():
    late = effect_of("anchor_delay", True, 4)
    flights = [wrong(late.inject(clean_flight(seed, 30.0)), IDS) for seed in (100, 101)]
    result = diagnose(flights[:1], flights[1:])
    assert {finding.effect.name for finding in result.findings if finding.added} == {
        IDS.name,
        late.name,
    }
    worth = next(finding.worth for finding in result.findings if finding.effect.name == IDS.name)
    before, after = (figures["pooled"]["rmse_3d"] for figures in (result.before, result.after))
    # without the repair, the error is three times as large
    assert worth > 2.0 * after and after < 0.3 * before
    assert "what is called 1 is 4" in output.as_text(result) and "ids_exchanged" in str(
        output.as_json(result)["numbers"]
    )
    assert repairing.repaired(flights[:1], result.effects) == {}
