from finite_differences import numerical_jacobian
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from random_samples import random_rotation

from uwb_tdoa_bias.common.geometry import (
    linearized_tdoa,
    rotate,
    rotate_each,
    tdoa,
    tdoa_each,
    tdoa_jacobian,
)

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
    d, jacobian = tdoa(p, a, b), tdoa_jacobian(p, a, b)
    assert d.shape == (5, 4) and jacobian.shape == (5, 4, 3)
    assert d[2, 3] == tdoa(p[2, 0], a[3], b)
    np.testing.assert_array_equal(jacobian[2, 3], tdoa_jacobian(p[2, 0], a[3], b))


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
    jacobian = np.empty(3)
    assert linearized_tdoa(p, a, b, jacobian) == tdoa(p, a, b)
    np.testing.assert_array_equal(jacobian, tdoa_jacobian(p, a, b))


@given(seeds)
def test_rotate_is_the_rotation_of_scipy(seed):
    rng = np.random.default_rng(seed)
    turn, v, out = random_rotation(rng), rng.uniform(-10.0, 10.0, 3), np.empty(3)
    rotate(turn.as_quat(), v, out)
    np.testing.assert_allclose(out, turn.apply(v), atol=1e-12)


@given(seeds)
def test_one_vector_turned_by_many_attitudes(seed):
    rng = np.random.default_rng(seed)
    turns, v = [random_rotation(rng) for _ in range(4)], rng.normal(size=3)
    # of any length
    q = np.array([turn.as_quat() for turn in turns]) * rng.uniform(0.5, 2.0, (4, 1))
    out = np.empty((6, 3))
    rotate_each(np.concatenate([q, [[0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0]]]), v, out)
    np.testing.assert_allclose(out[:4], [turn.apply(v) for turn in turns], atol=1e-12)
    assert np.isnan(out[4:]).all()


@given(seeds)
def test_many_at_once_have_the_same_bits(seed):
    p, a, b = np.random.default_rng(seed).uniform(-10.0, 10.0, (3, 7, 3))
    out = np.empty(7)
    tdoa_each(p, a, b, out)
    np.testing.assert_array_equal(out, tdoa(p, a, b))
