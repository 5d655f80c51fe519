import numpy as np
from scipy.spatial.transform import Rotation
from uwb_tdoa_ekf.frames import body_velocity, pose_covariance


def state(seed=0):
    """q (4,), v (3,), covariance (9, 9) of a filter that is sure to 1e-4."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(9, 9)) * 1e-4
    return Rotation.random(random_state=seed).as_quat(), random.normal(size=3) * 2, root @ root.T


def disturbed(q, v, covariance, n=50_000):
    """Samples of true attitude and velocity, as the filter believes them: true attitude = q Exp(dtheta)."""
    error = np.random.default_rng(1).multivariate_normal(np.zeros(9), covariance, n)
    return error[:, :3], v + error[:, 3:6], Rotation.from_quat(q) * Rotation.from_rotvec(error[:, 6:])


def test_pose_covariance_is_that_of_rotations_about_fixed_axes():
    q, v, covariance = state()
    dp, _, truth = disturbed(q, v, covariance)
    turned = (truth * Rotation.from_quat(q).inv()).as_rotvec()  # truth = Exp(turned) q: about the axes of the world
    sampled = np.cov(np.hstack([dp, turned]).T)
    np.testing.assert_allclose(pose_covariance(q[None], covariance[None])[0], sampled, atol=0.02 * sampled.max())


def test_velocity_and_its_covariance_are_in_the_body_frame():
    q, v, covariance = state(3)
    _, velocity, truth = disturbed(q, v, covariance)
    seen = truth.inv().apply(velocity)
    u, spread = body_velocity(q[None], v[None], covariance[None])
    np.testing.assert_allclose(u[0], Rotation.from_quat(q).inv().apply(v), atol=1e-12)
    sampled = np.cov(seen.T)
    np.testing.assert_allclose(spread[0], sampled, atol=0.02 * sampled.max())


def test_many_rows_are_independent():
    rows = [state(seed) for seed in range(5)]
    q, v, covariance = map(np.array, zip(*rows))
    together = pose_covariance(q, covariance), *body_velocity(q, v, covariance)
    for i in range(5):
        at = slice(i, i + 1)
        one = pose_covariance(q[at], covariance[at]), *body_velocity(q[at], v[at], covariance[at])
        for many, single in zip(together, one):
            np.testing.assert_allclose(many[i], single[0], rtol=1e-12)
