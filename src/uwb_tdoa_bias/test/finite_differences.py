# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Central differences, the reference for every analytic derivative."""

import numpy as np


def numerical_jacobian(function, at, step=1e-6):
    """Return the derivative of a function by central differences.

    Parameters
    ----------
    function : callable
        Maps (n,) to (m,) or to a scalar.
    at : (n,) array
        Point of the derivative.
    step : float
        Half of the difference.

    Returns
    -------
    (m, n) array
    """
    at = np.asarray(at, dtype=float)
    columns = []
    for k in range(len(at)):
        shift = np.zeros(len(at))
        shift[k] = step
        columns.append(
            (np.atleast_1d(function(at + shift)) - np.atleast_1d(function(at - shift)))
            / (2.0 * step)
        )
    return np.stack(columns, axis=1)
