import numpy as np
import pytest

from uwb_tdoa_ekf.core import noise
from uwb_tdoa_ekf.core.memory import new_state

ANCHORS = np.array([[x, y, z] for x in (0.0, 7.0) for y in (0.0, 8.0) for z in (0.2, 3.0)])
STD = 0.25


def informed(p, seconds=5.0, rate=400.0, heard=range(8), state=None, begin=0.0):
    """A FilterState that has taken TDOAs round the ring of the anchors `heard` at a place p (3,)."""
    state, heard = state or new_state(ANCHORS), list(heard)
    anchors, information = state.anchors, state.record.information
    way = np.array(p) - ANCHORS
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    for k in range(int(seconds * rate)):
        a, b = heard[k % len(heard)], heard[(k + 1) % len(heard)]
        innovation = state.record.innovation
        innovation.row[:3] = unit[b] - unit[a]
        innovation.noise_variance, innovation.weight, innovation.curvature = STD**2, 1.0, 0.0
        t = begin + k / rate
        last = t - 1.0 / rate if k else -np.inf
        noise.observe(information, anchors[a], anchors[b], innovation, t, last)
    return state


def stated(state, P, correlation_length=np.inf, height_std=0.0):
    covariance = np.full((3, 3), np.nan)
    whole = np.zeros((15, 15))
    whole[:3, :3] = P
    noise.fill(state.record.information, whole, correlation_length, height_std, covariance)
    return covariance


@pytest.mark.parametrize("p", [[3.0, 4.0, 1.5], [1.0, 6.0, 0.5]])
def test_it_is_the_covariance_of_a_position_by_one_arrival_from_each_anchor(p):
    """Least squares with an error of its own for each anchor, and a common one of the clock."""
    way = np.array(p) - ANCHORS
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    centred = unit - unit.mean(axis=0)
    of_anchor = noise.SHARE * STD**2 / 2.0
    expected = np.linalg.inv(centred.T @ centred) * of_anchor
    # a ring of neighbours weighs directions a little differently from all pairs
    found = stated(informed(p), 1e3 * np.eye(3))
    assert 0.4 < np.trace(found) / np.trace(expected) < 2.5


def test_it_does_not_become_less_with_more_tdoas():
    slow, quick = (
        np.trace(stated(informed([3.0, 4.0, 1.5], rate=rate), np.eye(3))) for rate in (50.0, 800.0)
    )
    assert slow == pytest.approx(quick, rel=0.2)


def test_what_is_not_heard_any_more_is_forgotten_but_silence_is_not_taken_for_that():
    state, P = informed([3.0, 4.0, 1.5]), 0.01 * np.eye(3)
    before = np.trace(stated(state, P))
    informed([3.0, 4.0, 1.5], 0.01, state=state, begin=30.0)
    assert np.trace(stated(state, P)) < 2.0 * before
    informed([3.0, 4.0, 1.5], 5.0, heard=(0, 1), state=state, begin=31.0)
    assert np.trace(stated(state, P)) > 5.0 * before


def test_of_white_noise_nothing_persists():
    state, P = informed([3.0, 4.0, 1.5]), np.eye(3)
    assert not stated(state, P, 1.0).any()
    assert 0.5 < np.trace(stated(state, P, 6.0)) / np.trace(stated(state, P)) < 1.0


def test_it_is_bounded_by_what_the_filter_knows():
    P = np.diag([0.01, 0.02, 0.03])
    state = new_state(ANCHORS)
    np.testing.assert_allclose(stated(state, P), noise.MOST * P, rtol=1e-9)
    assert not stated(state, np.zeros((3, 3))).any()


@pytest.mark.parametrize("p", [[3.0, 4.0, 0.2], [1.0, 6.0, 0.5]])
def test_a_height_that_is_held_does_not_follow_errors_that_persist(p):
    """Held exactly, only x and y follow: the covariance of a problem in two dimensions."""
    state, P = informed(p), 1e6 * np.eye(3)
    plain, held, loose = (stated(state, P, height_std=std) for std in (0.0, 1e-4, 1e4))
    information = np.linalg.inv(plain)
    np.testing.assert_allclose(held[:2, :2], np.linalg.inv(information[:2, :2]), rtol=1e-4)
    assert held[2, 2] < 1e-8 < 0.01 < plain[2, 2]
    np.testing.assert_allclose(loose, plain, rtol=1e-4)
    assert np.linalg.eigvalsh(held).min() >= -1e-12
