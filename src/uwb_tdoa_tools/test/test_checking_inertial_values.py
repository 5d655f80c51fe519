"""Saturated and filtered inertial samples."""

import numpy as np
import pytest
from scipy.signal import lfilter

from uwb_tdoa_bias.foundation.flight import Flight, Imu
from uwb_tdoa_tools.checking.imu_rules import saturated, smooth

T = np.arange(0.0, 20.0, 0.001)
VALUES = np.random.default_rng(0).standard_normal((len(T), 3))


def of(gyro=VALUES, accel=VALUES):
    return [finding.cause for finding in saturated(Flight("f", None, None, Imu(T, gyro, accel)))]


def test_noise_is_not_saturated_nor_what_an_adc_makes_of_it():
    coarse = np.round(VALUES / 0.3) * 0.3
    assert of() == of(coarse, np.zeros_like(VALUES)) == []


@pytest.mark.parametrize("low, high", [(-2.0, 2.0), (-9.0, 1.5), (-1.8, 9.0)])
def test_one_axis_is_saturated_at_one_end_or_both(low, high):
    accel = VALUES.copy()
    accel[:, 1] = np.clip(accel[:, 1], low, high)
    assert of(accel=accel) == ["accelerometer y is clipped"]


def test_a_low_pass_makes_smooth_and_slow_samples_say_nothing():
    share = 0.001 / 0.051
    filtered = lfilter([share], [1.0, share - 1.0], VALUES, axis=0)
    assert smooth(T, np.cumsum(filtered, axis=0)) and not smooth(T, VALUES)
    assert not smooth(20.0 * T, np.cumsum(filtered, axis=0))
