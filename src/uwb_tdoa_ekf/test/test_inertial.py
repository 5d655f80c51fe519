import numpy as np
import pytest

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.inertial import (
    LEAST_RECTIFIED,
    PERSISTENCE,
    QUIET_NOISE,
    RECTIFYING_MEMORY,
    is_quiet,
    observe,
    store,
    weigh,
)
from uwb_tdoa_ekf.core.memory import IMU_SAMPLE, new_state
from uwb_tdoa_ekf.core.state import GRAVITY

UP = np.array([0.0, 0.0, GRAVITY])


def sample_of(t, gyro, accel):
    return np.array([(t, tuple(gyro), tuple(accel))], IMU_SAMPLE)[0]


def fresh():
    return new_state(np.zeros((4, 3))).record.imu


def after(gyro, accel, rate=1000.0, seconds=3.0, imu=None, pause=0.0, seed=0):
    """IMU_STATE after a stream of samples: gyro, accel are (mean (3,), standard deviation)."""
    imu, rng = fresh() if imu is None else imu, np.random.default_rng(seed)
    start = max(imu.t, 0.0) + pause
    for k in range(int(rate * seconds)):
        rates, accels = (
            np.asarray(mean) + std * rng.standard_normal(3) for mean, std in (gyro, accel)
        )
        sample = sample_of(start + (k + 1) / rate, rates, accels)
        observe(imu, sample, 0.1)
        store(imu, sample)
    return imu


STILL = dict(gyro=(np.zeros(3), 0.002), accel=(UP, 0.02))


@pytest.mark.parametrize(
    "change, rests",
    [
        ({}, True),
        ({"gyro": (np.zeros(3), 0.05)}, False),
        ({"gyro": (np.array([0.0, 0.0, 0.1]), 0.002)}, False),
        ({"accel": (UP, 0.3)}, False),
        # a metre per second squared sideways is a tilt of 6 degrees
        ({"accel": (UP + [1.0, 0.0, 0.0], 0.02)}, True),
        ({"accel": (1.1 * UP, 0.02)}, False),
    ],
)
def test_rest(change, rests):
    assert is_quiet(after(**{**STILL, **change})) == rests


def test_rest_is_not_believed_at_once_nor_after_a_gap():
    imu = after(**STILL, seconds=0.3)
    assert not is_quiet(imu)
    imu = after(**STILL, imu=imu)
    assert is_quiet(imu)
    assert not is_quiet(after(**STILL, imu=imu, pause=1.0, seconds=0.3))


def test_the_more_an_axis_rectifies_the_less_it_weighs_and_the_noisier_it_is():
    vibration = np.array([0.0, 0.5, 5.0])
    imu = after((np.zeros(3), 0.0), (UP + vibration, vibration))
    weigh(
        imu,
        False,
        FilterConfig(accel_prior_std=1.5, vibration_gain=4.0, accel_noise=0.1).parameters()[0],
    )
    one, two, three = imu.accel_weight
    assert one == pytest.approx(1.0, abs=1e-3) and one > two > 0.5 > 0.1 > three
    assert imu.accel_psd[2] == pytest.approx(
        0.1**2 + 2.0 * PERSISTENCE * three * 4.0 * 25.0, rel=0.2
    )
    weigh(imu, False, FilterConfig(vibration_gain=0.0, accel_noise=0.1).parameters()[0])
    assert imu.accel_weight.tolist() == [1.0] * 3 and imu.accel_psd == pytest.approx([0.1**2] * 3)
    weigh(imu, True, FilterConfig().parameters()[0])
    assert imu.accel_psd == pytest.approx([QUIET_NOISE**2] * 3)


def test_an_axis_whose_mean_is_that_of_hovering_does_not_rectify_however_it_vibrates():
    parameters = FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0]
    weights = {}
    for offset in (0.0, 3.0):
        imu = after(
            (np.zeros(3), 0.0), (UP + [offset, 0.0, 0.0], 3.0), seconds=4.0 * RECTIFYING_MEMORY
        )
        weigh(imu, False, parameters)
        weights[offset] = imu.accel_weight
    error = 4.0 * 3.0**2
    assert weights[3.0][0] == pytest.approx(
        1.5**2 / (1.5**2 + error), rel=0.2
    )  # as if nothing were known of its mean
    for weight in (weights[0.0][0], weights[3.0][1], weights[3.0][2]):
        assert weight == pytest.approx(1.5**2 / (1.5**2 + LEAST_RECTIFIED * error), rel=0.1)


def test_what_begins_to_vibrate_is_not_believed_before_it_was_seen_for_a_while():
    parameters = FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0]
    imu = after(**STILL)
    imu = after((np.zeros(3), 0.0), (UP, 1.0), imu=imu, seconds=0.5)
    weigh(imu, False, parameters)
    early = imu.accel_weight.copy()
    imu = after((np.zeros(3), 0.0), (UP, 1.0), imu=imu, seconds=4.0 * RECTIFYING_MEMORY)
    weigh(imu, False, parameters)
    assert (early < 0.6).all() and (imu.accel_weight > 0.8).all()


@pytest.mark.parametrize("force", [-UP, np.array([np.linalg.norm(UP), 0.0, 0.0])])
def test_what_hangs_upside_down_or_lies_on_its_side_does_not_hover_however_it_shakes(force):
    imu = after((np.zeros(3), 0.0), (force, np.array([5.0, 5.0, 5.0])))
    weigh(imu, False, FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0])
    assert imu.accel_weight.min() > 0.75


def test_samples_are_averaged_with_the_last_one_unless_it_is_old():
    imu = fresh()
    for t, size, expected in ((0.0, 1.0, 1.0), (0.01, 3.0, 2.0), (1.0, 7.0, 7.0)):
        sample = sample_of(t, [size] * 3, [10.0 * size] * 3)
        assert observe(imu, sample, 0.1) == (t == 0.01)
        np.testing.assert_allclose(imu.gyro, expected)
        np.testing.assert_allclose(imu.accel, 10.0 * expected)
        store(imu, sample)
        np.testing.assert_allclose(imu.gyro, size)
    np.testing.assert_allclose(imu.mean_accel, 70.0)


def test_what_is_far_from_hovering_is_taken_for_what_it_is_however_it_vibrates():
    """A turn with 3 g; a vibrating sensor that is off by as much as vibration makes it stays
    between.
    """
    parameters = FilterConfig(accel_prior_std=1.5, vibration_gain=4.0).parameters()[0]
    weights = {}
    for force in (1.0, 1.2, 3.0):
        imu = after((np.zeros(3), 0.0), (force * UP, 1.0))
        weigh(imu, False, parameters)
        weights[force] = imu.accel_weight[2]
    assert weights[1.2] < 0.6 < weights[1.0] and weights[3.0] > 0.95
