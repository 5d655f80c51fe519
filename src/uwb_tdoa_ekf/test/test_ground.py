from flights import corners
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.compiled import compiled
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.ground import (
    ALIKE,
    BLUR_STD,
    BLURRED,
    IN_TIME,
    KNOWN,
    MOST_PAIRS,
    NOT_USED,
    PAIR,
    STILL,
    Evidence,
    KnownHeight,
    blur,
    explain,
    find_lateness,
    find_pairs,
    in_time,
    judge_motion,
    may_be_late,
)
from uwb_tdoa_ekf.core.memory import TDOA, new_state, structured
from uwb_tdoa_ekf.core.workspace import set_bounds

POSITIONS = np.array(corners((7.0, 8.0, 3.0)).positions) + [
    0.0,
    0.0,
    0.15,
]  # four at 0.15 m, four at 3.15 m
LOW = POSITIONS[:, 2] < 1.0
PARAMETERS = FilterConfig().parameters()


@compiled
def explained(pairs, anchors, bounds, prior, parameters, z, z_std, lateness, x, covariance):
    return explain(
        Evidence(pairs, anchors, bounds, prior, parameters[0]),
        KnownHeight(z, z_std),
        lateness,
        x,
        covariance,
    )


@compiled
def blurred(hypotheses, ground):
    return blur(hypotheses[0], ground)


@compiled
def judged(anchors, i, j, hypothesis, innovation, t):
    if not find_lateness(anchors[i], anchors[j], hypothesis[0], t, 0.0):
        return 1.0
    return in_time(anchors[i], anchors[j], innovation[0])


def heard(p, v=(0.0, 0.0, 0.0), late=0.0, std=0.08, seed=0, seconds=0.5, n=180):
    """(k,) of PAIR in a window of random pairs, of a tag that is at p (3,) in its middle; late (8,)
    m.
    """
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0.0, seconds, n))
    a = rng.integers(0, 8, n)
    b = (a + rng.integers(1, 8, n)) % 8
    late = np.broadcast_to(late, 8)
    d = (
        tdoa(np.array(p) + (t - 0.5 * seconds)[:, None] * v, POSITIONS[a], POSITIONS[b])
        + late[b]
        - late[a]
    )
    pairs = np.zeros(MOST_PAIRS, PAIR)
    return pairs[: find_pairs(structured(TDOA, t, a, b, d + std * rng.standard_normal(n)), pairs)]


def still(pairs, p):
    return judge_motion(pairs, new_state(POSITIONS).anchors, np.array(p), np.empty((3, 3))) == STILL


def test_anchors_may_be_late_where_both_antennas_are_low_and_far_apart():
    low, high = np.array([0.0, 0.0, 0.18]), np.array([0.0, 0.0, 3.0])
    assert may_be_late(low, np.array([5.0, 0.0, 0.03]), 0.0, 0.0)
    assert not may_be_late(high, np.array([5.0, 0.0, 0.03]), 0.0, 0.0)
    assert not may_be_late(low, np.array([5.0, 0.0, 1.2]), 0.0, 0.0)
    assert not may_be_late(low, np.array([0.3, 0.0, 0.03]), 0.0, 0.0)  # steep
    assert may_be_late(low, np.array([5.0, 0.0, 1.2]), 1.0, 0.0)  # it may be lower
    assert may_be_late(
        low + [0.0, 0.0, 2.0], np.array([5.0, 0.0, 2.03]), 0.0, 2.0
    )  # over another ground


def test_tdoas_are_noisier_near_the_ground_and_nowhere_else():
    hypotheses = new_state(POSITIONS).ekf["hypotheses"][0]
    for z, ground, share in (
        (-0.1, 0.0, 1.0),
        (0.0, 0.0, 1.0),
        (0.5 * BLURRED, 0.0, 0.5),
        (BLURRED, 0.0, 0.0),
        (3.0, 0.0, 0.0),
        (3.0, 3.0, 1.0),
    ):
        hypotheses["x"][0, 2] = z
        assert blurred(hypotheses, ground) == pytest.approx((share * BLUR_STD) ** 2)


@given(st.floats(0.0, 3.0), st.floats(0.0, 3.0), st.floats(0.5, 50.0), st.floats(0.0, 1.0))
def test_what_may_be_late_may_be_late_from_lower_too(tag, anchor, distance, less):
    x, position = np.array([distance, 0.0, tag]), np.array([0.0, 0.0, anchor])
    if may_be_late(position, x, 0.0, 0.0):
        assert may_be_late(position, x * [1.0, 1.0, less], 0.0, 0.0)


@pytest.mark.parametrize(
    "off, used", [(0.0, True), (0.2, True), (3.3, False), (-3.3, True), (0.5, True)]
)
def test_a_tdoa_of_a_late_anchor_says_nothing_and_no_other_is_doubted(off, used):
    state = new_state(POSITIONS)
    anchors, ekf = state.anchors, state.record
    low, high = np.flatnonzero(LOW)[0], np.flatnonzero(~LOW)[0]
    hypothesis, innovation = state.ekf["hypotheses"][0], np.zeros(1, ekf.innovation.dtype)
    hypothesis["x"][0, :3] = [3.5, 4.0, 0.03]
    hypothesis["P"][0, 2, 2] = 0.01
    innovation["value"], innovation["prior_variance"], innovation["noise_variance"] = (
        off,
        0.05,
        0.0625,
    )
    share = judged(anchors, high, low, hypothesis, innovation, 0.0)
    assert (
        share >= NOT_USED
    ) == used  # -3.3: the high one would have to be late; that is no matter of the ground
    assert (anchors["late"][low] > 0.9) == (off == 3.3) and anchors["late"][high] == 0.0
    hypothesis["x"][0, 2] = 2.0
    assert (
        judged(anchors, high, low, hypothesis, innovation, 0.1) == 1.0
        and anchors["late"][low] == 0.0
    )


def test_a_tag_whose_anchors_are_late_is_still_and_one_that_moves_is_not():
    late = np.where(LOW, 3.3, 0.0)
    found = [
        still(heard([2.0, 5.0, 0.05], late=late, seed=seed), [2.0, 5.0, 0.05]) for seed in range(20)
    ]
    assert np.mean(found) > 0.9
    found = [
        still(heard([2.0, 5.0, 1.0], [0.8, 0.0, 0.0], seed=seed), [2.0, 5.0, 1.0])
        for seed in range(20)
    ]
    assert np.mean(found) < 0.1


def test_a_pair_is_one_in_either_order_and_its_value_that_of_the_first():
    tdoas = structured(
        TDOA, *np.array([[0.0, 0.1, 0.2, 0.3], [0, 1, 0, 1], [1, 0, 1, 0], [1.0, -1.2, 1.2, -1.0]])
    )
    pairs = np.zeros(MOST_PAIRS, PAIR)
    assert find_pairs(tdoas, pairs) == 1
    assert (pairs[0]["a"], pairs[0]["b"]) == (0, 1) and pairs[0]["value"] == pytest.approx(1.1)
    assert pairs[0]["change"] == pytest.approx(0.0, abs=1e-12) and pairs[0][
        "apart"
    ] == pytest.approx(0.2)


@pytest.mark.parametrize("late", [0.0, 3.3])
def test_on_the_ground_it_is_found_whether_or_not_anchors_are_late(late):
    state, bounds, prior = new_state(POSITIONS), np.empty((2, 3)), np.zeros((4, 3))
    anchors = state.anchors
    set_bounds(state.record.extent, 1.0, bounds)
    prior[0], prior[1:] = bounds.mean(axis=0), np.eye(3) / 25.0
    for seed in range(10):
        p = np.array([*np.random.default_rng(seed).uniform([1.5, 1.5], [5.5, 6.5]), 0.03])
        each = (
            np.where(LOW, late + 0.2 * np.random.default_rng(seed).standard_normal(8), 0.0)
            if late
            else 0.0
        )
        x, covariance = np.array([3.5, 4.0, 0.05]), np.empty((3, 3))
        lateness = ALIKE if late else IN_TIME
        cost = explained(
            heard(p, late=each, seed=seed),
            anchors,
            bounds,
            prior,
            PARAMETERS,
            0.05,
            0.15,
            lateness,
            x,
            covariance,
        )
        assert np.isfinite(cost) and np.linalg.norm(x - p) < 0.25
        assert (np.linalg.eigvalsh(covariance) > 0.0).all()


def test_what_is_known_of_late_anchors_places_it_better_than_what_they_have_in_common():
    floor = np.where(LOW, 3.4, 0.3) + 0.1 * np.arange(8)
    state, bounds, prior = (
        new_state(POSITIONS, floor=(floor, 0.05, np.nan)),
        np.empty((2, 3)),
        np.zeros((4, 3)),
    )
    set_bounds(state.record.extent, 1.0, bounds)
    prior[0], prior[1:] = bounds.mean(axis=0), np.eye(3) / 25.0
    off = {ALIKE: [], KNOWN: []}
    for seed in range(10):
        p, covariance = (
            np.array([*np.random.default_rng(seed).uniform([1.5, 1.5], [5.5, 6.5]), 0.03]),
            np.empty((3, 3)),
        )
        pairs = heard(p, late=floor, seed=seed)
        for lateness, each in off.items():
            x = np.array([3.5, 4.0, 0.05])
            explained(
                pairs, state.anchors, bounds, prior, PARAMETERS, 0.05, 0.15, lateness, x, covariance
            )
            each.append(np.linalg.norm(x - p))
        assert off[KNOWN][-1] < 0.1
    assert np.mean(off[KNOWN]) < 0.5 * np.mean(off[ALIKE])
