# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of the diagnosis: what it draws, and when a claim is right."""

from known_effects import clean_flight
import numpy as np
import pytest

from studies.diagnosis import bank, blind, grammar, splits
from studies.diagnosis.claims import claims, truth_of
from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_tools.diagnosis.findings import EffectFinding
from uwb_tdoa_tools.diagnosis.regression.confounding import Alternative


@pytest.fixture(scope="module")
def flight():
    return clean_flight(102, 17.0)


@pytest.fixture(scope="module")
def drawn(flight):
    return [grammar.draw(seed, flight) for seed in range(60)]


def test_a_seed_is_an_effect_and_another_seed_another(flight, drawn):
    assert grammar.draw(3, flight) == drawn[3]
    assert len({effect.name for effect in drawn}) > 55


def test_the_grammar_uses_all_its_words(drawn):
    assert {effect.shape for effect in drawn} == set(grammar.SHAPES)
    assert {effect.stream for effect in drawn} == set(grammar.STREAMS)
    assert {effect.subset for effect in drawn} == {*grammar.SUBSETS, "axis"}


def test_an_effect_changes_its_part_of_its_stream_and_nothing_else(flight, drawn):
    for effect in drawn[:25]:
        changed = effect.inject(flight)
        moved = changed.tdoa.d != flight.tdoa.d
        if effect.stream == "tdoa":
            assert changed.imu is flight.imu
            a, b = flight.tdoa.a, flight.tdoa.b
            if effect.subset == "anchor":
                assert not (moved & (a != effect.who[0]) & (b != effect.who[0])).any()
            elif effect.subset in ("pair", "direction"):
                assert not (moved & ~(np.isin(a, effect.who) & np.isin(b, effect.who))).any()
        else:
            assert not moved.any()
            same = [
                name
                for name in ("gyro", "accel")
                if np.array_equal(getattr(changed.imu, name), getattr(flight.imu, name))
            ]
            assert effect.stream not in same and len(same) == 1


@pytest.mark.parametrize("shape", grammar.SHAPES)
def test_a_shape_is_as_large_as_it_says(shape):
    effect = grammar.Undeclared(
        "tdoa", "all", (), "height", shape, 0.4, (1.0, 2.0), (0.5, 0.2, 0.5)
    )
    course = effect.course(np.linspace(1.0, 2.0, 400))
    assert np.ptp(course) == pytest.approx(0.8 if shape == "periodic" else 0.4, rel=0.02)


def finding(effect, alternatives=()):
    return EffectFinding(effect, effect.channels[0], {"criterion": 50.0}, 0.1, alternatives)


def test_a_claim_is_what_was_put_in(flight):
    true = truth_of(
        grammar.Undeclared("tdoa", "anchor", (3,), "x", "step", 0.4, (1.0, 2.0), (0.5, 0.2, 0.5)),
        flight,
    )
    found = SmoothTerm(
        {"3.c0": 0.0, "3.c1": 0.4}, {}, "", "tdoa", "y", "anchor", (0.0, 1.0, 2.0), "step"
    )
    (said,) = claims([finding(found)])
    assert said.names(true) and said.shape == true.shape and not said.depends_as(true)
    (said,) = claims([finding(found, (Alternative("tdoa of anchor 3 over x", 0.95, 4.0, ""),))])
    assert said.depends_as(true)


@pytest.mark.slow
def test_an_effect_of_the_bank_is_found():
    case = next(one for one in bank.cases(1) if one[:1] == ("large",))
    found = bank.diagnosed(case)
    figures = bank.figures([found])
    assert found["kind"] == "large" and found["found_rmse"] < found["before"]
    assert figures["large"]["cases"] == figures["large"]["first"] == 1


@pytest.mark.slow
def test_cases_cost_what_they_must():
    drawn = (blind.case(blind.Simulated(), seed) for seed in range(20))
    _, flown, plain, base, _ = next(one for one in drawn if one is not None)
    assert all(
        blind.rmse(one, base) - blind.rmse(none, base) >= blind.LEAST_COST
        for one, none in zip(flown, plain)
    )


def test_a_split_fits_and_judges_other_flights_of_one_day():
    several = [splits.drawn(seed) for seed in range(300)]
    assert several[7] == splits.drawn(7)
    assert {day for day, _, _ in several} == set(splits.DAYS)
    for day, fit, judge in several:
        assert fit and judge and not set(fit) & set(judge)
        assert {*fit, *judge} <= set(splits.DAYS[day])
