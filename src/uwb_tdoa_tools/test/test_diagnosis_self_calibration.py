# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The calibration of anchors from flights alone, which all tools share.

The tests cover the conditions of its use, and `diagnose`.
"""

from dataclasses import replace

from known_effects import SPARSE, clean_flight, sparse_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, Covariance, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.diagnose import _calibrated, _Work
from uwb_tdoa_tools.diagnosis.references import Nothing
from uwb_tdoa_tools.diagnosis.report.entries import entries
from uwb_tdoa_tools.diagnosis.self_calibration import self_calibrate
from uwb_tdoa_tools.diagnosis.self_calibration.equations import Runs
from uwb_tdoa_tools.diagnosis.self_calibration.prior import with_calibration
from uwb_tdoa_tools.diagnosis.self_calibration.solve import CLEARLY, CLEARLY_OF_RANGES, LEFT
from uwb_tdoa_tools.scoring.evaluation import evaluate

DELAYS = {"1": 0.3, "4": -0.2, "6": 0.25}
LATE = EFFECTS["anchor_delay"](DELAYS)


def flight_with(*effects, seed=100, seconds=40.0, make=sparse_flight):
    flight = make(seed, seconds)
    for effect in effects:
        flight = effect.inject(flight, np.random.default_rng(0))
    return flight


def all_tdoas(seed, seconds):
    """Return a flight with all TDOAs of its protocol, and few inertial samples."""
    return clean_flight(seed, seconds, rates={**SPARSE, "tdoa_rate": None})


@pytest.fixture(scope="module")
def flights():
    """Return two flights with late anchors."""
    return [flight_with(LATE, seed=seed, make=all_tdoas) for seed in (100, 101)]


@pytest.fixture(scope="module")
def late(flights):
    """Return the self-calibration of the two flights."""
    return self_calibrate(flights)


@pytest.fixture(scope="module")
def diagnosis(flights):
    return diagnose(flights, reference=Nothing())


@pytest.mark.slow
def test_delays_of_several_anchors_are_told_well_enough_from_the_innovations_alone(late):
    assert late.why_not is None and late.explained > 0.5 and late.left < LEFT
    other = flight_with(LATE, seed=102, seconds=30.0, make=all_tdoas)
    given = EffectSet(late.found(late.shifts))
    errors = [
        evaluate(other, effects=effects)[0].row()["rmse_3d"] for effects in (EffectSet(), given)
    ]
    moved = evaluate(replace(other, anchors=late.anchors), effects=late.effects)[0].row()["rmse_3d"]
    assert errors[1] < 0.4 * errors[0] and moved == pytest.approx(
        errors[1], rel=0.02
    )  # shifts in effects.yaml give the same result as shifts in the anchors


@pytest.mark.slow
def test_who_asks_makes_no_difference(late, diagnosis):
    written = {effect.name: effect.values for effect in diagnosis.effects.effects}
    for effect in late.found(late.shifts):
        assert written[effect.name] == pytest.approx(effect.values, abs=1e-12)
    np.testing.assert_array_equal(
        diagnosis.effects.covariance.matrix, late.effects.covariance.matrix
    )


@pytest.mark.slow
def test_what_is_applied_is_found_with_its_evidence_and_the_same_in_all_flights(late, diagnosis):
    added = [finding for finding in diagnosis.findings if finding.added]
    assert [finding.effect.name for finding in added] == ["anchor_position", "anchor_delay"]
    assert added[1].evidence == pytest.approx(
        {"slow_before": late.before, "slow_left": late.left}, abs=1e-4
    )
    assert added[1].explained == late.explained
    assert "pair_offset" in [other.effect for other in added[1].alternatives]
    shares = [(one.share, one.std) for one in added[1].shares]
    assert len(shares) == 2 and all(abs(share - 1.0) < 0.3 and std < 0.2 for share, std in shares)
    assert [entry.differing for entry in entries(diagnosis)[:2]] == ["", ""]


def test_the_noise_that_the_filter_is_told_asks_for_no_functions_of_the_place():
    flight, config = flight_with(LATE), FilterConfig()
    anchors = flight.anchors
    about = anchors, np.zeros(len(anchors)), np.full(4 * len(anchors), 0.1)
    with_all, alone = (
        Runs([flight], EffectSet(), config).equations(*about, functions=functions)
        for functions in (True, False)
    )
    n = len(alone.vector)
    assert n == 4 * len(anchors) < len(with_all.vector)
    np.testing.assert_allclose(alone.gram, with_all.gram[:n, :n], rtol=1e-9, atol=1e-6)
    assert alone.tdoa_std(config) == pytest.approx(with_all.tdoa_std(config), rel=1e-9)


@pytest.mark.slow
def test_a_delay_of_one_flight_is_no_delay_of_the_other():
    short = {"seconds": 28.0, "make": all_tdoas}
    found = self_calibrate([flight_with(LATE, **short), flight_with(seed=101, **short)])
    one, other = (share.share for share in found.shares["anchor_delay"])
    assert one - other > 1.0


def why_not_of(flight):
    """Return the reason why `diagnose` does not apply the self-calibration of a flight."""
    reference = Nothing()
    return _calibrated(
        _Work(reference, EffectSet(), None, lambda what: None, map),
        (reference.prepare(flight),),
        EffectSet(),
    )


@pytest.mark.slow
def test_nothing_is_a_finding_in_a_flight_of_which_nothing_is_wrong():
    assert "of what is slow in the innovations" in why_not_of(flight_with())


def test_flights_that_are_too_short_say_so():
    assert why_not_of(flight_with(LATE, seconds=20.0)).endswith(
        "30 s are needed: record motion for longer"
    )


@pytest.mark.slow
def test_nothing_is_applied_if_something_else_is_wrong_too():
    blocked = {"2.x": 1.0, "2.y": 0.0, "2.z": 1.0, "2.radius": 1.5, "2.delay": 1.5}
    other = EFFECTS["nlos"](blocked), LATE, EFFECTS["noise_correlation"]({"std": 0.2, "time": 1.0})
    assert "something else is wrong too" in why_not_of(flight_with(*other))


@pytest.mark.slow
@pytest.mark.parametrize("ratio, applied", [(0.95, False), (1.05, True)])
def test_slow_errors_of_ranges_ask_for_a_smaller_fall(late, ratio, applied):
    """The rule for ranges does not depend on the size of the remaining errors.

    For TDOAs, this size decides.
    """
    for left in (0.5 * LEFT, 2.0 * LEFT):
        before = ratio * CLEARLY_OF_RANGES * left
        found = replace(late, before=before, left=left, marks=None)
        assert (found.why_not is None) == (left < LEFT)
        assert (replace(found, tdoa_std=None).why_not is None) == applied


@pytest.mark.slow
@pytest.mark.parametrize(
    "before, left, marks, applied",
    [
        (0.1, 0.9 * LEFT, None, True),
        (0.1, 1.1 * LEFT, None, False),
        # the tape error was larger than the remaining errors
        (1.2 * CLEARLY * LEFT, 1.1 * LEFT, None, True),
        (0.1, 1.1 * LEFT, (0.2, 0.1, 0.8), True),  # the marks decide
        (0.1, 0.9 * LEFT, (0.2, 0.1, 0.7), False),
        (0.1, 0.9 * LEFT, (0.1, 0.2, 0.8), False),
    ],
)
def test_one_rule_says_whether_it_is_applied(late, before, left, marks, applied):
    found = replace(late, before=before, left=left, marks=marks)
    assert (found.why_not is None) == applied
    assert (
        found.anchors is (found.surveyed if applied else found.given)
        and len(found.effects) == 2 * applied
    )


def test_what_is_found_is_added_to_what_was_known():
    known = Covariance((("anchor_delay", "1"),), np.eye(1))
    base = EffectSet((AnchorDelay({"1": 0.1, "2": 0.2}, {"1": 0.01, "2": 0.01}),), known)
    found = (
        AnchorPosition({"1.x": 0.5}, {"1.x": 0.1}),
        AnchorDelay({"1": 0.05, "3": 0.3}, {"1": 0.02, "3": 0.02}),
    )
    delay, position = with_calibration(base, found, None).effects
    assert delay.values == pytest.approx({"1": 0.15, "2": 0.2, "3": 0.3}) and delay.std == {
        "1": 0.02,
        "2": 0.01,
        "3": 0.02,
    }
    assert (
        position.values == {"1.x": 0.5} and with_calibration(base, found, None).covariance is known
    )
