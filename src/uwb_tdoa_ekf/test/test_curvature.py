import numpy as np
import pytest

from uwb_tdoa_bias.common.geometry import tdoa, tdoa_jacobian
from uwb_tdoa_ekf.core.update import SMALLEST, variance

A, B = np.array([0.0, -3.0, 1.0]), np.array([1.0, 4.0, 2.0])


@pytest.mark.parametrize("x", [[2.0, 0.0, 1.5], [-3.0, 1.0, 0.3]])
def test_it_is_the_mean_square_of_what_the_slope_leaves_out(x):
    x, rng = np.array(x), np.random.default_rng(0)
    P = np.zeros((15, 15))
    P[:3, :3] = np.diag([0.5, 0.1, 0.4]) ** 2
    e = rng.standard_normal((200_000, 3)) * np.sqrt(np.diag(P)[:3])
    left = tdoa(x + e, A, B) - tdoa(x, A, B) - e @ np.ravel(tdoa_jacobian(x, A, B))
    assert variance(x, P, A, B) == pytest.approx(np.mean(left**2), rel=0.25)


def test_it_is_not_asked_for_where_the_place_is_known_and_finite_at_an_anchor():
    P = np.eye(15) * (0.9 * SMALLEST) ** 2 / 3.0
    assert variance(np.array([2.0, 0.0, 1.5]), P, A, B) == 0.0
    assert np.isfinite(variance(A.copy(), np.eye(15), A, B))
