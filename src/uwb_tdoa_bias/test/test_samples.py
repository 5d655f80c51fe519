from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm, samples_at
from uwb_tdoa_bias.effects.samples import motion_at, preceding

ANCHORS = Anchors.from_positions([[0, 0, 0], [8, 0, 0], [0, 8, 0], [0, 0, 3]], ids=[4, 5, 6, 7])
RATE = np.array([0.3, -0.5, 0.8])  # rad/s, body


def path(n=400, step=0.01):
    """A parabola that is flown while turning evenly: namespace of t, p, q, v."""
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
    """The regressors at true poses, and those of a Corrector that is told the same poses, are the
    same function.
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
