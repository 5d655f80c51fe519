# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Random covariances, and a check that a matrix is a covariance."""

import numpy as np


def random_covariance(rng, n=15, spread=1.0):
    """Return a random covariance (n, n).

    It is symmetric and positive definite. The standard deviations lie between 10**-spread and
    10**spread; correlations are arbitrary.
    """
    factor = rng.standard_normal((n, n)) + 0.5 * np.eye(n)
    covariance = factor @ factor.T
    std = np.sqrt(np.diag(covariance))
    wanted = 10.0 ** rng.uniform(-spread, spread, n)
    covariance *= np.outer(wanted / std, wanted / std)
    return 0.5 * (covariance + covariance.T)


def assert_covariance(covariance, tolerance=1e-9):
    """Check that a matrix is finite, symmetric, and positive definite.

    No eigenvalue of its correlation matrix may be below -tolerance.
    """
    assert np.isfinite(covariance).all()
    std = np.sqrt(np.einsum("...ii->...i", covariance))
    assert (std > 0.0).all()
    correlation = covariance / (std[..., :, None] * std[..., None, :])
    np.testing.assert_allclose(correlation, np.swapaxes(correlation, -1, -2), rtol=0.0, atol=1e-12)
    assert np.linalg.eigvalsh(correlation).min() > -tolerance
