from covariances import assert_covariance
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from priors import Prior
import pytest

from uwb_tdoa_ekf.core.update import LONGEST_ROW, kalman, update_state

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
def test_update_state_is_the_textbook_update_with_a_unit_row(seed, state, std):
    prior = Prior(seed)
    prior.h[:] = np.arange(15) == state
    prior.innovation.value = 1.5 - prior.hypothesis.x[state]
    expected = prior.textbook(std**2)
    update_state(prior.hypothesis, prior.innovation, state, 1.5, std)
    prior.assert_is(*expected)
