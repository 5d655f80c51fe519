# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""One judge for every analytic derivative: central differences."""

import numpy as np


def numerical_jacobian(function, at, step=1e-6):
    """Derivative of function: (n,) -> (m,) or scalar at the point `at`, by central differences: (m,
    n).
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
