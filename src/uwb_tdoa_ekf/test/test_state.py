# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from covariances import assert_covariance, random_covariance
from finite_differences import numerical_jacobian
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.core.config import PARAMETERS
from uwb_tdoa_ekf.core.memory import new_state
from uwb_tdoa_ekf.core.state import (
    GRAVITY,
    coast,
    exponential,
    inject,
    predict,
    rotation,
    turn,
)

seeds = st.integers(0, 2**32 - 1)
DOWN = np.array([0.0, 0.0, -GRAVITY])


def random_state(rng):
    q = rng.standard_normal(4)
    return np.concatenate(
        [rng.normal(0, 5, 3), rng.normal(0, 2, 3), q / np.linalg.norm(q), rng.normal(0, 0.2, 6)]
    )


def plus(x, error, gain=1.0):
    out = x.copy()
    inject(out, error, gain)
    return out


def minus(x, y):
    """Return the error state (15,) that takes y to x."""
    attitude = Rotation.from_quat(y[6:10]).inv() * Rotation.from_quat(x[6:10])
    return np.concatenate([x[:6] - y[:6], attitude.as_rotvec(), x[10:] - y[10:]])


NEW = new_state(np.zeros((1, 3)))


def ekf_with(x, P):
    ekf = NEW.copy().record
    ekf.hypotheses["x"][0], ekf.hypotheses["P"][0] = x, P
    return ekf


def predicted(x, P, dt, gyro, accel, weight, psd=(0.0, 0.0, 0.0), rest=(0.0, 0.0, 0.0)):
    """Return state and covariance after one prediction.

    psd : of the accelerometer.
    rest : of the gyroscope and both bias walks.
    """
    ekf, parameters = ekf_with(x, P), np.zeros(1, PARAMETERS)[0]
    for name, value in zip(
        ("gyro", "accel", "accel_weight", "accel_psd"), (gyro, accel, weight, psd)
    ):
        ekf.imu[name] = value
    for name, value in zip(("gyro_noise", "accel_bias_walk", "gyro_bias_walk"), np.sqrt(rest)):
        parameters[name] = value
    predict(ekf.hypotheses[0], ekf.imu, parameters, dt, ekf.transition)
    return ekf.hypotheses["x"][0], ekf.hypotheses["P"][0]


def cross(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def random_case(seed):
    rng = np.random.default_rng(seed)
    weight = rng.uniform(0.0, 1.0, 3) if seed % 2 else np.ones(3)
    return rng, random_state(rng), rng.normal(0, 2, 3), rng.normal(0, 4, 3) - DOWN, weight


@given(seeds)
def test_rotation_is_that_of_scipy(seed):
    x, R = random_state(np.random.default_rng(seed)), np.empty((3, 3))
    rotation(*x[6:10], R)
    np.testing.assert_allclose(R, Rotation.from_quat(x[6:10]).as_matrix(), atol=1e-12)


@given(seeds, st.sampled_from([0.0, 1e-12, 1e-8, 1e-3, 1.0, 3.2, 100.0]))
def test_turn_is_a_rotation_vector_in_the_body_frame(seed, size):
    rng = np.random.default_rng(seed)
    x, r = random_state(rng), size * rng.standard_normal(3)
    expected = Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(r)
    turn(x, *exponential(*r))
    assert abs(np.linalg.norm(x[6:10]) - 1.0) < 1e-14
    assert (expected.inv() * Rotation.from_quat(x[6:10])).magnitude() < 1e-12


@given(seeds)
def test_inject_and_minus_undo_each_other(seed):
    rng = np.random.default_rng(seed)
    x, error = random_state(rng), rng.uniform(-1, 1, 15)
    np.testing.assert_allclose(minus(plus(x, error), x), error, atol=1e-12)
    np.testing.assert_allclose(plus(x, 2 * error), plus(x, error, 2.0), atol=1e-15)


@settings(max_examples=20)
@given(seeds)
def test_many_small_steps_solve_the_equations_of_motion(seed):
    """Compare with Eq. 14 of Zhao et al. at constant rates and specific force, solved by scipy."""
    _, x, gyro, accel, _ = random_case(seed)
    rates, f = gyro - x[13:], accel - x[10:13]

    def derivative(t, y):
        attitude = Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(rates * t)
        return np.concatenate([y[3:], attitude.apply(f) + DOWN])

    exact = solve_ivp(derivative, (0.0, 0.2), x[:6], rtol=1e-10, atol=1e-10).y[:, -1]
    P, after = np.eye(15), x
    for _ in range(400):
        after, _ = predicted(after, P, 0.0005, gyro, accel, np.ones(3))
    # The input is held over each step: first order.
    np.testing.assert_allclose(after[:6], exact, atol=0.005)
    attitude = Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(0.2 * rates)
    assert (attitude.inv() * Rotation.from_quat(after[6:10])).magnitude() < 1e-10


def test_no_weight_means_hovering_thrust():
    x = random_state(np.random.default_rng(1))
    for accel in (np.zeros(3), np.full(3, 50.0)):
        after, _ = predicted(x, np.eye(15), 0.01, np.zeros(3), accel, np.zeros(3))
        thrust = Rotation.from_quat(x[6:10]).apply([0, 0, GRAVITY])
        np.testing.assert_allclose(after[3:6] - x[3:6], 0.01 * (thrust + DOWN), atol=1e-12)


def documented_phi(x, dt, gyro, accel, weight):
    R = Rotation.from_quat(x[6:10]).as_matrix()
    # `weight` is the share of the measured force, the rest is hovering.
    f = -DOWN + weight * (accel - x[10:13] + DOWN)
    phi = np.eye(15)
    phi[0:3, 3:6] = dt * np.eye(3)
    phi[3:6, 6:9] = -dt * R @ cross(f)
    phi[3:6, 9:12] = -dt * R @ np.diag(weight)
    phi[6:9, 6:9] = Rotation.from_rotvec(-dt * (gyro - x[13:])).as_matrix()
    phi[6:9, 12:15] = -dt * np.eye(3)
    return phi


@given(seeds)
def test_covariance_is_phi_p_phi_of_the_documented_phi(seed):
    rng, x, gyro, accel, weight = random_case(seed)
    dt, P = 10.0 ** rng.uniform(-4, -1.3), random_covariance(rng)
    psd, rest = rng.uniform(0, 1, 3), rng.uniform(0, 1, 3)
    R, phi, Q = (
        Rotation.from_quat(x[6:10]).as_matrix(),
        documented_phi(x, dt, gyro, accel, weight),
        np.zeros((15, 15)),
    )
    Q[3:6, 3:6] = dt * R @ np.diag(psd) @ R.T
    for first, density in zip((6, 9, 12), rest):
        Q[first : first + 3, first : first + 3] = dt * density * np.eye(3)
    _, after = predicted(x, P, dt, gyro, accel, weight, psd, rest)
    expected = phi @ P @ phi.T + Q
    np.testing.assert_allclose(after, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(after, after.T)
    assert_covariance(after)


@pytest.mark.slow
@given(seeds)
def test_covariance_follows_the_nominal_state_to_first_order_in_dt(seed):
    """Compare with Phi from finite differences of the nominal prediction.

    The difference falls with the square of dt.
    """
    rng, x, gyro, accel, weight = random_case(seed)
    P, left = random_covariance(rng, spread=0.3), []
    for dt in (1e-2, 1e-3):
        base, after = predicted(x, P, dt, gyro, accel, weight)

        def moved(error):
            return minus(predicted(plus(x, error), P, dt, gyro, accel, weight)[0], base)

        phi = numerical_jacobian(moved, np.zeros(15), 1e-5)
        left.append(np.linalg.norm(after - phi @ P @ phi.T))
        assert left[-1] < 0.25 * np.linalg.norm(phi @ P @ phi.T - P), (
            "beside what the prediction changes"
        )
    assert left[1] < left[0] / 50.0


def test_a_spin_about_the_vertical_leaves_the_uncertainty_of_the_tilt_as_it_was(rate=200.0):
    x = np.zeros(16)
    x[9] = 1.0
    P = np.diag([1e-4] * 6 + [0.01] * 3 + [1e-12] * 6)
    for _ in range(int(10.0 * rate)):
        x, P = predicted(x, P, 1.0 / rate, np.array([0.0, 0.0, 3.0]), -DOWN, np.ones(3))
    np.testing.assert_allclose([P[6, 6], P[7, 7]], 0.01, rtol=0.1)


def coasted(x, P, dt, accel_psd, turn_psd):
    hypotheses = ekf_with(x, P).hypotheses
    coast(hypotheses[0], dt, accel_psd, turn_psd, turn_psd)
    return hypotheses["x"][0], hypotheses["P"][0]


@given(seeds)
def test_coast_is_constant_velocity(seed):
    rng = np.random.default_rng(seed)
    x, P, dt = random_state(rng), random_covariance(rng), rng.uniform(0.001, 0.1)
    base, after = coasted(x, P, dt, 2.0, 0.5)
    np.testing.assert_allclose(base[:3], x[:3] + dt * x[3:6])
    np.testing.assert_array_equal(base[3:], x[3:])

    def moved(error):
        return minus(coasted(plus(x, error), P, dt, 0.0, 0.0)[0], base)

    phi = numerical_jacobian(moved, np.zeros(15), 1e-4)
    Q = np.diag([0.0] * 3 + [2.0 * dt] * 3 + [0.5 * dt] * 3 + [0.0] * 6)
    np.testing.assert_allclose(after, phi @ P @ phi.T + Q, atol=1e-7 * np.abs(P).max())
    assert_covariance(after)
    np.testing.assert_array_equal(after, after.T)
