import numpy as np
import pytest

from uwb_tdoa_bias.common.vibration import (
    VIBRATION_AVERAGE,
    VIBRATION_CORNER,
    low_pass,
    track_vibration,
)


def test_low_pass_follows_a_step_with_its_time_constant():
    value, dt = 0.0, 1e-4
    for _ in range(round(VIBRATION_CORNER / dt)):
        value = low_pass(value, 1.0, dt, VIBRATION_CORNER)
    assert value == pytest.approx(1.0 - np.exp(-1.0), abs=1e-3)
    assert (
        low_pass(0.0, 5.0, 1.0, VIBRATION_CORNER) == 5.0
    )  # a step longer than that: the sample itself


def test_power_is_the_variance_of_what_is_fast_and_nothing_of_what_is_slow():
    slow, power, dt = np.zeros(3), np.zeros(3), 1e-3
    t = np.arange(0.0, 10.0 * VIBRATION_AVERAGE, dt)
    accel = np.stack(
        [np.sin(2 * np.pi * 100.0 * t), 2.0 * np.sin(2 * np.pi * 0.05 * t), np.full(len(t), 9.81)],
        axis=1,
    )
    for sample in accel:
        track_vibration(slow, power, sample, dt)
    assert power[0] == pytest.approx(0.5, rel=0.05)
    assert power[1] < 0.01 and slow[1] == pytest.approx(accel[-1, 1], abs=0.05)
    assert power[2] < 0.01 and slow[2] == pytest.approx(9.81)
