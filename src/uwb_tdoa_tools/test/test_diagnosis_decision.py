"""The rule that decides which share of each effect is applied."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_tools.diagnosis.decision import LEAST_WORTH, LOSS, RISK, RULE, decide, products, risk

N = 400


def flight(rng, displacements, valid, noise=0.1):
    """The products of a flight whose error holds a part `valid` of each displacement."""
    left = rng.normal(size=(N, 3)) * noise
    error = left + sum((part - 1.0) * one for part, one in zip(valid, displacements))
    return products(error, displacements, sum(displacements))


def moved(rng, size):
    """A displacement of a given size, m."""
    return rng.normal(size=(N, 3)) * size


def decided(parts_of_flights, sizes, noise=0.1, seed=0):
    """The Decision on effects of some sizes, valid in each flight by the given parts."""
    rng = np.random.default_rng(seed)
    return decide(
        [
            flight(rng, [moved(rng, size) for size in sizes], parts, noise)
            for parts in parts_of_flights
        ]
    )


def test_an_exact_effect_is_applied_in_full_and_its_gain_is_predicted():
    found = decided([(1.0,)] * 3, [0.3])
    assert found.shares[0] > 0.95 and found.risk < 0.001
    assert found.gain == pytest.approx(1.0 - 0.1 / np.hypot(0.1, 0.3), abs=0.05)
    assert found.worth[0] == pytest.approx(np.sqrt(3) * (np.hypot(0.1, 0.3) - 0.1), rel=0.1)


def test_an_effect_of_no_flight_but_the_fitted_ones_is_dropped():
    found = decided([(0.0,)] * 3, [0.1])
    assert found.shares[0] == 0.0 and found.worth[0] < 0.0 and found.gain == 0.0


def test_a_harmful_effect_does_not_take_a_good_one_with_it():
    found = decided([(1.0, 0.0)] * 3, [0.3, 0.3])
    assert found.shares[0] > 0.9 and found.shares[1] == 0.0


def test_two_effects_that_cancel_are_kept_together():
    """Each is worth much without the other; without both nothing is lost."""
    rng = np.random.default_rng(0)
    large, small = moved(rng, 0.5), moved(rng, 0.2)
    pair = [large + small, small - large]
    found = decide([products(moved(rng, 0.05), pair, sum(pair)) for _ in range(3)])
    assert (found.shares > 0.9).all() and (found.worth > 0.7).all()


def test_flights_that_differ_leave_a_part():
    same, differing = decided([(0.6,)] * 3, [0.2]), decided([(1.6,), (0.6,), (-0.4,)], [0.2])
    assert 0.0 < differing.shares[0] <= same.shares[0] < 0.9


def test_all_shares_shrink_if_a_loss_is_probable():
    """More flights confirm more of an effect that is smaller than the remaining error."""
    alone, confirmed = decided([(1.0,)], [0.05], 0.1), decided([(1.0,)] * 8, [0.05], 0.1)
    assert 0.0 < alone.shares[0] < confirmed.shares[0]
    assert max(alone.risk, confirmed.risk) < RISK


def test_what_rounds_to_nothing_is_not_applied():
    found = decided([(1.0,)] * 3, [0.002])
    assert found.worth[0] < LEAST_WORTH and found.shares[0] == 0.0
    small = decided([(1.0,)] * 3, [0.002], 0.005)  # but of a small error it is a tenth
    assert small.worth[0] < 0.002 and small.shares[0] > 0.2


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 10_000),
    st.lists(st.lists(st.floats(-1.0, 2.0), min_size=3, max_size=3), min_size=1, max_size=5),
)
def test_the_rule_holds_whatever_the_flights_are(seed, parts):
    found = decided(parts, [0.3, 0.1, 0.03], 0.1, seed)
    assert ((found.shares >= 0.0) & (found.shares <= 1.0)).all()
    assert found.risk < RISK and found.gain >= 0.0


def test_the_gain_is_that_of_the_run_without_effects():
    """The filter rejects gross errors, so a run without an effect is better than the line says."""
    rng = np.random.default_rng(1)
    left, large = moved(rng, 0.1), moved(rng, 1.0)
    found = decide([products(left, [large], 0.3 * large) for _ in range(3)])
    decrease = np.sqrt(3) * (np.hypot(0.1, 0.3) - 0.1)
    assert found.shares[0] > 0.95
    assert found.gain == pytest.approx(decrease / (np.sqrt(3) * np.hypot(0.1, 0.3)), abs=0.05)


def test_the_probability_of_a_loss():
    assert risk(-LOSS, 0.1) == pytest.approx(0.5)
    assert risk(0.1, 0.0) == 0.0 and risk(-0.1, 0.0) == 1.0
    assert "3 %" in RULE[1] and "5 %" in RULE[1] and len(RULE) == 2
