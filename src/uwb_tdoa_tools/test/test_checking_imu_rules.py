"""Clipped and filtered samples, and axes of the IMU, tried on a tag that turns."""

from checking_flights import recording
import numpy as np
import pytest
from scipy.signal import lfilter

from uwb_tdoa_bias.common.flight import Flight, Imu
from uwb_tdoa_tools.checking import imu_rules
from uwb_tdoa_tools.checking.imu_rules import clipped_axes, is_smooth
from uwb_tdoa_tools.checking.ordered import OrderedRecording

T = np.arange(0.0, 20.0, 0.001)
VALUES = np.random.default_rng(0).standard_normal((len(T), 3))


def causes(gyro=VALUES, accel=VALUES):
    return [finding.cause for finding in clipped_axes(Flight("f", None, None, Imu(T, gyro, accel)))]


def test_noise_is_not_clipped_even_if_quantized():
    coarse = np.round(VALUES / 0.3) * 0.3
    assert causes() == causes(coarse, np.zeros_like(VALUES)) == []


@pytest.mark.parametrize("low, high", [(-2.0, 2.0), (-9.0, 1.5), (-1.8, 9.0)])
def test_a_clipped_axis_is_found(low, high):
    accel = VALUES.copy()
    accel[:, 1] = np.clip(accel[:, 1], low, high)
    assert causes(accel=accel) == ["accelerometer y is clipped"]


def test_samples_behind_a_low_pass_are_smooth():
    share = 0.001 / 0.051
    filtered = lfilter([share], [1.0, share - 1.0], VALUES, axis=0)
    assert is_smooth(T, np.cumsum(filtered, axis=0)) and not is_smooth(T, VALUES)
    assert not is_smooth(20.0 * T, np.cumsum(filtered, axis=0))


@pytest.fixture(scope="module")
def healthy():
    return OrderedRecording.of(recording())


def test_a_healthy_imu_has_no_finding(healthy):
    assert imu_rules.find_imu_mistake(healthy) is None


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(3))
def test_a_wrong_sign_of_the_gyroscope_is_found(healthy, axis):
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    finding = imu_rules.find_imu_mistake(healthy.with_imu(gyro=healthy.imu.gyro * signs))
    assert finding.rule == "imu_axes" and "gyroscope" in finding.cause


@pytest.mark.slow
def test_a_turn_about_the_vertical_cannot_be_seen(healthy):
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = healthy.with_imu(
        gyro=healthy.imu.gyro @ quarter.T, accel=healthy.imu.accel @ quarter.T
    )
    assert imu_rules.find_imu_mistake(turned) is None


def test_means_of_samples_keep_rate_and_mean(healthy):
    thin = imu_rules.averaged(healthy.imu)
    assert 1.0 / np.median(np.diff(thin.t)) == pytest.approx(imu_rules.RATE, rel=0.01)
    assert np.allclose(thin.accel.mean(axis=0), healthy.imu.accel.mean(axis=0), atol=1e-2)
    assert imu_rules.averaged(None) is None


@pytest.mark.parametrize(
    "accel, gyro, words",
    [
        (np.eye(3), np.diag([1.0, -1.0, 1.0]), "w.x, w.y, w.z = w.x, -w.y, w.z"),
        (
            imu_rules.MIRROR,
            imu_rules.MIRROR,
            "a.x, a.y, a.z = a.x, -a.y, a.z; w.x, w.y, w.z = w.x, -w.y, w.z",
        ),
        (np.eye(3), np.eye(3)[[1, 2, 0]], "w.x, w.y, w.z = w.y, w.z, w.x"),
    ],
)
def test_the_remedy_is_the_matrix_in_words(accel, gyro, words):
    assert imu_rules._finding(accel, gyro, "", 0.5).remedy == words


def test_simple_arrangements_come_first():
    simple = imu_rules._complexity(np.eye(3), np.diag([1.0, -1.0, 1.0]))
    both, odd = (
        imu_rules._complexity(imu_rules.MIRROR, imu_rules.MIRROR),
        imu_rules._complexity(np.eye(3), -np.eye(3)[[1, 2, 0]]),
    )
    assert 0.0 == imu_rules._complexity(np.eye(3), np.eye(3)) < simple < both < odd
