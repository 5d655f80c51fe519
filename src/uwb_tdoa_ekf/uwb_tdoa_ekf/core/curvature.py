"""What a TDOA tells of a place that is hardly known: less than its slope says, because it is curved
within the covariance.

The second-order term of a Gaussian filter (e.g. Bar-Shalom et al., Estimation with Applications to
Tracking and Navigation, 2001, section 10.3.2), mean and variance, taken as a variance.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

SMALLEST = 0.5  # m, 3D standard deviation below which it is negligible
NEAREST = 0.1  # m, of an anchor, for its curvature


@compiled
def variance(x: np.ndarray, P: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Mean square, m^2, of the second-order term of a TDOA between anchors at a and b (3,), of a
    tag at x (3,), m, with covariance P (15, 15).
    """
    if P[0, 0] + P[1, 1] + P[2, 2] < SMALLEST**2:
        return 0.0
    product = np.zeros((3, 3))
    for anchor, sign in ((a, -1.0), (b, 1.0)):
        away = np.array([x[k] - anchor[k] for k in range(3)])
        distance = max(math.sqrt(np.sum(away**2)), NEAREST)
        for i in range(3):
            along = 0.0
            for k in range(3):
                along += away[k] * P[k, i] / distance**2
            for j in range(3):
                product[j, i] += (
                    sign * (P[j, i] - away[j] * along) / distance
                )  # of Hessian and covariance
    mean = squared = 0.0
    for i in range(3):
        mean += 0.5 * product[i, i]
        for j in range(3):
            squared += 0.5 * product[i, j] * product[j, i]
    return mean**2 + squared
