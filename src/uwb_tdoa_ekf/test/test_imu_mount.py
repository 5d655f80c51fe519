import numpy as np
from flights import GRAVITY, Wave
from scipy.spatial.transform import Rotation
from uwb_tdoa_ekf.imu_mount import ImuMount

TURN = Rotation.from_euler("ZYX", [0.5 * np.pi, 0.3, -0.2])  # IMU to body
ARM = np.array([0.2, -0.1, 0.15])  # m
RATE = 500.0  # Hz


def mounted():
    """Stamps, samples in the origin of a body that flies about, and what an IMU at ARM, turned, measures."""
    t = np.arange(0.0, 4.0, 1.0 / RATE)
    wave = Wave(np.random.default_rng(1), [0.0, 0.0, 0.0], yaw=2.0)
    p, _, attitude, force, rates = wave.motion(t)
    at_arm = p + attitude.apply(ARM)
    acceleration = np.gradient(np.gradient(at_arm, t, axis=0), t, axis=0)
    there = attitude.inv().apply(acceleration + [0.0, 0.0, GRAVITY])
    return t, force, rates, TURN.inv().apply(rates), TURN.inv().apply(there)


def test_samples_are_those_of_an_imu_in_the_origin():
    t, force, rates, gyro, accel = mounted()
    mount = ImuMount(TURN, ARM)
    found = [mount.in_body(*row) for row in zip(t, gyro, accel)]
    for one, together in zip(zip(*found), ImuMount(TURN, ARM).all_in_body(t, gyro, accel)):
        np.testing.assert_allclose(together, one, atol=1e-12)
    inside = slice(50, -3)
    np.testing.assert_allclose(np.array([w for w, _ in found]), rates, atol=1e-12)
    error = np.abs(np.array([f for _, f in found]) - force)[inside]
    uncorrected = np.abs(TURN.apply(accel) - force)[inside]
    assert error.max() < 0.002 and uncorrected.max() > 0.2  # m/s^2; the rest is the delay of the low pass


def test_a_turn_alone_is_exact_and_needs_no_time():
    _, force, rates, _, _ = mounted()
    mount = ImuMount(TURN, np.zeros(3))
    gyro, accel = mount.in_body(0.0, TURN.inv().apply(rates[0]), TURN.inv().apply(force[0]))
    np.testing.assert_allclose(gyro, rates[0], atol=1e-12)
    np.testing.assert_allclose(accel, force[0], atol=1e-12)


def test_gaps_and_samples_out_of_order_do_no_harm():
    mount = ImuMount(TURN, ARM)
    for t in (0.0, 0.002, 0.002, 0.001, 5.0, 5.002):
        gyro, accel = mount.in_body(t, [0.0, 0.0, 0.0] if t < 5.0 else [0.0, 0.0, 3.0], [0.0, 0.0, GRAVITY])
        assert np.linalg.norm(np.array(accel) - TURN.apply([0.0, 0.0, GRAVITY])) < 9.0 * 0.3  # the centripetal part at most
    assert not np.isfinite(mount.in_body(5.004, [np.nan] * 3, [0.0, 0.0, GRAVITY])[0]).any()
