from dataclasses import replace

from flights import corners, fly
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import new_state
from uwb_tdoa_ekf.core.noise import excess_variance, learn
from uwb_tdoa_ekf.offline import run_offline


def taught(std, noise, seconds=20.0, seed=0):
    """Excess variances after TDOAs at 400 Hz whose anchors have the standard deviations `noise`,
    (N,) m.
    """
    rng, n = np.random.default_rng(seed), len(noise)
    state, parameters = new_state(np.zeros((n, 3))), FilterConfig(tdoa_std=std).parameters()[0]
    anchors, innovation, sampled = state.anchors, state.record.innovation, []
    for k in range(int(400 * seconds)):
        a = rng.integers(n)
        b = (a + 1 + rng.integers(n - 1)) % n
        innovation.value = rng.standard_normal() * np.hypot(noise[a], noise[b])
        innovation.noise_variance = std**2 + excess_variance(anchors[a], anchors[b])
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
        innovation.value, innovation.noise_variance = value, 0.01 + excess_variance(a, b)
        learn(a, b, 0.01 * k, innovation, parameters)
        learned = state.anchors["excess_variance"]
        assert np.isfinite(learned).all() and (learned >= 0.0).all()


def test_an_anchor_that_is_late_for_a_while_disturbs_less():
    """Anchor 3 is a metre late in every pair for a second at a time, as behind an obstacle."""
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
            odometry = result.odometry
            after = odometry.t > 3.0
            off = odometry.p[after] - flight.meta["wave"].motion(odometry.t[after])[0]
            found.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        errors[adapt] = np.mean(found)
    assert errors[True] < 0.9 * errors[False]
