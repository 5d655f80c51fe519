import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.frames import rotation_std, to_odometry


def state(seed=0):
    """q (4,), v (3,), covariance (9, 9) of a filter that is sure to 1e-4."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(9, 9)) * 1e-4
    return Rotation.random(random_state=seed).as_quat(), random.normal(size=3) * 2, root @ root.T


def disturbed(q, v, covariance, n=50_000):
    """Samples of true attitude and velocity, as the filter believes them: true attitude = q
    Exp(dtheta).
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
    turned = (
        truth * Rotation.from_quat(q).inv()
    ).as_rotvec()  # truth = Exp(turned) q: about the axes of the world
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
