# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from known_effects import clean_flight, effect_of
import pytest

from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.over_flights import (
    ALL,
    ALONE,
    DIFFERS,
    GROWS,
    Share,
    course,
    harm,
    in_words,
    shares,
)
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import OF_ONE


def several(*values, std=0.05):
    return tuple(Share(f"flight-{k}", value, std) for k, value in enumerate(values))


@pytest.mark.parametrize(
    "values, kind",
    [
        ((1.0, 0.9, 1.1), ALL),
        ((0.02, 2.9, 0.1), ALONE),
        ((0.2, 0.7, 1.3, 1.9), GROWS),
        ((1.9, 1.3, 0.7, 0.2), GROWS),
        ((0.2, 1.9, 0.3, 1.6), DIFFERS),
        ((1.0,), None),
    ],
)
def test_what_several_flights_say(values, kind):
    assert course(several(*values)) == kind


def test_flights_that_tell_nothing_do_not_count():
    assert course((*several(1.0, 1.1), Share("other", 7.0, 3.0))) == ALL
    assert course((*several(1.0), Share("other", 7.0, 3.0))) is None
    assert in_words((*several(1.0), Share("other", 7.0, 3.0))) == ""


def test_words_name_the_flights():
    assert "flight-1 alone" in in_words(several(0.0, 1.0, 0.0))
    assert "0.2 in flight-0" in in_words(several(0.2, 1.9, 0.3, 1.6))
    assert "all 2 flights" in in_words(several(1.0, 1.0))


def test_shares_are_those_that_were_put_in():
    flights = [
        replace(effect_of("anchor_delay", True, 1), values={"2": delay}).inject(
            clean_flight(100 + k, 30.0)
        )
        for k, delay in enumerate((0.1, 0.2, 0.3))
    ]
    attribution = attribute(flights, GroundTruth(), kinds=("anchor_delay",), undeclared=False)
    (candidate,) = attribution.selection.chosen
    found = shares(attribution.selection, candidate, attribution.names)
    assert [share.share / found[1].share for share in found] == pytest.approx(
        [0.5, 1.0, 1.5], abs=0.05
    )
    assert course(found) == GROWS


@pytest.mark.slow
def test_a_function_that_one_flight_alone_can_show_is_not_applied():
    """Anchor 3 is late from 26 to 34 s. The other flight ends before."""
    late = SmoothTerm(
        {"3.c0": 0.0, "3.c1": 0.5},
        covariate="time",
        form="anchor",
        knots=(0.0, 26.0, 34.0, 40.0),
        shape="interval",
    )
    attribution = attribute(
        [late.inject(clean_flight(100, 40.0)), clean_flight(101, 24.0)], GroundTruth()
    )
    assert not any(effect.name == late.name for effect in attribution.effects)
    ((name, alone),) = attribution.alone
    assert name == attribution.names[0]
    assert {candidate.terms[0].effect.covariate for candidate in alone.chosen} == {"time"}
    assert OF_ONE in {refused.why for refused in attribution.refused}


def test_what_flights_show_alike_does_no_harm_and_what_one_of_three_lacks_may():
    assert harm(several(1.0, 1.0)) < 0.06
    assert harm(several(1.0, 1.1, 0.9)) < 0.03
    assert harm(several(1.0, 0.2, 1.0)) > 0.25
    assert harm(several(1.5, 0.0)) > 0.2
    # with equal spread, more flights reduce the risk
    assert harm(several(*[1.2, 0.8] * 3)) < harm(several(1.2, 0.8))


def test_flights_that_do_not_determine_a_share_tell_nothing_of_harm():
    assert harm(()) == harm(several(0.0)) == harm(several(0.0, 0.0, std=0.5)) == 0.0
    undetermined = Share("unknown", -3.0, 0.9)
    assert harm([*several(1.0, 1.1, 0.9), undetermined]) == harm(several(1.0, 1.1, 0.9))
