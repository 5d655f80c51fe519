# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Implausible inertial samples are left out at once. Later good samples are used again.

Healthy samples are always used; test_stream_watch.py checks this for measured flights.
"""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.engine import feed
from uwb_tdoa_ekf.core.imu_fault_detector import CLEARED, RATE, TILT, TURN, WEIGHT
from uwb_tdoa_ekf.core.memory import IMU_SAMPLE, TDOA, Measurements, new_state, structured
from uwb_tdoa_ekf.core.state import GRAVITY
from uwb_tdoa_ekf.monitoring.finding import implausible

T = np.arange(3000) / 200.0
BEGIN, END = 5.0, 9.0  # s, begin and end of a fault
BAD = ((T >= BEGIN) & (T < END))[:, None]


def swaying(yaw_rate=0.05):
    """Return rates and specific force of a tag that sways by some 10 degrees and turns."""
    angles = np.stack([yaw_rate * T, 0.2 * np.sin(1.3 * T), 0.15 * np.sin(1.7 * T)], axis=1)
    return sensed(Rotation.from_euler("ZYX", angles))


def sensed(attitude, acceleration=0.0):
    """Return rates and specific force for attitudes at T.

    acceleration : (n, 3), in m/s^2 in the world.
    """
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / np.diff(T)[:, None]
    return np.vstack([turns, turns[-1:]]), attitude.inv().apply(
        np.broadcast_to(acceleration + np.array([0, 0, GRAVITY]), (len(T), 3))
    )


def left_out(gyro, accel):
    """Return [(s, reason)] of the samples that are left out."""
    state, parameters, out = new_state(np.zeros((4, 3))), FilterConfig().parameters(), []
    for row in structured(IMU_SAMPLE, T, gyro, accel)[:, None]:
        feed(state, parameters, Measurements(row, np.empty(0, TDOA)))
        if state.record.imu_faulty:
            out.append((row["t"][0], int(state.record.imu_fault_detector.reason)))
    return out


FAULTS = {
    "in g": (lambda w, f: (w, f / GRAVITY), WEIGHT, 0.4),
    "in mg": (lambda w, f: (w, 1e3 * f / GRAVITY), WEIGHT, 0.4),
    "without gravity": (lambda w, f: (w, f - [0.0, 0.0, GRAVITY]), WEIGHT, 0.4),
    "silent": (lambda w, f: (0.0 * w, 0.0 * f), WEIGHT, 0.4),
    "upside down": (lambda w, f: (w, f * [1.0, -1.0, -1.0]), TURN, 0.1),
    "axes exchanged": (lambda w, f: (w, f[:, [2, 0, 1]]), TURN, 0.4),
    "degrees/s": (lambda w, f: (np.rad2deg(w), f), TURN, 1.0),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_seen_within_a_second_and_its_end_after_another(fault):
    change, reason, within = FAULTS[fault]
    gyro, accel = swaying()
    wrong = (
        np.where(BAD, changed, right) for changed, right in zip(change(gyro, accel), (gyro, accel))
    )
    stamps, reasons = map(np.array, zip(*left_out(*wrong)))
    assert reasons[0] == reason
    assert BEGIN <= stamps[0] < BEGIN + within and END < stamps[-1] < END + CLEARED + 0.3
    assert np.sum(stamps < END) > 0.9 * 200.0 * (END - stamps[0])


def test_a_spin_about_the_vertical_in_degrees_is_faster_than_anything_turns():
    gyro, accel = sensed(Rotation.from_euler("Z", 0.5 * T))
    stamps, reasons = map(np.array, zip(*left_out(np.where(BAD, np.rad2deg(gyro), gyro), accel)))
    assert reasons[0] == RATE and stamps[0] < BEGIN + 0.4


def test_what_a_tag_may_do_is_no_fault():
    """The tag falls, is hit, spins and is turned on its back for a while.

    It also banks with its thrust, the only force that a multirotor feels.
    """
    fall = np.where((T > 5.0) & (T < 5.2), -GRAVITY, 0.0) + np.where(
        (T > 5.2) & (T < 5.25), 4.0 * GRAVITY, 0.0
    )
    bank = np.interp(T, [5.0, 5.5, 7.0, 7.5], np.deg2rad([0.0, 60.0, 60.0, 0.0]))
    # as a controller that is pulled up and down
    swing = np.where(np.sin(2.0 * np.pi * 0.6 * T) > 0.0, 0.3, 1.5) * GRAVITY
    turn = np.interp(T, [5.0, 5.5, 9.0, 9.5], [1.0, 3.3, 3.3, 1.0]) * GRAVITY
    over = np.interp(T, [5.0, 6.0, 8.0, 9.0], [0.0, np.pi, np.pi, 0.0])
    thrust = (GRAVITY / np.cos(bank))[:, None] * [0.0, 0.0, 1.0]
    rest = Rotation.from_euler("X", 0.0 * T)
    for gyro, accel in (
        sensed(rest, fall[:, None] * [0.0, 0.0, 1.0]),
        sensed(Rotation.from_euler("Z", 9.0 * T)),
        sensed(Rotation.from_euler("X", over)),
        (sensed(Rotation.from_euler("X", bank))[0], thrust),
    ):
        assert left_out(gyro, accel) == []
    for force in (swing, turn):
        assert left_out(sensed(rest)[0], force[:, None] * [0.0, 0.0, 1.0]) == []


def test_a_drone_that_races_leans_for_seconds_and_is_no_fault():
    """Its thrust is its only force, and tilts it by up to 74 degrees at 11 m/s, with 3.5 g."""
    rates, far = np.array([1.94, 2.54]), 4.5  # rad/s and m
    begun = np.clip(T / 3.0, 0.0, 1.0)[:, None]
    lean = begun * far * rates**2 * np.sin(rates * T[:, None] + [0.0, 1.0])
    up = np.column_stack([lean, np.full(len(T), GRAVITY)])
    angle = np.arctan2(np.hypot(up[:, 0], up[:, 1]), GRAVITY)
    axis = np.cross([0.0, 0.0, 1.0], up)
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-9)[:, None]
    gyro, accel = sensed(
        Rotation.from_rotvec(angle[:, None] * axis), np.column_stack([lean, 0 * T])
    )
    assert np.linalg.norm(accel, axis=1).max() > 3.5 * GRAVITY
    assert left_out(gyro, accel) == []


def test_a_tag_that_lies_on_its_back_goes_without_after_some_seconds():
    said = left_out(*sensed(Rotation.from_euler("X", np.interp(T, [3.0, 4.0], [0.0, np.pi]))))
    assert 6.0 < said[0][0] < 7.2 and said[0][1] == TILT and said[-1][0] == T[-1]


@pytest.mark.parametrize(
    ("turn", "says"), [([1.0, -1.0, -1.0], r"-9\.\d m/s\^2"), ([0.0, 0.0, 0.0], r"of 0 m/s\^2")]
)
def test_what_is_said_has_the_number_of_the_sensor(turn, says):
    """The number was once 1.0 whatever the sensor read.

    The attribute `size` of a numpy record is its number of elements and hides a field of that name.
    """
    gyro, accel = (values * turn for values in swaying())
    state, parameters = new_state(np.zeros((4, 3))), FilterConfig().parameters()
    feed(state, parameters, Measurements(structured(IMU_SAMPLE, T, gyro, accel), np.empty(0, TDOA)))
    found = implausible(state.record.imu_fault_detector)
    assert re.search(says, found.evidence), found.evidence
