# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Near the ground and at rest: anchors that may be late, and a tag that does not move."""

from dataclasses import replace

from flights import corners, errors_of, fly, without_tdoas
from hypothesis import given, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
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
from uwb_tdoa_ekf.core.stationary_position import weigh_explanations
from uwb_tdoa_ekf.core.workspace import set_bounds
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import rows_of

# --- ground ---


# --- ground ---
# four at 0.15 m, four at 3.15 m
POSITIONS = np.array(corners((7.0, 8.0, 3.0)).positions) + [0.0, 0.0, 0.15]
LOW = POSITIONS[:, 2] < 1.0
PARAMETERS = FilterConfig().parameters()


def heard(p, v=(0.0, 0.0, 0.0), late=0.0, std=0.08, seed=0, seconds=0.5, n=180):
    """Return the PAIRs (k,) of a window of TDOAs of random pairs.

    The tag is at p (3,) in the middle of the window. `late` (8,) holds the delays in m.
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
    assert may_be_late(low, np.array([5.0, 0.0, 1.2]), 1.0, 0.0)  # the tag may be lower
    # The ground is higher here.
    assert may_be_late(low + [0.0, 0.0, 2.0], np.array([5.0, 0.0, 2.03]), 0.0, 2.0)


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
    # At -3.3 m the high anchor would have to be late, and that is no effect of the ground.
    assert (share >= NOT_USED) == used
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
    """Return (position (3,), standard deviations (3,), on the ground?) of a tag at rest at p.

    The start has found it `elsewhere`.
    """
    state = state or new_state(POSITIONS)
    set_bounds(state.record.extent, 1.0, state.record.workspace)
    x, covariance = np.array([*elsewhere, 0.0, 0.0, 0.0]), 0.04 * np.eye(6)
    pairs, nothing = heard(p, late=late, seed=seed), KnownHeight(np.nan, np.nan)
    lead = weigh_explanations(
        state.ekf[0], pairs, state.anchors, PARAMETERS[0], nothing, x, covariance
    )
    return x[:3], np.sqrt(np.diag(covariance)[:3]), lead > 0.0


@pytest.mark.parametrize("seed", range(5))
def test_late_low_anchors_put_it_on_the_ground_and_not_above_the_hall(seed):
    """With a free z, these TDOAs agree on a position high above the hall."""
    p = [2.5, 5.0, 0.03]
    x, std, on_ground = placed(p, [2.5, 5.0, 7.5], np.where(LOW, 3.3, 0.0), seed)
    assert on_ground and np.linalg.norm(x - p) < 0.3
    assert (np.abs(x - p) < 3.0 * std).all()


@pytest.mark.parametrize("height", [0.75, 1.5])
def test_what_stands_on_a_table_or_hovers_is_where_it_is_said_to_be_or_may_be(height):
    """With an error of 0.25 m per anchor the height is hardly known.

    Both positions are possible, and the stated deviations cover the true one.
    """
    p = [2.5, 5.0, height]
    x, std, _ = placed(p, p)
    assert (np.abs(x - p) < 3.0 * std).all() and (std < 1.2).all()


def test_a_blocked_low_anchor_does_not_lift_it():
    """One anchor is 1.9 m late at any height, as on constellation 4.

    Without a ground hypothesis, the estimate is 1.6 m too high.
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
    """Elsewhere the echoes differ from the known delays by an unknown amount."""
    floor, p = np.where(LOW, 3.4, 0.3) + 0.1 * np.arange(8), [2.5, 5.0, 0.03]
    state = new_state(POSITIONS, floor=(floor, 0.05, seen))
    late = floor if true else np.where(LOW, 2.2, 0.0)
    x, std, on_ground = placed(p, [2.5, 5.0, 7.5], late, state=state)
    assert on_ground and state.record.late_as_known == true
    assert np.linalg.norm(x - p) < (0.1 if true else 0.3) and (np.abs(x - p) < 3.0 * std).all()


# --- stationarity ---


PLACE = np.array([2.5, 5.0, 0.03])


def on_floor(seed, duration, late=3.3, shaking=0.0, lift=np.inf, back=np.inf, known=None):
    """Return a flight that stands at PLACE, rises, and comes down again.

    Parameters
    ----------
    lift, back : float
        Times at which it rises and comes down, in s. Either takes 2 s, with 0.5 m/s^2.
    late : float
        Delay of the anchors at 0.15 m while the tag is below 0.12 m, in m, approximately.
    known : (8,) array, optional
        Delays of all anchors instead, in m.
    shaking : float
        White noise of the accelerometer, in m/s^2.
    """
    low = replace(corners(), positions=np.array(corners().positions) + [0.0, 0.0, 0.15])
    flight, rng = (
        fly(seed, duration, hover=True, anchors=low, imu_rate=400.0, tdoa_rate=360.0),
        np.random.default_rng(seed),
    )

    def risen(t):
        since = np.clip(t, 0.0, 2.0)
        return np.where(
            since < 1.0, 0.25 * since**2, 0.25 + 0.5 * (since - 1.0) - 0.25 * (since - 1.0) ** 2
        )

    def at(t):
        return PLACE + np.stack([0.0 * t, 0.0 * t, risen(t - lift) - risen(t - back)], axis=1)

    def force(t):
        return np.where((t >= 0.0) & (t < 1.0), 0.5, np.where((t >= 1.0) & (t < 2.0), -0.5, 0.0))

    t, positions = flight.tdoa.t, low.positions
    a, b = low.index(flight.tdoa.a), low.index(flight.tdoa.b)
    p = at(t)
    of_anchor = np.where(
        positions[:, 2] < 1.0, late + 0.2 * rng.standard_normal(len(positions)), 0.0
    )
    of_anchor = of_anchor if known is None else known
    near = p[:, 2] < 0.12
    d = (
        tdoa(p, positions[a], positions[b])
        + 0.08 * rng.standard_normal(len(t))
        + near * (of_anchor[b] - of_anchor[a])
    )
    up = force(flight.imu.t - lift) - force(flight.imu.t - back)
    accel = (
        flight.imu.accel
        + np.stack([0.0 * up, 0.0 * up, up], axis=1)
        + shaking * rng.standard_normal((len(up), 3))
    )
    truth = replace(flight.truth, p=at(flight.truth.t))
    return replace(
        flight,
        tdoa=replace(flight.tdoa, d=d),
        imu=Imu(flight.imu.t, flight.imu.gyro, accel),
        truth=truth,
    )


def run(flight, corrector=None, **config):
    """Return (t, error (n, 3) in m, NEES (n,)) of the odometry."""
    odometry = run_offline(flight, FilterConfig(**config), corrector).odometry
    return odometry.t, *errors_of(flight, odometry)


@pytest.mark.parametrize("shaking", [0.0, 0.6])
def test_on_a_floor_where_low_anchors_are_late_it_is_right_and_honest(shaking):
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 6.0, shaking=shaking))
        assert t[0] < 0.7 and np.linalg.norm(error, axis=1).max() < 0.5
        assert nees.mean() < 9.0


@pytest.mark.parametrize("every", [20, 83])
def test_with_few_tdoas_and_a_quiet_imu_it_starts_on_the_floor_too(every):
    """Four low anchors that are 3.3 m late lifted it by 6 to 11 m, at a NEES of 7 to 20."""
    for seed in range(2):
        flight = on_floor(seed, 40.0)
        tdoas = rows_of(flight.tdoa, slice(0, None, every))
        _, error, nees = run(replace(flight, tdoa=tdoas))
        assert np.linalg.norm(error, axis=1).max() < 0.5 and nees.max() < 9.0


@pytest.mark.parametrize("margin", [5.0, 1000.0])
def test_in_a_wide_workspace_it_starts_on_the_floor_too(margin):
    """With a free z, late low anchors give a position metres above the hall.

    It is inside such a workspace.
    """
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 3.0, shaking=0.6), workspace_margin=margin)
        assert t[0] < 0.7 and np.linalg.norm(error, axis=1).max() < 0.5 and nees.mean() < 9.0


@pytest.mark.parametrize("shaking", [0.0, 0.6])
def test_it_leaves_the_floor_with_the_tag(shaking):
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 8.0, shaking=shaking, lift=3.0))
        step = np.linalg.norm(np.diff(error, axis=0), axis=1).max()
        assert np.linalg.norm(error, axis=1).max() < 0.5 and step < 0.3
        assert np.linalg.norm(error[t > 6.0], axis=1).max() < 0.25
        assert nees.mean() < 9.0


def test_it_comes_down_with_the_tag_while_rotors_still_turn():
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 12.0, shaking=0.6, lift=3.0, back=7.0))
        landed = t > 9.5
        assert np.linalg.norm(error[landed], axis=1).max() < 0.5 and nees[landed].mean() < 9.0
        assert np.linalg.norm(error[(t > 6.0) & ~landed], axis=1).max() < 0.5


def test_delays_that_are_known_of_the_floor_make_it_sharp():
    delays = np.where(
        np.array(corners().positions)[:, 2] < 1.0, 3.3, [0.0, 0.6, 0.0, 0.0] * 2
    ) + 0.05 * np.arange(8)
    values = {f"{i}.delay": delay for i, delay in zip(corners().ids, delays)} | {
        "x": PLACE[0],
        "y": PLACE[1],
    }
    for seed in range(4):
        flight = on_floor(seed, 8.0, shaking=0.6, lift=5.0, known=delays)
        corrector = Corrector(flight.anchors, EffectSet((EFFECTS["floor_multipath"](values),)))
        (t, without, _), (_, error, nees) = run(flight), run(flight, corrector)
        rest = t < 4.9
        assert np.linalg.norm(error[rest], axis=1).max() < 0.25 and nees[rest].mean() < 9.0
        assert np.sqrt(np.mean(error[rest] ** 2)) < 0.6 * np.sqrt(np.mean(without[rest] ** 2))
        assert np.linalg.norm(error[t > 7.0], axis=1).max() < 0.3


def test_a_tag_that_lies_still_stays_where_it_is_without_tdoas():
    """One second of TDOAs is followed by ten without. The test of the firmware requires 5 m."""
    for seed in range(4):
        t, error, nees = run(without_tdoas(on_floor(seed, 11.0, late=0.0), 1.0))
        assert t[-1] > 10.9 and np.linalg.norm(error, axis=1).max() < 0.5 and nees.max() < 20.0


def test_without_an_imu_it_stands_too():
    for seed in range(4):
        flight = replace(on_floor(seed, 5.0), imu=None)
        _, error, nees = run(flight, use_imu=False)
        assert np.linalg.norm(error, axis=1).max() < 0.6 and nees.mean() < 9.0


def share_at_rest(flight):
    """Return the share of time from 1 s on in which the filter considers the tag at rest."""
    estimator, resting = Estimator(flight.anchors, FilterConfig()), []
    for now in np.arange(0.1, flight.imu.t[-1], 0.1):
        for stream, add in ((flight.imu, estimator.add_imu), (flight.tdoa, estimator.add_tdoa)):
            rows = (stream.t >= now - 0.1) & (stream.t < now)
            add(*(column[rows] for column in list(vars(stream).values())[:4]))
        estimator.advance()
        if now > 1.0:
            resting.append(estimator._ekf.resting)
    return np.mean(resting)


@pytest.mark.parametrize(("tdoa_rate", "least"), [(240.0, 0.9), (120.0, 0.9), (60.0, 0.6)])
def test_a_tag_of_random_pairs_is_at_rest_too(tdoa_rate, least):
    """As in TDoA3, windows of 0.4 s contain no pair often enough.

    If such windows counted as motion, the share at rest was 0.15 with 240 TDOAs/s. If no longer
    window was looked at, it was 0 with 120.
    """
    quiet = {"tdoa_rate": tdoa_rate, "accel_noise": 0.003, "gyro_noise": 0.0005}
    at_rest = [fly(seed, 20.0, hover=True, **quiet) for seed in range(3)]
    assert np.mean([share_at_rest(flight) for flight in at_rest]) > least
    assert share_at_rest(fly(0, 20.0, **quiet)) == 0.0  # this tag flies
