# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Geometry of TDOAs, transforms between frames, and antenna patterns."""

import math

from finite_differences import numerical_jacobian
from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_samples import random_rotation
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.geometry import (
    linearized_tdoa,
    rotate,
    rotate_each,
    tdoa,
    tdoa_each,
    tdoa_jacobian,
)
from uwb_tdoa_bias.common.radio import (
    DWM1000_AZIMUTH,
    DWM1000_ELEVATION_1,
    DWM1000_ELEVATION_2,
    Antenna,
)
from uwb_tdoa_bias.common.transforms import HELD, Frames

# --- geometry ---


seeds = st.integers(0, 2**32 - 1)


def points(seed, n=3):
    return np.random.default_rng(seed).uniform(-10.0, 10.0, (n, 3))


def test_sign_is_distance_to_b_minus_distance_to_a():
    a, b = np.array([0.0, 0.0, 0.0]), np.array([10.0, 0.0, 0.0])
    assert tdoa(np.array([2.0, 0.0, 0.0]), a, b) == 6.0  # close to a: heard from a first
    assert tdoa(np.array([8.0, 0.0, 0.0]), a, b) == -6.0
    assert tdoa(np.array([5.0, 4.0, -3.0]), a, b) == 0.0


def test_batches_broadcast():
    rng = np.random.default_rng(0)
    p, a, b = rng.normal(size=(5, 1, 3)), rng.normal(size=(4, 3)), rng.normal(size=3)
    for function, shape in ((tdoa, (5, 4)), (tdoa_jacobian, (5, 4, 3))):
        assert function(p, a, b).shape == shape
        np.testing.assert_array_equal(function(p, a, b)[2, 3], function(p[2, 0], a[3], b))


@given(seeds)
def test_jacobian_against_finite_differences(seed):
    p, a, b = points(seed)
    closest = min(np.linalg.norm(p - a), np.linalg.norm(p - b))
    numerical = numerical_jacobian(lambda at: tdoa(at, a, b), p, 1e-6 * max(closest, 1e-3))
    np.testing.assert_allclose(tdoa_jacobian(p, a, b), numerical[0], atol=1e-5)


def test_jacobian_on_an_antenna_keeps_the_other_anchor_only():
    a, b = np.zeros(3), np.array([4.0, 0.0, 0.0])
    assert tdoa_jacobian(a, a, b).tolist() == [-1.0, 0.0, 0.0]
    assert tdoa_jacobian(b, a, b).tolist() == [-1.0, 0.0, 0.0]


@given(seeds, st.sampled_from([None, "a", "b"]))
def test_a_single_tdoa_in_compiled_code_is_that_of_the_arrays_to_the_bit(seed, on_antenna):
    p, a, b = points(seed)
    p = {"a": a, "b": b}.get(on_antenna, p)
    jacobian, each = np.empty(3), np.empty(1)
    tdoa_each(p[None], a[None], b[None], each)
    assert linearized_tdoa(p, a, b, jacobian) == each[0] == tdoa(p, a, b)
    np.testing.assert_array_equal(jacobian, tdoa_jacobian(p, a, b))


@given(seeds)
def test_one_vector_turned_by_many_attitudes(seed):
    rng = np.random.default_rng(seed)
    turns, v = [random_rotation(rng) for _ in range(4)], rng.normal(size=3)
    # quaternions of any length
    q = np.array([turn.as_quat() for turn in turns]) * rng.uniform(0.5, 2.0, (4, 1))
    out = np.empty((6, 3))
    rotate_each(np.concatenate([q, [[0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0]]]), v, out)
    np.testing.assert_allclose(out[:4], [turn.apply(v) for turn in turns], atol=1e-12)
    assert np.isnan(out[4:]).all()
    rotate(turns[0].as_quat(), v, out[0])
    np.testing.assert_allclose(out[0], turns[0].apply(v), atol=1e-12)


# --- transforms ---


QUARTER = Rotation.from_euler("z", 90.0, degrees=True)  # 90 degrees to the left
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def robot():
    """Return frames of a robot: a mast on the base, an IMU on the mast, and a radio on the base.

    The IMU is turned by 90 degrees to the left.
    """
    frames = Frames()
    frames.set("base_link", "mast", IDENTITY, (0.1, 0.0, 0.5))
    frames.set("mast", "imu_link", QUARTER.as_quat(), (0.0, 0.2, 0.0))
    frames.set("base_link", "radio", IDENTITY, (0.0, 0.0, 0.3))
    return frames


def test_a_chain_of_constant_transforms():
    turn, p = robot().between("base_link", "imu_link")
    np.testing.assert_allclose(turn.apply([1.0, 0.0, 0.0]) + p, [0.1, 1.2, 0.5], atol=1e-12)
    back, q = robot().between("imu_link", "base_link")
    np.testing.assert_allclose(back.apply([0.1, 1.2, 0.5]) + q, [1.0, 0.0, 0.0], atol=1e-12)


def test_two_branches_meet_where_they_part():
    turn, p = robot().between("radio", "imu_link")
    np.testing.assert_allclose(turn.apply([0.0, 0.0, 0.0]) + p, [0.1, 0.2, 0.2], atol=1e-12)
    turn, p = robot().between("radio", "radio")
    assert turn.magnitude() == 0.0 and not p.any()


def test_what_nobody_says_is_not_known_and_a_loop_ends():
    frames = robot()
    assert frames.between("base_link", "camera") is None
    frames.set("camera", "lens", IDENTITY, (0.0, 0.0, 0.1))
    frames.set("lens", "camera", IDENTITY, (0.0, 0.0, 0.1))
    assert frames.between("base_link", "lens") is None


def test_a_frame_that_moves_is_interpolated_and_held_for_a_while():
    frames = robot()
    frames.move("odom", "base_link", IDENTITY, (0.0, 0.0, 0.0), 1.0)
    frames.move("odom", "base_link", QUARTER.as_quat(), (2.0, 0.0, 0.0), 2.0)
    frames.move("odom", "base_link", IDENTITY, (9.0, 0.0, 0.0), 1.9)  # not newer: ignored
    turn, p = frames.between("odom", "base_link", 1.5)
    assert turn.magnitude() == pytest.approx(np.pi / 4) and p.tolist() == [1.0, 0.0, 0.0]
    turn, p = frames.between("odom", "radio", 2.0 + HELD)
    assert turn.magnitude() == pytest.approx(np.pi / 2) and p.tolist() == [2.0, 0.0, 0.3]
    for t in (0.9, 2.01 + HELD, None):
        assert frames.between("odom", "base_link", t) is None


def test_a_frame_that_goes_back_in_time_starts_anew():
    frames = Frames()
    frames.move("odom", "base_link", IDENTITY, (5.0, 0.0, 0.0), 100.0)
    frames.move("odom", "base_link", IDENTITY, (1.0, 0.0, 0.0), 3.0)
    assert frames.between("odom", "base_link", 3.0)[1].tolist() == [1.0, 0.0, 0.0]
    assert frames.between("odom", "base_link", 100.0) is None


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)])
def test_what_is_no_rotation_is_refused(q):
    frames = Frames()
    for take in (frames.set, lambda *transform: frames.move(*transform, 1.0)):
        with pytest.raises(InputError, match="a -> b"):
            take("a", "b", q, (0.0, 0.0, 0.0))
        with pytest.raises(InputError, match="must be finite"):
            take("a", "b", (0.0, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0))
    assert frames.between("a", "b", 1.0) is None


def test_frames_are_bounded(monkeypatch):
    monkeypatch.setattr("uwb_tdoa_bias.common.transforms.MOST", 3)
    frames = robot()
    with pytest.raises(InputError, match="3 frames already"):
        frames.set("base_link", "camera", IDENTITY, (0.0, 0.0, 0.0))
    assert frames.set("base_link", "radio", IDENTITY, (1.0, 0.0, 0.0))  # a known frame may move


def test_a_transform_that_is_sent_again_with_jitter_is_no_other():
    frames = Frames()
    assert frames.set("base_link", "imu", (0.0, 0.0, 0.0, 1.0), (0.1, 0.0, 0.0))
    for k in range(1, 50):  # small steps do not add up to a motion
        assert not frames.set(
            "base_link", "imu", (0.0, 0.0, 1e-6, 1.0), (0.1 + 1e-4 * min(k, 9), 0.0, 0.0)
        )
    assert frames.between("base_link", "imu")[1].tolist() == [0.1, 0.0, 0.0]
    assert frames.set("base_link", "imu", (0.0, 0.0, 1e-3, 1.0), (0.1, 0.0, 0.0))
    assert frames.set("base_link", "imu", (0.0, 0.0, 1e-3, 1.0), (0.102, 0.0, 0.0))


# --- antenna ---


angles = st.floats(-np.pi, np.pi)


def towards(theta, phi):
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack(
        [np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=-1
    )


def test_azimuth_cut_is_met_exactly():
    theta = np.deg2rad(30.0 * np.arange(12))
    np.testing.assert_allclose(Antenna().gain(towards(theta, 0.0)), DWM1000_AZIMUTH, atol=1e-9)


@pytest.mark.parametrize(
    ("cut", "theta"), [(DWM1000_ELEVATION_1, 0.0), (DWM1000_ELEVATION_2, 90.0)]
)
def test_elevation_cuts_are_met_away_from_the_plane(cut, theta):
    """On an elevation cut, equation 14 keeps 1 - cos^40: all but 0.4 % from 30 degrees on."""
    around = np.deg2rad(30.0 * np.arange(12))
    azimuth = np.deg2rad(theta)
    direction = np.cos(around)[:, None] * towards(azimuth, 0.0) + np.sin(around)[
        :, None
    ] * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(Antenna().gain(direction), cut, atol=0.05)
    steep = [2, 3, 4, 8, 9, 10]
    np.testing.assert_allclose(Antenna().gain(direction)[steep], np.array(cut)[steep], atol=1e-6)


def test_blend_is_equation_14():
    antenna = Antenna()
    theta, phi = np.deg2rad(30.0), np.deg2rad(30.0)
    a3 = np.cos(phi) ** 40
    a1, a2 = np.cos(theta) ** 2 * (1 - a3), (1 - np.cos(theta) ** 2) * (1 - a3)
    expected = a1 * DWM1000_ELEVATION_1[1] + a2 * DWM1000_ELEVATION_2[1] + a3 * DWM1000_AZIMUTH[1]
    assert antenna.gain(towards(theta, phi)) == pytest.approx(expected, abs=1e-9)
    # x < 0, y < 0
    expected = a1 * DWM1000_ELEVATION_1[5] + a2 * DWM1000_ELEVATION_2[5] + a3 * DWM1000_AZIMUTH[7]
    assert antenna.gain(towards(np.pi + theta, phi)) == pytest.approx(expected, abs=1e-9)


@given(angles, st.floats(-1.57, 1.57), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_pattern_is_continuous(theta, phi, d_theta, d_phi):
    antenna, step = Antenna(), 1e-6
    one, other = towards(theta, phi), towards(theta + step * d_theta, phi + step * d_phi)
    assert abs(antenna.gain(one) - antenna.gain(other)) < 200.0 * step
    assert abs(antenna.group_delay(one) - antenna.group_delay(other)) < 10.0 * step


def test_cuts_that_do_not_meet_are_refused():
    with pytest.raises(InputError, match=r"cross at \+x"):
        Antenna(azimuth=(0.0, *DWM1000_AZIMUTH[1:]))
    with pytest.raises(InputError, match="multiple of 4"):
        Antenna(azimuth=(1.0, 2.0, 3.0))


def test_delay_is_late_and_largest_in_the_nulls():
    antenna = Antenna()
    sphere = np.random.default_rng(1).standard_normal((20000, 3))
    delay = antenna.group_delay(sphere)
    assert delay.min() >= 0.0 and delay.max() <= antenna.delay_span
    down, up, front = (
        antenna.group_delay(np.array(v)) for v in ((0, 0, -1.0), (0, 0, 1.0), (1.0, 0, 0))
    )
    assert down > up > 0.08 and front < 1e-3
    assert np.corrcoef(antenna.gain(sphere), delay)[0, 1] < -0.9
