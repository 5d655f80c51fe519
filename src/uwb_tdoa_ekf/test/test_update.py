# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""One update of a hypothesis, plain and robust, compared with the textbook and the paper."""

from covariances import assert_covariance
from hypothesis import given, strategies as st
import numpy as np
from priors import Prior, kalman as textbook, with_offset
import pytest

from uwb_tdoa_bias.common.robust_loss import LOSSES, weight
from uwb_tdoa_ekf.core.auxiliary import PRESSURE, RANGE, add_offset_jacobian
from uwb_tdoa_ekf.core.config import ROBUST, FilterConfig
from uwb_tdoa_ekf.core.update import (
    LONGEST_ROW,
    NEGLIGIBLE,
    SMALLEST_WEIGHT,
    kalman,
    kalman_direct,
    weigh,
)

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
    update(prior, tuned(robust="gate", gate=gate, tdoa_correlation_length=length))
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
    parameters = tuned(loss=loss, measurement_scale=2.5, tdoa_correlation_length=length)
    update(prior, parameters)
    assert innovation.weight == (w if w >= NEGLIGIBLE else 0.0)
    if w >= NEGLIGIBLE:
        prior.assert_is(*expected)
    else:
        assert prior.hypothesis == before


@given(seeds, losses, lengths, st.integers(1, 6), st.floats(1.0, 4.0), st.floats(1.0, 4.0))
def test_m_estimation_is_that_of_the_paper(seed, loss, length, iterations, state_scale, scale):
    prior = Prior(seed, surprise=2.0)
    scales = dict(measurement_scale=scale, state_scale=state_scale, iterations=iterations)
    parameters = tuned(robust="m_estimation", loss=loss, tdoa_correlation_length=length, **scales)
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
    parameters = tuned(robust=robust, loss=loss, iterations=iterations, tdoa_correlation_length=1.0)
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
