# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Samples of TDOAs with the motion of the tag, and the inputs of a network."""

from dataclasses import replace
from types import SimpleNamespace

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_samples import random_samples
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.vibration import (
    VIBRATION_AVERAGE,
    VIBRATION_CORNER,
    low_pass,
    track_vibration,
)
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import ATTITUDE, FEATURES, NAMES, columns, everything
from uwb_tdoa_bias.effects import EffectSet, Samples, SmoothTerm, samples_at
from uwb_tdoa_bias.effects.samples import Motion, covariate_of, motion_at, preceding

# --- samples ---


ANCHORS = Anchors.from_positions([[0, 0, 0], [8, 0, 0], [0, 8, 0], [0, 0, 3]], ids=[4, 5, 6, 7])
RATE = np.array([0.3, -0.5, 0.8])  # rad/s, body


def path(n=400, step=0.01):
    """Return t, p, q, v of a tag on a parabola that turns at a constant rate."""
    t = 5.0 + step * np.arange(n)
    s = (t - t[0])[:, None]
    p = np.array([1.0, 2.0, 1.0]) + s * [0.5, -0.2, 0.1] + 0.5 * s**2 * [0.2, 0.4, -0.1]
    v = np.array([0.5, -0.2, 0.1]) + s * [0.2, 0.4, -0.1]
    return SimpleNamespace(t=t, p=p, q=Rotation.from_rotvec(s * RATE).as_quat(), v=v)


def test_of_an_even_acceleration_and_turn():
    poses = path()
    found = motion_at(poses.t, poses.v, poses.q, np.array([-1, 10, 30, 100, 399]))
    assert (
        np.isnan(found.velocity[0]).all()
        and np.isnan(found.acceleration[:2]).all()
        and np.isnan(found.rate[:2]).all()
    )
    np.testing.assert_array_equal(found.velocity[1:], poses.v[[10, 30, 100, 399]])
    np.testing.assert_allclose(found.acceleration[2:], [[0.2, 0.4, -0.1]] * 3, atol=1e-9)
    np.testing.assert_allclose(found.rate[2:], [RATE] * 3, atol=1e-9)


def test_an_attitude_that_is_not_known_has_no_rate():
    poses = path()
    poses.q[:] = np.nan
    found = motion_at(poses.t, poses.v, poses.q, np.array([100]))
    assert np.isnan(found.rate).all() and np.isfinite(found.velocity).all()


@given(st.lists(st.floats(0, 100), min_size=1, max_size=20), st.none() | st.floats(0, 100))
def test_the_preceding_stamp_is_that_of_the_newest_before(t, newest):
    t = np.array(t)
    found = preceding(t, newest)
    for k in range(len(t)):
        earlier = [*t[:k], *([] if newest is None else [newest])]
        assert found[k] == min(t[k], max(earlier, default=t[k]))


@pytest.mark.parametrize(
    "covariate",
    ["speed", "climb_rate", "acceleration", "turning_rate", "interval", "previous_anchor"],
)
def test_what_is_learned_is_what_is_applied(covariate):
    """Training and correction use the same regressors.

    A fit computes them at true poses. Here, a Corrector gets the same poses.
    """
    poses = path()
    t = np.sort(np.random.default_rng(1).uniform(5.8, 8.9, 60))
    a, b = np.arange(60) % 4, (np.arange(60) + 1) % 4
    knots = (4.0, 5.0, 6.0, 7.0) if covariate == "previous_anchor" else (0.0, 0.3, 1.0, 2.0)
    values = {
        f"c{k}": 0.1 * (k + 1) ** 2 for k in range(6 if covariate != "previous_anchor" else 4)
    }
    term = SmoothTerm(values=values, covariate=covariate, form="common", knots=knots)
    learned = samples_at(t, a, b, poses, ANCHORS, t[0])
    corrector = Corrector(ANCHORS, EffectSet((term,)))
    corrector.add_pose(poses.t, poses.p, poses.q, poses.v)
    applied = corrector.samples(t, a, b)
    if covariate in ("interval", "previous_anchor"):
        np.testing.assert_array_equal(applied.interval, np.diff(t, prepend=t[0]))
        np.testing.assert_array_equal(applied.previous, np.concatenate([[-1], ANCHORS.ids[b[:-1]]]))
        return
    np.testing.assert_allclose(applied.motion.velocity, learned.motion.velocity, atol=1e-9)
    np.testing.assert_allclose(term.bias(applied), term.bias(learned), atol=1e-9)
    assert np.abs(term.bias(applied)).min() > 0.01


@given(seed=st.integers(0, 10**6))
def test_covariates_of_pose_and_velocity(seed):
    samples = random_samples(seed, 20)
    v = np.random.default_rng(seed).standard_normal((20, 3))
    moving = replace(samples, motion=Motion(v, v, v))
    ends = samples.position_a, samples.position_b

    def ranges(seconds):
        p = samples.p + seconds * v
        return np.concatenate([np.linalg.norm(p - end, axis=1) for end in ends])

    rate = (ranges(1e-5) - ranges(-1e-5)) / 2e-5
    np.testing.assert_allclose(covariate_of(moving, "range_rate"), rate, atol=1e-6)
    assert np.isnan(covariate_of(samples, "range_rate")).all()
    of_a, of_b = ranges(0.0).reshape(2, -1)
    farther = np.concatenate([of_a - of_b, of_b - of_a])
    np.testing.assert_allclose(covariate_of(samples, "range_difference"), farther)
    yaw = Rotation.from_quat(samples.q).as_euler("ZYX")[:, 0]
    off = np.exp(1j * covariate_of(samples, "yaw")) - np.exp(1j * yaw)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_batches_know_what_was_heard_before():
    poses = path()
    term = SmoothTerm(covariate="interval", knots=(0.0, 1.0))
    whole, parts = (Corrector(ANCHORS, EffectSet((term,))) for _ in range(2))
    t, a, b = np.arange(6.0, 7.0, 0.1), np.arange(10) % 4, (np.arange(10) + 1) % 4
    for corrector in (whole, parts):
        corrector.add_pose(poses.t, poses.p, poses.q, poses.v)
    expected = whole.samples(t, a, b)
    found = [parts.samples(t[k : k + 3], a[k : k + 3], b[k : k + 3]) for k in range(0, 10, 3)]
    for name in ("interval", "previous"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(part, name) for part in found]), getattr(expected, name)
        )


# --- features ---


seeds = st.integers(0, 2**32 - 1)


def expected(samples):
    """Compute every feature from its definition."""
    anchors, out = samples.anchors, {}
    for side, rows in (("a", samples.a), ("b", samples.b)):
        to_anchor = anchors.positions[rows] - samples.p
        for k, axis in enumerate("xyz"):
            out[f"d{axis}_{side}"] = to_anchor[:, k]
        seen_by_tag = Rotation.from_quat(samples.q).inv().apply(to_anchor)
        seen_by_anchor = Rotation.from_quat(anchors.orientations[rows]).inv().apply(-to_anchor)
        for viewer, direction in (("T", seen_by_tag), ("A", seen_by_anchor)):
            x, y, z = direction.T / np.linalg.norm(direction, axis=1)
            out[f"azimuth_{viewer}_{side}"] = np.arctan2(y, x)
            out[f"elevation_{viewer}_{side}"] = np.arcsin(z)
    return np.stack([out[name] for name in FEATURES], axis=1)


@given(seeds)
def test_attitudes(seed):
    samples = random_samples(seed)
    body = Rotation.from_quat(samples.q).as_matrix()
    expected_attitude = np.concatenate([body[:, :2, 0], body[:, :2, 2]], axis=1)
    np.testing.assert_allclose(columns(samples, ATTITUDE), expected_attitude, atol=1e-12)
    np.testing.assert_array_equal(columns(samples, NAMES[::-1]), everything(samples)[:, ::-1])


@given(seeds)
def test_definitions(seed):
    samples = random_samples(seed)
    # The slope of arcsin is large near the pole.
    np.testing.assert_allclose(columns(samples, FEATURES), expected(samples), atol=1e-6)


def test_unknown_attitudes_make_only_their_own_angles_nan():
    samples = random_samples(3, n=4, n_anchors=2)
    orientations = samples.anchors.orientations.copy()
    orientations[0] = np.nan
    q = samples.q.copy()
    q[:2] = np.nan
    anchors = Anchors(samples.anchors.ids, samples.anchors.positions, orientations)
    unknown = Samples(
        samples.t, np.array([0, 1, 0, 1]), np.array([1, 0, 1, 0]), samples.p, q, anchors
    )
    found = columns(unknown, FEATURES)
    for i in range(4):
        for k, name in enumerate(FEATURES):
            row = unknown.a[i] if name.endswith("_a") else unknown.b[i]
            needs_tag, needs_anchor = "_T_" in name, "_A_" in name
            lost = (needs_tag and i < 2) or (needs_anchor and row == 0)
            assert np.isnan(found[i, k]) == lost, (i, name)


# --- vibration ---


def test_low_pass_follows_a_step_with_its_time_constant():
    value, dt = 0.0, 1e-4
    for _ in range(round(VIBRATION_CORNER / dt)):
        value = low_pass(value, 1.0, dt, VIBRATION_CORNER)
    assert value == pytest.approx(1.0 - np.exp(-1.0), abs=1e-3)
    # A step longer than the time constant returns the sample itself.
    assert low_pass(0.0, 5.0, 1.0, VIBRATION_CORNER) == 5.0


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
