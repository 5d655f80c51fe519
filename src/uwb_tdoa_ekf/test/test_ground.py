"""Near-ground delays: anchors that may be late, and a tag that stands."""

from flights import corners
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.ground import (
    BLUR_STD,
    BLURRED,
    MOST_PAIRS,
    NOT_USED,
    PAIR,
    STILL,
    KnownHeight,
    blur,
    find_lateness,
    find_pairs,
    in_time,
    judge_motion,
    may_be_late,
)
from uwb_tdoa_ekf.core.memory import TDOA, new_state, structured
from uwb_tdoa_ekf.core.stationary_position import weigh
from uwb_tdoa_ekf.core.workspace import set_bounds

# --- ground ---
# four at 0.15 m, four at 3.15 m
POSITIONS = np.array(corners((7.0, 8.0, 3.0)).positions) + [0.0, 0.0, 0.15]
LOW = POSITIONS[:, 2] < 1.0
PARAMETERS = FilterConfig().parameters()


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
        assert blur(hypotheses[0], ground) == pytest.approx((share * BLUR_STD) ** 2)


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

    def judged(t):
        if not find_lateness(anchors[high], anchors[low], hypothesis[0], t, 0.0):
            return 1.0
        return in_time(anchors[high], anchors[low], innovation[0])

    share = judged(0.0)
    assert (
        share >= NOT_USED
    ) == used  # -3.3: the high one would have to be late; that is no matter of the ground
    assert (anchors["late"][low] > 0.9) == (off == 3.3) and anchors["late"][high] == 0.0
    hypothesis["x"][0, 2] = 2.0
    assert judged(0.1) == 1.0 and anchors["late"][low] == 0.0


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


# --- standing ---


def placed(p, elsewhere, late=0.0, seed=0, state=None):
    """(position (3,), standard deviations (3,), on the ground?) of a tag at rest at p, if a start
    has found it `elsewhere`.
    """
    state = state or new_state(POSITIONS)
    set_bounds(state.record.extent, 1.0, state.record.workspace)
    x, covariance = np.array([*elsewhere, 0.0, 0.0, 0.0]), 0.04 * np.eye(6)
    pairs, nothing = heard(p, late=late, seed=seed), KnownHeight(np.nan, np.nan)
    lead = weigh(state.ekf[0], pairs, state.anchors, PARAMETERS[0], nothing, x, covariance)
    return x[:3], np.sqrt(np.diag(covariance)[:3]), lead > 0.0


@pytest.mark.parametrize("seed", range(5))
def test_late_low_anchors_put_it_on_the_ground_and_not_above_the_hall(seed):
    """Free in z such TDOAs agree on a place high above the hall."""
    p = [2.5, 5.0, 0.03]
    x, std, on_ground = placed(p, [2.5, 5.0, 7.5], np.where(LOW, 3.3, 0.0), seed)
    assert on_ground and np.linalg.norm(x - p) < 0.3
    assert (np.abs(x - p) < 3.0 * std).all()


@pytest.mark.parametrize("height", [0.75, 1.5])
def test_what_stands_on_a_table_or_hovers_is_where_it_is_said_to_be_or_may_be(height):
    """With a quarter of a metre of error for each anchor the height is hardly known: both places
    are possible.
    """
    p = [2.5, 5.0, height]
    x, std, _ = placed(p, p)
    assert (np.abs(x - p) < 3.0 * std).all() and (std < 1.2).all()


def test_a_blocked_low_anchor_does_not_lift_it():
    """As on constellation 4: one anchor is 1.9 m late, at any height; without the ground in mind
    the tag is put 1.6 m up.
    """
    late = np.zeros(8)
    late[np.flatnonzero(LOW)[0]] = 1.9
    p = [2.5, 5.0, 0.08]
    x, std, on_ground = placed(p, [2.5, 5.0, 1.7], late)
    assert on_ground and np.linalg.norm(x - p) < 0.25 and (np.abs(x - p) < 3.0 * std).all()


def test_where_two_explanations_are_alike_its_deviation_is_as_large_as_they_are_apart():
    p = [2.5, 5.0, 0.35]
    x, std, _ = placed(p, [2.5, 5.0, 0.5])
    assert abs(x[2] - p[2]) < 3.0 * std[2]


@pytest.mark.parametrize(
    "seen, true", [([2.5, 5.0], True), ([np.nan, np.nan], True), ([6.5, 1.0], False)]
)
def test_delays_that_are_known_count_where_they_were_seen(seen, true):
    """Elsewhere the echoes are others: there they differ by what nobody knows."""
    floor, p = np.where(LOW, 3.4, 0.3) + 0.1 * np.arange(8), [2.5, 5.0, 0.03]
    state = new_state(POSITIONS, floor=(floor, 0.05, seen))
    late = floor if true else np.where(LOW, 2.2, 0.0)
    x, std, on_ground = placed(p, [2.5, 5.0, 7.5], late, state=state)
    assert on_ground and state.record.late_as_known == true
    assert np.linalg.norm(x - p) < (0.1 if true else 0.3) and (np.abs(x - p) < 3.0 * std).all()
