# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Random covariances, and what makes a matrix one."""

import numpy as np


def random_covariance(rng, n=15, spread=1.0):
    """(n, n), symmetric positive definite; standard deviations over 10**-spread to 10**spread, any
    correlation.
    """
    factor = rng.standard_normal((n, n)) + 0.5 * np.eye(n)
    covariance = factor @ factor.T
    std = np.sqrt(np.diag(covariance))
    wanted = 10.0 ** rng.uniform(-spread, spread, n)
    covariance *= np.outer(wanted / std, wanted / std)
    return 0.5 * (covariance + covariance.T)


def assert_covariance(covariance, tolerance=1e-9):
    """Finite, symmetric, and positive definite: no eigenvalue of the correlation matrix below
    -tolerance.
    """
    assert np.isfinite(covariance).all()
    std = np.sqrt(np.einsum("...ii->...i", covariance))
    assert (std > 0.0).all()
    correlation = covariance / (std[..., :, None] * std[..., None, :])
    np.testing.assert_allclose(correlation, np.swapaxes(correlation, -1, -2), rtol=0.0, atol=1e-12)
    assert np.linalg.eigvalsh(correlation).min() > -tolerance
