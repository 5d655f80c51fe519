# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parts of the filter core, compared with their documented computations."""

from dataclasses import replace

from covariances import assert_covariance, random_covariance
from finite_differences import numerical_jacobian
from flights import corners, errors_of, fly, rms_error
from hypothesis import given, settings, strategies as st
import numpy as np
from priors import Prior, kalman as textbook, with_offset
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Tdoas
from uwb_tdoa_bias.common.geometry import tdoa, tdoa_jacobian
from uwb_tdoa_bias.common.robust_loss import LOSSES, weight
from uwb_tdoa_ekf.core import noise
from uwb_tdoa_ekf.core.auxiliary import PRESSURE, RANGE, add_offset_jacobian
from uwb_tdoa_ekf.core.config import PARAMETERS, ROBUST, FilterConfig
from uwb_tdoa_ekf.core.inertial import (
    LEAST_RECTIFIED,
    PERSISTENCE,
    QUIET_NOISE,
    SHAKING_MEMORY,
    is_quiet,
    observe,
    store,
    weigh as weigh_axes,
)
from uwb_tdoa_ekf.core.memory import (
    FARTHEST,
    IMU_SAMPLE,
    LARGEST_ERROR,
    STEEPEST,
    TDOA,
    new_state,
    structured,
    usable_tdoas,
)
from uwb_tdoa_ekf.core.noise import learn
from uwb_tdoa_ekf.core.state import GRAVITY, coast, exponential, inject, predict, rotation, turn
from uwb_tdoa_ekf.core.update import (
    LONGEST_ROW,
    NEGLIGIBLE,
    SMALLEST,
    SMALLEST_WEIGHT,
    kalman,
    kalman_direct,
    second_order_variance,
    weigh,
)
from uwb_tdoa_ekf.core.workspace import (
    SMALLEST as WORKSPACE_SMALLEST,
    STD as WORKSPACE_STD,
    add_circle,
    admits,
    constrain,
    listen,
    set_bounds,
)
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import rotation_std, to_odometry

# --- core ---

# --- measurements ---


POSITIONS = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 2.0]])
CASES = [
    (0, 1, 0.0, 0.0, True),
    (0, 1, 5.0, 0.0, True),  # right behind anchor 0
    (0, 1, 5.0 + LARGEST_ERROR, 0.0, True),
    (0, 1, -5.0 - LARGEST_ERROR, 0.0, True),
    (0, 1, 5.001 + LARGEST_ERROR, 0.0, False),  # impossible at any position
    (1, 0, -5.001 - LARGEST_ERROR, 0.0, False),
    (0, 2, 5.0, 0.0, False),
    (0, 0, 0.0, 0.0, False),
    (-1, 1, 0.0, 0.0, False),
    (1, -1, 0.0, 0.0, False),
    (-1, -1, 0.0, 0.0, False),
    (0, 1, np.nan, 0.0, False),
    (0, 1, np.inf, 0.0, False),
    (0, 1, -np.inf, 0.0, False),
    (0, 1, 0.0, np.nan, False),
    (0, 1, 0.0, np.inf, False),
    (0, 1, 0.0, -0.1, False),
    (0, 1, 0.0, 0.3, True),
]


def test_a_tdoa_that_cannot_be_a_measurement_is_not_usable():
    a, b, d, variance, expected = (np.array(column) for column in zip(*CASES))
    rows = structured(TDOA, np.zeros(len(d)), a, b, d, variance)
    assert usable_tdoas(rows, POSITIONS).tolist() == expected.tolist()


@pytest.mark.parametrize(
    "slope, state, expected",
    [
        (0.0, 0.0, True),
        (-0.99 * STEEPEST, -0.99 * FARTHEST, True),
        (STEEPEST, 0.0, False),
        (0.0, FARTHEST, False),
        (np.nan, 0.0, False),
        (0.0, np.nan, False),
        (-np.inf, 0.0, False),
        (0.0, np.inf, False),
    ],
)
def test_a_tdoa_with_an_absurd_slope_is_not_usable(slope, state, expected):
    rows = structured(TDOA, np.zeros(3), np.zeros(3), np.ones(3))
    rows["slope"][1, 5], rows["state"][1, 0] = slope, state
    assert usable_tdoas(rows, POSITIONS).tolist() == [True, expected, True]


# --- curvature ---


A, B = np.array([0.0, -3.0, 1.0]), np.array([1.0, 4.0, 2.0])


@pytest.mark.parametrize("x", [[2.0, 0.0, 1.5], [-3.0, 1.0, 0.3]])
def test_it_is_the_mean_square_of_what_the_slope_leaves_out(x):
    x, rng = np.array(x), np.random.default_rng(0)
    P = np.zeros((15, 15))
    P[:3, :3] = np.diag([0.5, 0.1, 0.4]) ** 2
    e = rng.standard_normal((200_000, 3)) * np.sqrt(np.diag(P)[:3])
    left = tdoa(x + e, A, B) - tdoa(x, A, B) - e @ np.ravel(tdoa_jacobian(x, A, B))
    assert second_order_variance(x, P, A, B) == pytest.approx(np.mean(left**2), rel=0.25)


def test_it_is_not_asked_for_where_the_place_is_known_and_finite_at_an_anchor():
    P = np.eye(15) * (0.9 * SMALLEST) ** 2 / 3.0
    assert second_order_variance(np.array([2.0, 0.0, 1.5]), P, A, B) == 0.0
    assert np.isfinite(second_order_variance(A.copy(), np.eye(15), A, B))


# --- noise ---


def taught(std, noise, seconds=20.0, seed=0):
    """Return the excess variances after TDOAs at 400 Hz.

    `noise` (N,) holds the standard deviations of the anchors, in m.
    """
    rng, n = np.random.default_rng(seed), len(noise)
    state, parameters = new_state(np.zeros((n, 3))), FilterConfig(tdoa_std=std).parameters()[0]
    anchors, innovation, sampled = state.anchors, state.record.innovation, []
    for k in range(int(400 * seconds)):
        a = rng.integers(n)
        b = (a + 1 + rng.integers(n - 1)) % n
        innovation.value = rng.standard_normal() * np.hypot(noise[a], noise[b])
        excess = anchors["excess_variance"][[a, b]].sum()
        innovation.noise_variance = std**2 + excess
        learn(anchors[a], anchors[b], k / 400.0, innovation, parameters)
        sampled.append(anchors["excess_variance"].copy())
    return np.mean(sampled[len(sampled) // 2 :], axis=0)


def test_the_noisy_anchor_is_found():
    noise = np.full(6, 0.1 / np.sqrt(2.0))
    noise[2] = 0.6
    learned = taught(0.1, noise)
    assert learned[2] == pytest.approx(0.6**2, rel=0.3)
    assert np.delete(learned, 2).max() < 0.1 * learned[2]


def test_what_is_as_noisy_as_expected_has_no_excess():
    learned = taught(0.25, np.full(6, 0.25 / np.sqrt(2.0)))
    assert learned.max() < 0.5 * 0.25**2


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50), st.floats(0.0, 1e3))
def test_variances_stay_finite_and_not_negative(values, prior_variance):
    state, parameters = new_state(np.zeros((3, 3))), FilterConfig(tdoa_std=0.1).parameters()[0]
    innovation, innovation.prior_variance = state.record.innovation, prior_variance
    for k, value in enumerate(values):
        a, b = state.anchors[k % 3], state.anchors[(k + 1) % 3]
        innovation.value = value
        innovation.noise_variance = 0.01 + a["excess_variance"] + b["excess_variance"]
        learn(a, b, 0.01 * k, innovation, parameters)
        learned = state.anchors["excess_variance"]
        assert np.isfinite(learned).all() and (learned >= 0.0).all()


def test_an_anchor_that_is_late_for_a_while_disturbs_less():
    """Anchor 3 is a metre late in every pair, for one second in three, as behind an obstacle."""
    errors = {}
    for adapt in (False, True):
        found = []
        for seed in range(4):
            flight = fly(seed, 12.0, tdoa_std=0.05, accel_noise=0.05, gyro_noise=0.003)
            late = np.where((flight.tdoa.t % 3.0) < 1.0, 1.0, 0.0)
            three = corners().ids[3]
            d = flight.tdoa.d + late * (
                (flight.tdoa.b == three).astype(float) - (flight.tdoa.a == three)
            )
            result = run_offline(
                replace(flight, tdoa=replace(flight.tdoa, d=d)), FilterConfig(adapt_noise=adapt)
            )
            found.append(rms_error(flight, result.odometry))
        errors[adapt] = np.mean(found)
    assert errors[True] < 0.9 * errors[False]


# --- systematic ---


ANCHORS = np.array([[x, y, z] for x in (0.0, 7.0) for y in (0.0, 8.0) for z in (0.2, 3.0)])
STD = 0.25


def informed(p, seconds=5.0, rate=400.0, heard=range(8), state=None, begin=0.0):
    """Return a FilterState after TDOAs round the ring of anchors `heard`, at p (3,)."""
    state, heard = state or new_state(ANCHORS), list(heard)
    anchors, information = state.anchors, state.record.information
    way = np.array(p) - ANCHORS
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    for k in range(int(seconds * rate)):
        a, b = heard[k % len(heard)], heard[(k + 1) % len(heard)]
        innovation = state.record.innovation
        innovation.row[:3] = unit[b] - unit[a]
        innovation.noise_variance, innovation.weight, innovation.curvature = STD**2, 1.0, 0.0
        t = begin + k / rate
        previous = t - 1.0 / rate if k else -np.inf
        noise.observe(information, anchors[a], anchors[b], innovation, t, previous)
    return state


def stated(state, P, share=noise.SHARE, height_std=0.0, width=np.inf):
    covariance = np.full((3, 3), np.nan)
    whole = np.zeros((15, 15))
    whole[:3, :3] = P
    bounds = np.array([[0.0] * 3, [width] * 3])
    noise.fill(state.record.information, whole, share, height_std, bounds, covariance)
    return covariance


@pytest.mark.parametrize("p", [[3.0, 4.0, 1.5], [1.0, 6.0, 0.5]])
def test_it_is_the_covariance_of_a_position_by_one_arrival_from_each_anchor(p):
    """The reference is least squares with an error per anchor and a common clock error."""
    way = np.array(p) - ANCHORS
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    centred = unit - unit.mean(axis=0)
    of_anchor = noise.SHARE * STD**2 / 2.0
    expected = np.linalg.inv(centred.T @ centred) * of_anchor
    # A ring of neighbours weighs directions a little differently from all pairs.
    found = stated(informed(p), 1e3 * np.eye(3))
    assert 0.4 < np.trace(found) / np.trace(expected) < 2.5


def test_it_does_not_become_less_with_more_tdoas():
    slow, quick = (
        np.trace(stated(informed([3.0, 4.0, 1.5], rate=rate), np.eye(3))) for rate in (50.0, 800.0)
    )
    assert slow == pytest.approx(quick, rel=0.2)


def test_what_is_not_heard_any_more_is_forgotten_but_silence_is_not_taken_for_that():
    state, P = informed([3.0, 4.0, 1.5]), 0.01 * np.eye(3)
    before = np.trace(stated(state, P))
    informed([3.0, 4.0, 1.5], 0.01, state=state, begin=30.0)
    assert np.trace(stated(state, P)) < 2.0 * before
    informed([3.0, 4.0, 1.5], 5.0, heard=(0, 1), state=state, begin=31.0)
    assert np.trace(stated(state, P)) > 5.0 * before


def test_of_white_noise_nothing_persists():
    state, P = informed([3.0, 4.0, 1.5]), np.eye(3)
    assert not stated(state, P, 0.0).any()
    assert 0.5 < np.trace(stated(state, P, 0.8 * noise.SHARE)) / np.trace(stated(state, P)) < 1.0


def test_it_is_bounded_by_what_the_filter_knows():
    P = np.diag([0.01, 0.02, 0.03])
    state = new_state(ANCHORS)
    np.testing.assert_allclose(stated(state, P), noise.MOST * P, rtol=1e-9)
    assert not stated(state, np.zeros((3, 3))).any()


def test_it_is_bounded_by_the_workspace():
    """Without anchors nothing but the workspace bounds the persisting errors."""
    P, width = 1e6 * np.eye(3), 6.0
    assert stated(new_state(ANCHORS), P, width=width) == pytest.approx(
        width**2 * np.eye(3), rel=1e-3
    )


@pytest.mark.parametrize("p", [[3.0, 4.0, 0.2], [1.0, 6.0, 0.5]])
def test_a_height_that_is_held_does_not_follow_errors_that_persist(p):
    """With an exact height, only x and y are free: the covariance of a two-dimensional problem."""
    state, P = informed(p), 1e6 * np.eye(3)
    plain, held, loose = (stated(state, P, height_std=std) for std in (0.0, 1e-4, 1e4))
    information = np.linalg.inv(plain)
    np.testing.assert_allclose(held[:2, :2], np.linalg.inv(information[:2, :2]), rtol=1e-4)
    assert held[2, 2] < 1e-8 < 0.01 < plain[2, 2]
    np.testing.assert_allclose(loose, plain, rtol=1e-4)
    assert np.linalg.eigvalsh(held).min() >= -1e-12


# --- workspace ---


MARGIN = 1.0  # m


def bounds_of(positions):
    bounds = np.empty((2, 3))
    set_bounds(new_state(positions).record.extent, MARGIN, bounds)
    return bounds


def test_it_ends_a_margin_beyond_the_anchors_and_is_never_flat():
    positions = np.array(corners().positions)
    bounds = bounds_of(positions)
    middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    half = np.array([3.5 + MARGIN, 4.0 + MARGIN, WORKSPACE_SMALLEST])
    np.testing.assert_allclose(bounds, [middle - half, middle + half])
    for k in range(3):
        x = middle.copy()
        x[k] += half[k] - 0.01
        assert admits(bounds, x, np.eye(3))
        x[k] += 0.02
        assert not admits(bounds, x, np.eye(3))


@pytest.mark.parametrize(
    ("off", "std", "admitted"),
    [
        ((4.0, 0.0, 0.0), 2.0, True),
        ((4.0, 0.0, 0.0), 3.0, False),
        ((0.0, -0.3, 0.0), 0.1, True),
        ((0.0, 0.0, 8.0), 0.1, False),
        ((4.0, 0.0, 8.0), 0.1, False),
        ((np.nan, 0.0, 0.0), 0.1, False),
    ],
)
def test_tdoas_may_place_a_tag_beside_the_workspace_but_not_above_it(off, std, admitted):
    bounds = bounds_of(np.array(corners().positions))
    x = np.where(np.array(off) < 0.0, bounds[0], bounds[1]) + off
    x[np.array(off) == 0.0] = 1.0
    assert admits(bounds, x, std**2 * np.eye(3)) == admitted


@pytest.mark.parametrize(
    ("axis", "off", "std"), [(0, -2.0, 4.0), (1, 0.7, 2.0), (2, 5.0, 1.8), (2, -0.4, 1.1)]
)
def test_a_tag_outside_is_drawn_back_by_as_much_as_it_is_uncertain(axis, off, std):
    """Beside the anchors the prior is as wide as the tag is far away, above and below it is not."""
    before, after = drawn_back(axis, off, std)
    gain = std**2 / (std**2 + (WORKSPACE_STD + (abs(off) if axis < 2 else 0.0)) ** 2)
    assert after.x[axis] == pytest.approx(before[axis] - gain * off)
    assert after.P[axis, axis] == pytest.approx((1.0 - gain) * std**2)
    assert np.delete(after.x, axis) == pytest.approx(np.delete(before, axis))


@pytest.mark.parametrize(
    ("axis", "off", "std"), [(0, 10.0, 5.0), (1, -3.0, 3.9), (2, 0.5, 0.9), (0, -0.1, 1.0)]
)
def test_a_tag_that_tdoas_place_outside_is_outside(axis, off, std):
    before, after = drawn_back(axis, off, std)
    np.testing.assert_array_equal(after.x, before)
    assert after.P[axis, axis] == std**2


def test_a_tag_inside_is_as_uncertain_as_the_workspace_is_wide_at_most():
    positions = np.array(corners().positions)
    bounds, ekf = bounds_of(positions), new_state(positions).record
    middle, width = 0.5 * (bounds[0] + bounds[1]), bounds[1] - bounds[0]
    hypothesis = ekf.hypotheses[0]
    hypothesis.x[:3] = middle + 0.4 * width
    hypothesis.P[:3, :3] = np.diag([100.0, 0.9, 1.1] * width) ** 2
    changed = [constrain(hypothesis, ekf.innovation, bounds, k) for k in range(3)]
    assert changed == [True, False, True]
    share = 1.0 / (1.0 + np.array([100.0, np.inf, 1.1]) ** 2)
    share[1] = 1.0
    assert hypothesis.x[:3] == pytest.approx(middle + share * 0.4 * width)
    assert np.diag(hypothesis.P)[[0, 2]] == pytest.approx(
        (1.0 - share[[0, 2]]) * width[[0, 2]] ** 2
    )
    assert hypothesis.P[1, 1] == (0.9 * width[1]) ** 2


@pytest.mark.parametrize("rate", [27.0, 80.0])
def test_a_trolley_just_below_the_plane_of_its_anchors_is_not_lost(rate):
    """TDOAs do not show the height of such a tag; its uncertainty must not cost the others."""
    angles = np.arange(8) * np.pi / 4.0 + 0.1
    ring = np.column_stack([4.2 * np.cos(angles), 3.6 * np.sin(angles), np.full(8, 1.28)])
    anchors, off = Anchors.from_positions(ring), []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        t = np.arange(0.01, 40.0, 1.0 / rate)
        p = np.column_stack([2.2 * np.sin(0.36 * t + seed), 2.0 * np.sin(0.28 * t), 0.0 * t + 1.2])
        a = rng.integers(0, 8, len(t))
        b = (a + rng.integers(1, 8, len(t))) % 8
        d = tdoa(p, ring[a], ring[b]) + 0.1 * rng.standard_normal(len(t))
        late = 0.08 * rng.standard_normal(8)
        flight = Flight(
            "trolley", anchors, Tdoas(t, anchors.ids[a], anchors.ids[b], d + late[b] - late[a])
        )
        odometry = run_offline(flight, FilterConfig(use_imu=False)).odometry
        settled = odometry.t > 5.0
        error = odometry.p[settled] - p[np.searchsorted(t, odometry.t[settled])]
        off.append(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))))
        assert np.sqrt(odometry.covariance[settled, 2, 2].max()) < 10.0
    assert max(off) < 0.6


def drawn_back(axis, off, std):
    """Return the state before and the HYPOTHESIS after the prior, for a tag outside on an axis."""
    positions = np.array(corners().positions)
    bounds, ekf = bounds_of(positions), new_state(positions).record
    hypothesis = ekf.hypotheses[0]
    hypothesis.x[:3] = 0.5 * (bounds[0] + bounds[1])
    hypothesis.x[axis] = bounds[int(off > 0.0), axis] + off
    hypothesis.P[axis, axis] = std**2
    before = hypothesis.x.copy()
    for k in range(3):
        changed = constrain(hypothesis, ekf.innovation, bounds, k)
        assert changed == (hypothesis.x[k] != before[k])
    return before, hypothesis


@pytest.mark.parametrize("beyond", [1.0, 3.0])
def test_a_tag_outside_is_right_or_says_how_wrong_it_is(beyond):
    found = []
    for seed in range(5):
        flight = fly(seed, 6.0, hover=True, anchors=corners((8.0, 8.0, 3.0)), tdoa_rate=300.0)
        p = np.array([8.0 + MARGIN + beyond, 3.0, 1.2])
        flight.truth.p[:] = p
        a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
        d = tdoa(p, flight.anchors.positions[a], flight.anchors.positions[b])
        d += 0.1 * np.random.default_rng(seed).standard_normal(len(d))
        odometry = run_offline(replace(flight, tdoa=replace(flight.tdoa, d=d))).odometry
        found.append(errors_of(flight, odometry, 3.0)[1].mean())
    assert np.mean(found) < 6.0


# --- inertial ---


UP = np.array([0.0, 0.0, GRAVITY])


def sample_of(t, gyro, accel):
    return np.array([(t, tuple(gyro), tuple(accel))], IMU_SAMPLE)[0]


def fresh():
    return new_state(np.zeros((4, 3))).record.imu


def after(gyro, accel, rate=1000.0, seconds=3.0, imu=None, pause=0.0, seed=0):
    """Return IMU_STATE after a stream of samples; gyro, accel: (mean (3,), standard deviation)."""
    imu, rng = fresh() if imu is None else imu, np.random.default_rng(seed)
    start = max(imu.t, 0.0) + pause
    for k in range(int(rate * seconds)):
        rates, accels = (
            np.asarray(mean) + std * rng.standard_normal(3) for mean, std in (gyro, accel)
        )
        sample = sample_of(start + (k + 1) / rate, rates, accels)
        observe(imu, sample, 0.1)
        store(imu, sample)
    return imu


STILL = dict(gyro=(np.zeros(3), 0.002), accel=(UP, 0.02))


@pytest.mark.parametrize(
    "change, rests",
    [
        ({}, True),
        ({"gyro": (np.zeros(3), 0.05)}, False),
        ({"gyro": (np.array([0.0, 0.0, 0.1]), 0.002)}, False),
        ({"accel": (UP, 0.3)}, False),
        # 1 m/s^2 sideways is a tilt of 6 degrees.
        ({"accel": (UP + [1.0, 0.0, 0.0], 0.02)}, True),
        ({"accel": (1.1 * UP, 0.02)}, False),
    ],
)
def test_rest(change, rests):
    assert is_quiet(after(**{**STILL, **change})) == rests


def test_rest_is_not_believed_at_once_nor_after_a_gap():
    imu = after(**STILL, seconds=0.3)
    assert not is_quiet(imu)
    imu = after(**STILL, imu=imu)
    assert is_quiet(imu)
    assert not is_quiet(after(**STILL, imu=imu, pause=1.0, seconds=0.3))


def test_a_rate_beyond_the_range_of_the_gyroscope_is_noisy():
    """The limit is repeated; a fast turn that goes on rising, or a slow constant one, is not."""
    imu, rates = fresh(), [1.0, 1.0, 4.0, 5.0, 6.0, 6.0, 6.0, 4.0]
    noisy = []
    for k, rate in enumerate(rates):
        sample = sample_of(0.002 * k, (0.0, 0.0, -rate), UP)
        observe(imu, sample, 0.1)
        store(imu, sample)
        noisy.append(imu.gyro_psd[2] > 0.0)
        assert imu.gyro_psd[0] == 0.0
    assert noisy == [False, False, False, False, False, True, True, False]


def test_the_more_an_axis_rectifies_the_less_it_weighs_and_the_noisier_it_is():
    vibration = np.array([0.0, 0.5, 5.0])
    imu = after((np.zeros(3), 0.0), (UP + vibration, vibration))
    weigh_axes(
        imu,
        False,
        FilterConfig(accel_prior_std=1.5, vibration_gain=4.0, accel_noise=0.1).parameters()[0],
    )
    one, two, three = imu.accel_weight
    assert one == pytest.approx(1.0, abs=1e-3) and one > two > 0.5 > 0.1 > three
    assert imu.accel_psd[2] == pytest.approx(
        0.1**2 + 2.0 * PERSISTENCE * three * 4.0 * 25.0, rel=0.2
    )
    weigh_axes(imu, False, FilterConfig(vibration_gain=0.0, accel_noise=0.1).parameters()[0])
    assert imu.accel_weight.tolist() == [1.0] * 3 and imu.accel_psd == pytest.approx([0.1**2] * 3)
    weigh_axes(imu, True, FilterConfig().parameters()[0])
    assert imu.accel_psd == pytest.approx([QUIET_NOISE**2] * 3)


def test_an_axis_whose_mean_is_that_of_hovering_does_not_rectify_however_it_vibrates():
    parameters = FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0]
    weights = {}
    for offset in (0.0, 3.0):
        imu = after(
            (np.zeros(3), 0.0), (UP + [offset, 0.0, 0.0], 3.0), seconds=4.0 * SHAKING_MEMORY
        )
        weigh_axes(imu, False, parameters)
        weights[offset] = imu.accel_weight
    error = 4.0 * 3.0**2
    # The weight is the same as with an unknown mean.
    assert weights[3.0][0] == pytest.approx(1.5**2 / (1.5**2 + error), rel=0.2)
    for one in (weights[0.0][0], weights[3.0][1], weights[3.0][2]):
        assert one == pytest.approx(1.5**2 / (1.5**2 + LEAST_RECTIFIED * error), rel=0.1)


def test_what_begins_to_vibrate_is_not_believed_before_it_was_seen_for_a_while():
    parameters = FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0]
    imu = after(**STILL)
    imu = after((np.zeros(3), 0.0), (UP, 1.0), imu=imu, seconds=0.5)
    weigh_axes(imu, False, parameters)
    early = imu.accel_weight.copy()
    imu = after((np.zeros(3), 0.0), (UP, 1.0), imu=imu, seconds=4.0 * SHAKING_MEMORY)
    weigh_axes(imu, False, parameters)
    assert (early < 0.6).all() and (imu.accel_weight > 0.8).all()


@pytest.mark.parametrize("force", [-UP, np.array([np.linalg.norm(UP), 0.0, 0.0])])
def test_what_hangs_upside_down_or_lies_on_its_side_does_not_hover_however_it_shakes(force):
    imu = after((np.zeros(3), 0.0), (force, np.array([5.0, 5.0, 5.0])))
    weigh_axes(imu, False, FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0])
    assert imu.accel_weight.min() > 0.75


def test_samples_are_averaged_with_the_last_one_unless_it_is_old():
    imu = fresh()
    for t, size, expected in ((0.0, 1.0, 1.0), (0.01, 3.0, 2.0), (1.0, 7.0, 7.0)):
        sample = sample_of(t, [size] * 3, [10.0 * size] * 3)
        assert observe(imu, sample, 0.1) == (t == 0.01)
        np.testing.assert_allclose(imu.gyro, expected)
        np.testing.assert_allclose(imu.accel, 10.0 * expected)
        store(imu, sample)
        np.testing.assert_allclose(imu.gyro, size)
    np.testing.assert_allclose(imu.mean_accel, 70.0)


def test_what_is_far_from_hovering_is_taken_for_what_it_is_however_it_vibrates():
    """A vibrating accelerometer keeps 95 % of its weight at 3 g, as in a turn.

    An error of 0.2 g, as vibration causes it, reduces the weight below 0.6.
    """
    parameters = FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0]
    weights = {}
    for force in (1.0, 1.2, 3.0):
        imu = after((np.zeros(3), 0.0), (force * UP, 1.0))
        weigh_axes(imu, False, parameters)
        weights[force] = imu.accel_weight[2]
    assert weights[1.2] < 0.6 < weights[1.0] and weights[3.0] > 0.95


# --- frames ---


def state(seed=0):
    """Return q (4,), v (3,) and covariance (9, 9), with standard deviations of about 1e-4."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(9, 9)) * 1e-4
    return Rotation.random(random_state=seed).as_quat(), random.normal(size=3) * 2, root @ root.T


def disturbed(q, v, covariance, n=50_000):
    """Draw true positions, velocities and attitudes from the belief of the filter.

    True attitude = q Exp(dtheta).
    """
    error = np.random.default_rng(1).multivariate_normal(np.zeros(9), covariance, n)
    return (
        error[:, :3],
        v + error[:, 3:6],
        Rotation.from_quat(q) * Rotation.from_rotvec(error[:, 6:]),
    )


def test_covariance_is_that_of_what_an_odometry_holds():
    q, v, covariance = state()
    dp, velocity, truth = disturbed(q, v, covariance)
    # truth = Exp(turned) q, about the axes of the world
    turned = (truth * Rotation.from_quat(q).inv()).as_rotvec()
    sampled = np.cov(np.hstack([dp, turned, truth.inv().apply(velocity)]).T)
    u, converted = to_odometry(q[None], v[None], covariance[None])
    np.testing.assert_allclose(u[0], Rotation.from_quat(q).inv().apply(v), atol=1e-12)
    for part in (slice(0, 6), slice(6, 9)):  # pose and twist
        np.testing.assert_allclose(
            converted[0][part, part], sampled[part, part], atol=0.02 * sampled[part, part].max()
        )


def test_rotation_std_is_that_of_the_odometry():
    q, v, covariance = (np.stack(rows) for rows in zip(*map(state, range(5))))
    converted = to_odometry(q, v, covariance)[1]
    np.testing.assert_allclose(
        rotation_std(q, covariance), np.sqrt(converted[:, [3, 4, 5], [3, 4, 5]]), rtol=1e-12
    )


# --- update ---

# --- update ---
seeds = st.integers(0, 2**32 - 1)
rows = st.lists(st.integers(0, 14), min_size=1, max_size=LONGEST_ROW, unique=True)


@given(seeds, rows)
def test_projection_of_a_sparse_row_is_that_of_the_dense_one(seed, states):
    prior = Prior(seed, states)
    P, h, innovation = prior.hypothesis.P, prior.h, prior.innovation
    np.testing.assert_allclose(innovation.cross_covariance, P @ h, atol=1e-12 * np.abs(P).max())
    assert innovation.prior_variance == pytest.approx(h @ P @ h, rel=1e-9)


@given(seeds, rows)
def test_kalman_is_the_textbook_update(seed, states):
    prior = Prior(seed, states)
    expected = prior.textbook(prior.innovation.noise_variance)
    prior.innovation.total_variance = (
        prior.innovation.prior_variance + prior.innovation.noise_variance
    )
    kalman(prior.hypothesis, prior.innovation)
    prior.assert_is(*expected)
    np.testing.assert_array_equal(prior.hypothesis.P, prior.hypothesis.P.T)
    assert_covariance(prior.hypothesis.P)


@given(seeds, st.integers(0, 5), st.floats(0.01, 10.0))
def test_update_directly_is_the_textbook_update_with_a_unit_row(seed, state, std):
    prior = Prior(seed)
    prior.h[:] = np.arange(15) == state
    prior.innovation.value = 1.5 - prior.hypothesis.x[state]
    expected = prior.textbook(std**2)
    kalman_direct(prior.hypothesis, prior.innovation, state, 1.5, std)
    prior.assert_is(*expected)


# --- robust ---
losses = st.sampled_from(LOSSES)
lengths = st.floats(1.0, 8.0)


def tuned(**config):
    return FilterConfig(**config).parameters()[0]


def update(prior, parameters):
    """Weigh the innovation, then update, as the engine does."""
    weigh(prior.hypothesis, prior.innovation, parameters)
    if prior.innovation.weight > 0.0:
        kalman(prior.hypothesis, prior.innovation)


@given(seeds, lengths)
def test_gate_judges_with_the_variance_of_one_measurement_and_leaves_all_as_it_was(seed, length):
    prior, gate = Prior(seed, surprise=3.0), 2.0
    innovation, before = prior.innovation, prior.hypothesis.copy()
    expected = prior.textbook(innovation.noise_variance * length)
    passed = abs(innovation.value) <= gate * np.sqrt(
        innovation.prior_variance + innovation.noise_variance
    )
    innovation.variance_inflation = length
    update(prior, tuned(robust="gate", gate=gate))
    assert innovation.weight == passed
    if passed:
        prior.assert_is(*expected)
    else:
        assert prior.hypothesis == before and innovation.total_variance == np.inf


@given(seeds, losses, lengths)
def test_innovation_divides_the_variance_by_the_weight_of_what_is_whitened(seed, loss, length):
    prior = Prior(seed, surprise=3.0)
    innovation, before = prior.innovation, prior.hypothesis.copy()
    whitened = innovation.value / np.sqrt(innovation.prior_variance + innovation.noise_variance)
    w = weight(LOSSES.index(loss), whitened, 2.5)
    expected = prior.textbook(innovation.noise_variance * length / w)
    innovation.variance_inflation = length
    update(prior, tuned(loss=loss, measurement_scale=2.5))
    assert innovation.weight == (w if w >= NEGLIGIBLE else 0.0)
    if w >= NEGLIGIBLE:
        prior.assert_is(*expected)
    else:
        assert prior.hypothesis == before


@given(seeds, losses, lengths, st.integers(1, 6), st.floats(1.0, 4.0), st.floats(1.0, 4.0))
def test_m_estimation_is_that_of_the_paper(seed, loss, length, iterations, state_scale, scale):
    prior = Prior(seed, surprise=2.0)
    scales = dict(measurement_scale=scale, state_scale=state_scale, iterations=iterations)
    parameters = tuned(robust="m_estimation", loss=loss, **scales)
    prior.innovation.variance_inflation = length
    noise, P = prior.innovation.noise_variance * length, prior.hypothesis.P
    error, covariance, expected = m_estimation(prior, P, prior.h, noise, parameters)
    posterior = prior.after(error, covariance)
    update(prior, parameters)
    assert prior.innovation.weight == pytest.approx(expected, rel=1e-6)
    prior.assert_is(*posterior, rtol=1e-6)


def m_estimation(prior, P, h, noise, parameters):
    """Return error, covariance and weight by Eqs. 8 - 13 of Zhao et al. (RA-L 2021).

    The Jacobian is taken at the prior mean. The weight of the measurement is at least
    SMALLEST_WEIGHT.
    """
    S, error, value = np.linalg.cholesky(P), np.zeros(len(h)), prior.innovation.value
    loss, state_scale, scale = (
        parameters[name] for name in ("loss", "state_scale", "measurement_scale")
    )
    for _ in range(parameters["iterations"]):
        scaled = np.linalg.solve(S, error)  # eq. 9
        rescaled = S @ np.diag([1.0 / weight(loss, e, state_scale) for e in scaled]) @ S.T  # eq. 10
        w = max(weight(loss, (value - h @ error) / np.sqrt(noise), scale), SMALLEST_WEIGHT)
        error, posterior = textbook(rescaled, h, value, noise / w)  # eqs. 11, 13
    return error, posterior, w


# error states of a measurement, and its auxiliary state
MEASURED = {
    "tdoa": ((0, 1, 2), None),
    "tdoa, slope on velocity": ((0, 1, 2, 3, 4, 5), None),
    "height": ((2, 6, 7), None),
    "velocity": ((3, 4, 5, 7, 8), None),
    "barometer": ((2,), PRESSURE),
    "range with an offset": ((0, 1, 2), RANGE),
    "attitude": ((6, 7, 8), None),
}


@given(
    seeds,
    st.sampled_from(sorted(MEASURED)),
    st.sampled_from(ROBUST),
    losses,
    st.integers(1, 4),
    st.floats(0.0, 5.0),
)
def test_whatever_is_measured_the_joint_covariance_stays_one(
    seed, name, robust, loss, iterations, surprise
):
    states, offset = MEASURED[name]
    prior = Prior(seed, states, surprise)
    joint, innovation = with_offset(prior), prior.innovation
    if offset is not None:
        add_offset_jacobian(prior.hypothesis, innovation, offset)
    h = np.zeros(18)
    h[list(states)] = prior.h[list(states)]
    if offset is not None:
        h[15 + offset] = 1.0
    parameters = tuned(robust=robust, loss=loss, iterations=iterations)
    x = prior.hypothesis.offset.copy()
    if robust == "m_estimation":
        error, expected, _ = m_estimation(prior, joint, h, innovation.noise_variance, parameters)
    update(prior, parameters)
    after = np.zeros((18, 18))
    after[:15, :15], after[15:, :15], after[15:, 15:] = (
        prior.hypothesis.P,
        prior.hypothesis.offset_cross,
        prior.hypothesis.offset_P,
    )
    after[:15, 15:] = after[15:, :15].T
    assert_covariance(after, tolerance=1e-8)
    if robust == "m_estimation":
        std = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            after / np.outer(std, std), expected / np.outer(std, std), atol=1e-6
        )
        np.testing.assert_allclose(
            (prior.hypothesis.offset - x) / std[15:], error[15:] / std[15:], atol=1e-6
        )


# --- state ---

DOWN = np.array([0.0, 0.0, -GRAVITY])


def random_state(rng):
    q = rng.standard_normal(4)
    return np.concatenate(
        [rng.normal(0, 5, 3), rng.normal(0, 2, 3), q / np.linalg.norm(q), rng.normal(0, 0.2, 6)]
    )


def plus(x, error, gain=1.0):
    out = x.copy()
    inject(out, error, gain)
    return out


def minus(x, y):
    """Return the error state (15,) that takes y to x."""
    attitude = Rotation.from_quat(y[6:10]).inv() * Rotation.from_quat(x[6:10])
    return np.concatenate([x[:6] - y[:6], attitude.as_rotvec(), x[10:] - y[10:]])


NEW = new_state(np.zeros((1, 3)))


def ekf_with(x, P):
    ekf = NEW.copy().record
    ekf.hypotheses["x"][0], ekf.hypotheses["P"][0] = x, P
    return ekf


def predicted(x, P, dt, gyro, accel, weight, psd=(0.0, 0.0, 0.0), rest=(0.0, 0.0, 0.0)):
    """Return state and covariance after one prediction.

    psd : of the accelerometer.
    rest : of the gyroscope and both bias walks.
    """
    ekf, parameters = ekf_with(x, P), np.zeros(1, PARAMETERS)[0]
    for name, value in zip(
        ("gyro", "accel", "accel_weight", "accel_psd"), (gyro, accel, weight, psd)
    ):
        ekf.imu[name] = value
    for name, value in zip(("gyro_noise", "accel_bias_walk", "gyro_bias_walk"), np.sqrt(rest)):
        parameters[name] = value
    predict(ekf.hypotheses[0], ekf.imu, parameters, dt, ekf.transition)
    return ekf.hypotheses["x"][0], ekf.hypotheses["P"][0]


def cross(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def random_case(seed):
    rng = np.random.default_rng(seed)
    weight = rng.uniform(0.0, 1.0, 3) if seed % 2 else np.ones(3)
    return rng, random_state(rng), rng.normal(0, 2, 3), rng.normal(0, 4, 3) - DOWN, weight


@given(seeds)
def test_rotation_is_that_of_scipy(seed):
    x, R = random_state(np.random.default_rng(seed)), np.empty((3, 3))
    rotation(*x[6:10], R)
    np.testing.assert_allclose(R, Rotation.from_quat(x[6:10]).as_matrix(), atol=1e-12)


@given(seeds, st.sampled_from([0.0, 1e-12, 1e-8, 1e-3, 1.0, 3.2, 100.0]))
def test_turn_is_a_rotation_vector_in_the_body_frame(seed, size):
    rng = np.random.default_rng(seed)
    x, r = random_state(rng), size * rng.standard_normal(3)
    expected = Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(r)
    turn(x, *exponential(*r))
    assert abs(np.linalg.norm(x[6:10]) - 1.0) < 1e-14
    assert (expected.inv() * Rotation.from_quat(x[6:10])).magnitude() < 1e-12


@given(seeds)
def test_inject_and_minus_undo_each_other(seed):
    rng = np.random.default_rng(seed)
    x, error = random_state(rng), rng.uniform(-1, 1, 15)
    np.testing.assert_allclose(minus(plus(x, error), x), error, atol=1e-12)
    np.testing.assert_allclose(plus(x, 2 * error), plus(x, error, 2.0), atol=1e-15)


@settings(max_examples=20)
@given(seeds)
def test_many_small_steps_solve_the_equations_of_motion(seed):
    """Compare with Eq. 14 of Zhao et al. at constant rates and specific force, solved by scipy."""
    _, x, gyro, accel, _ = random_case(seed)
    rates, f = gyro - x[13:], accel - x[10:13]

    def derivative(t, y):
        attitude = Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(rates * t)
        return np.concatenate([y[3:], attitude.apply(f) + DOWN])

    exact = solve_ivp(derivative, (0.0, 0.2), x[:6], rtol=1e-10, atol=1e-10).y[:, -1]
    P, after = np.eye(15), x
    for _ in range(400):
        after, _ = predicted(after, P, 0.0005, gyro, accel, np.ones(3))
    # The input is held over each step: first order.
    np.testing.assert_allclose(after[:6], exact, atol=0.005)
    attitude = Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(0.2 * rates)
    assert (attitude.inv() * Rotation.from_quat(after[6:10])).magnitude() < 1e-10


def test_no_weight_means_hovering_thrust():
    x = random_state(np.random.default_rng(1))
    for accel in (np.zeros(3), np.full(3, 50.0)):
        after, _ = predicted(x, np.eye(15), 0.01, np.zeros(3), accel, np.zeros(3))
        thrust = Rotation.from_quat(x[6:10]).apply([0, 0, GRAVITY])
        np.testing.assert_allclose(after[3:6] - x[3:6], 0.01 * (thrust + DOWN), atol=1e-12)


def documented_phi(x, dt, gyro, accel, weight):
    R = Rotation.from_quat(x[6:10]).as_matrix()
    # `weight` is the share of the measured force, the rest is hovering.
    f = -DOWN + weight * (accel - x[10:13] + DOWN)
    phi = np.eye(15)
    phi[0:3, 3:6] = dt * np.eye(3)
    phi[3:6, 6:9] = -dt * R @ cross(f)
    phi[3:6, 9:12] = -dt * R @ np.diag(weight)
    phi[6:9, 6:9] = Rotation.from_rotvec(-dt * (gyro - x[13:])).as_matrix()
    phi[6:9, 12:15] = -dt * np.eye(3)
    return phi


@given(seeds)
def test_covariance_is_phi_p_phi_of_the_documented_phi(seed):
    rng, x, gyro, accel, weight = random_case(seed)
    dt, P = 10.0 ** rng.uniform(-4, -1.3), random_covariance(rng)
    psd, rest = rng.uniform(0, 1, 3), rng.uniform(0, 1, 3)
    R, phi, Q = (
        Rotation.from_quat(x[6:10]).as_matrix(),
        documented_phi(x, dt, gyro, accel, weight),
        np.zeros((15, 15)),
    )
    Q[3:6, 3:6] = dt * R @ np.diag(psd) @ R.T
    for first, density in zip((6, 9, 12), rest):
        Q[first : first + 3, first : first + 3] = dt * density * np.eye(3)
    _, after = predicted(x, P, dt, gyro, accel, weight, psd, rest)
    expected = phi @ P @ phi.T + Q
    np.testing.assert_allclose(after, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(after, after.T)
    assert_covariance(after)


@pytest.mark.slow
@given(seeds)
def test_covariance_follows_the_nominal_state_to_first_order_in_dt(seed):
    """Compare with Phi from finite differences of the nominal prediction.

    The difference falls with the square of dt.
    """
    rng, x, gyro, accel, weight = random_case(seed)
    P, left = random_covariance(rng, spread=0.3), []
    for dt in (1e-2, 1e-3):
        base, after = predicted(x, P, dt, gyro, accel, weight)

        def moved(error):
            return minus(predicted(plus(x, error), P, dt, gyro, accel, weight)[0], base)

        phi = numerical_jacobian(moved, np.zeros(15), 1e-5)
        left.append(np.linalg.norm(after - phi @ P @ phi.T))
        assert left[-1] < 0.25 * np.linalg.norm(phi @ P @ phi.T - P), (
            "beside what the prediction changes"
        )
    assert left[1] < left[0] / 50.0


def test_a_spin_about_the_vertical_leaves_the_uncertainty_of_the_tilt_as_it_was(rate=200.0):
    x = np.zeros(16)
    x[9] = 1.0
    P = np.diag([1e-4] * 6 + [0.01] * 3 + [1e-12] * 6)
    for _ in range(int(10.0 * rate)):
        x, P = predicted(x, P, 1.0 / rate, np.array([0.0, 0.0, 3.0]), -DOWN, np.ones(3))
    np.testing.assert_allclose([P[6, 6], P[7, 7]], 0.01, rtol=0.1)


def coasted(x, P, dt, accel_psd, turn_psd):
    hypotheses = ekf_with(x, P).hypotheses
    coast(hypotheses[0], dt, accel_psd, turn_psd, turn_psd)
    return hypotheses["x"][0], hypotheses["P"][0]


@given(seeds)
def test_coast_is_constant_velocity(seed):
    rng = np.random.default_rng(seed)
    x, P, dt = random_state(rng), random_covariance(rng), rng.uniform(0.001, 0.1)
    base, after = coasted(x, P, dt, 2.0, 0.5)
    np.testing.assert_allclose(base[:3], x[:3] + dt * x[3:6])
    np.testing.assert_array_equal(base[3:], x[3:])

    def moved(error):
        return minus(coasted(plus(x, error), P, dt, 0.0, 0.0)[0], base)

    phi = numerical_jacobian(moved, np.zeros(15), 1e-4)
    Q = np.diag([0.0] * 3 + [2.0 * dt] * 3 + [0.5 * dt] * 3 + [0.0] * 6)
    np.testing.assert_allclose(after, phi @ P @ phi.T + Q, atol=1e-7 * np.abs(P).max())
    assert_covariance(after)
    np.testing.assert_array_equal(after, after.T)


def sits_then_walks(rate, tdoa_outliers=0.0):
    """A tag without an IMU that sits for a minute, then walks with up to 1 m/s: estimates and truth."""
    rng, t = np.random.default_rng(7), np.arange(0.0, 80.0, 1.0 / rate)
    since, anchors = np.maximum(t - 60.0, 0.0), corners()
    way = np.where(since < 1.0, 0.5 * since**2, since - 0.5)
    p = np.column_stack([2.5 + 1.4 * np.sin(way / 1.4), 3.0 + 0.05 * way, np.full(len(t), 1.2)])
    a = rng.integers(0, 8, len(t))
    b = (a + rng.integers(1, 8, len(t))) % 8
    distance = np.linalg.norm(p[:, None] - anchors.positions, axis=2)
    d = distance[range(len(t)), b] - distance[range(len(t)), a] + 0.1 * rng.normal(size=len(t))
    d += np.where(rng.random(len(t)) < tdoa_outliers, rng.uniform(-3.0, 3.0, len(t)), 0.0)
    flight = Flight("sits", anchors, Tdoas(t, anchors.ids[a], anchors.ids[b], d))
    odometry = run_offline(flight, FilterConfig(use_imu=False)).odometry
    true = np.column_stack([np.interp(odometry.t, t, column) for column in p.T])
    return odometry, np.linalg.norm(odometry.p - true, axis=1)


@pytest.mark.parametrize(
    ("rate", "tdoa_outliers", "still"),
    [(10.0, 0.0, 0.08), (10.0, 0.03, 0.11), (50.0, 0.0, 0.04), (200.0, 0.0, 0.03)],
)
def test_a_tag_without_imu_averages_at_rest_and_its_next_steps_are_followed(
    rate, tdoa_outliers, still
):
    odometry, off = sits_then_walks(rate, tdoa_outliers)
    sits = (odometry.t > 10.0) & (odometry.t < 60.0)
    assert np.sqrt(np.mean(off[sits] ** 2)) < still
    assert np.linalg.norm(np.diff(odometry.p[sits], axis=0), axis=1).sum() < 10.0
    assert off[odometry.t > 60.0].max() < 1.5
    walks = odometry.t > 64.0
    assert np.sqrt(np.mean(off[walks] ** 2)) < 0.4


@pytest.mark.parametrize("slope", [0.0, 0.6])
def test_anchors_on_any_line_leave_the_circle_around_it_open(slope):
    x = np.linspace(-4.0, 4.0, 8)
    state = new_state(np.column_stack([x, slope * x, np.full(8, 2.8)]))
    ekf, window = state.record, np.zeros(7, TDOA)
    window["a"], window["b"] = np.arange(7), np.arange(1, 8)
    listen(ekf, window, state.anchors, 100.0, 0)
    along = np.array([1.0, slope, 0.0]) / np.hypot(1.0, slope)
    covariance = np.zeros((9, 9))
    add_circle(ekf, False, np.array([0.0, 0.0, 0.8]), covariance)
    # 2 m below the line: the tag may be anywhere on a circle of 2 m
    level = np.array([-along[1], along[0], 0.0])
    np.testing.assert_allclose(covariance[:3, :3] @ along, 0.0, atol=1e-9)
    np.testing.assert_allclose(level @ covariance[:3, :3] @ level, 2.0)
    np.testing.assert_allclose(covariance[2, 2], 6.0)
    assert covariance[8, 8] > 3.0
    bent = new_state(np.column_stack([x, 0.1 * x**2, np.full(8, 2.8)]))
    listen(bent.record, window, bent.anchors, 100.0, 0)
    assert not bent.record.line.any()
