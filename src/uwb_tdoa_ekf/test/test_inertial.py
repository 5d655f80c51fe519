import numpy as np
import pytest

from uwb_tdoa_ekf.core.inertial import quiet, observe, trust
from uwb_tdoa_ekf.core.memory import LAST_IMU, FORCE, GYRO, MEAN_FORCE, new_memory
from uwb_tdoa_ekf.core.state import GRAVITY

UP = np.array([0.0, 0.0, GRAVITY])


def feed(gyro, force, rate=1000.0, seconds=3.0, m=None, pause=0.0, seed=0):
    """Memory after a stream of samples: gyro, force are (mean (3,), standard deviation)."""
    m, rng = m or new_memory(4), np.random.default_rng(seed)
    start = max(m.clock[LAST_IMU], 0.0) + pause
    for k in range(int(rate * seconds)):
        sample = [np.asarray(mean) + std * rng.standard_normal(3) for mean, std in (gyro, force)]
        t = start + (k + 1) / rate
        observe(m, t, *sample, 0.1)
        m.clock[LAST_IMU] = t
        m.imu[GYRO], m.imu[FORCE] = sample
    return m


STILL = dict(gyro=(np.zeros(3), 0.002), force=(UP, 0.02))


@pytest.mark.parametrize(
    "change, rests",
    [
        ({}, True),
        ({"gyro": (np.zeros(3), 0.05)}, False),
        ({"gyro": (np.array([0.0, 0.0, 0.1]), 0.002)}, False),
        ({"force": (UP, 0.3)}, False),
        ({"force": (UP + [1.0, 0.0, 0.0], 0.02)}, True),  # a metre per second squared sideways is a tilt of 6 degrees
        ({"force": (1.1 * UP, 0.02)}, False),
    ],
)
def test_rest(change, rests):
    assert quiet(feed(**{**STILL, **change})) == rests


def test_rest_is_not_believed_at_once_nor_after_a_gap():
    m = feed(**STILL, seconds=0.3)
    assert not quiet(m)
    m = feed(**STILL, m=m)
    assert quiet(m)
    assert not quiet(feed(**STILL, m=m, pause=1.0, seconds=0.3))


def test_the_more_an_axis_vibrates_the_less_it_is_believed():
    m = feed((np.zeros(3), 0.0), (UP, np.array([0.0, 0.5, 5.0])))
    shares, errors = zip(*(trust(m, k, 1.5, 4.0) for k in range(3)))
    assert shares[0] == pytest.approx(1.0, abs=1e-3) and shares[0] > shares[1] > 0.5 > 0.1 > shares[2]
    assert errors[2] == pytest.approx(shares[2] * 4.0 * 25.0, rel=0.2)
    assert trust(m, 2, 1.5, 0.0) == (1.0, 0.0)


def test_samples_are_averaged_with_the_last_one_unless_it_is_old():
    m = new_memory(4)
    for t, size, expected in ((0.0, 1.0, 1.0), (0.01, 3.0, 2.0), (1.0, 7.0, 7.0)):
        assert observe(m, t, np.full(3, size), np.full(3, 10.0 * size), 0.1) == (t == 0.01)
        np.testing.assert_allclose(m.imu[GYRO], expected)
        np.testing.assert_allclose(m.imu[FORCE], 10.0 * expected)
        m.imu[GYRO], m.imu[FORCE] = size, 10.0 * size
        m.clock[LAST_IMU] = t
    np.testing.assert_allclose(m.imu[MEAN_FORCE], 70.0)
