from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_tools.simulation.config import PROTOCOLS
from uwb_tdoa_tools.simulation.rooms import heard_at
from uwb_tdoa_tools.simulation.tdoas import among_heard, make_schedule


def schedule(protocol, n_anchors=8, duration=60.0, seed=0):
    return make_schedule(protocol, n_anchors, duration, np.random.default_rng(seed))


@given(st.sampled_from(PROTOCOLS), st.integers(2, 64), st.floats(1.0, 10.0), st.integers(0, 1000))
def test_every_schedule_is_sound(protocol, n_anchors, duration, seed):
    s = schedule(protocol, n_anchors, duration, seed)
    assert (np.diff(s.t) > 0.0).all() and s.t[0] > 0.0 and s.t[-1] <= duration
    for anchor in (s.a, s.b):
        assert anchor.min() >= 0 and anchor.max() < n_anchors
    assert (s.a != s.b).all()
    np.testing.assert_array_equal(s.sender[s.heard_a], s.a)
    np.testing.assert_array_equal(s.sender[s.heard_b], s.b)
    assert (s.heard_a < s.heard_b).all() and (np.diff(s.heard_b) > 0).all()


def test_tdoa2_is_a_ring_of_some_475_per_second():
    s = schedule("tdoa2")
    np.testing.assert_array_equal(s.b, (s.a + 1) % 8)
    np.testing.assert_array_equal(s.heard_a, s.heard_b - 1)
    assert 450.0 < len(s.t) / 60.0 < 490.0
    assert np.median(np.diff(s.t)) == pytest.approx(2e-3, rel=0.02)
    assert np.diff(s.t).std() > 5e-5
    assert 0.9 < np.mean(s.b[:-1] == s.a[1:]) < 1.0


def test_tdoa3_takes_any_pair_some_240_times_per_second():
    s = schedule("tdoa3")
    assert 200.0 < len(s.t) / 60.0 < 270.0
    pairs, count = np.unique(s.a * 8 + s.b, return_counts=True)
    assert len(pairs) == 56 and count.min() > 0.6 * count.mean()


def test_tdoa3_compares_with_the_newest_packet_of_the_other_anchor():
    s = schedule("tdoa3", 5, 2.0)
    for k in range(0, len(s.t), 13):
        heard = np.flatnonzero(s.sender[: s.heard_b[k]] == s.a[k])
        assert s.heard_a[k] == heard[-1]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_seeded(protocol):
    np.testing.assert_array_equal(schedule(protocol, seed=4).t, schedule(protocol, seed=4).t)
    assert schedule(protocol, seed=4).t[0] != schedule(protocol, seed=5).t[0]


def across_a_hall(protocol, reach, seed, cells=None):
    """(Schedule, place (n, 3) of each measurement, positions (40, 3)) of a tag that crosses 60 m of
    a hall.
    """
    rng = np.random.default_rng(seed)
    positions = np.column_stack([rng.uniform(0.0, 60.0, (40, 2)), rng.uniform(0.0, 5.0, 40)])
    schedule = make_schedule(protocol, len(positions), 2.0, rng)
    p = np.column_stack(
        [np.linspace(5.0, 55.0, len(schedule.t)), np.full((len(schedule.t), 2), (30.0, 1.0))]
    )
    near = among_heard(schedule, heard_at(p, positions, reach), protocol, rng, cells)
    assert np.isin(near.t, schedule.t).all()
    return near, p[np.searchsorted(schedule.t, near.t)], positions


@given(st.sampled_from(PROTOCOLS), st.floats(4.0, 30.0), st.integers(0, 100))
def test_within_reach_only_anchors_that_are_near_are_heard(protocol, reach, seed):
    near, there, positions = across_a_hall(protocol, reach, seed)
    for rows, heard in ((near.a, near.heard_a), (near.b, near.heard_b)):
        np.testing.assert_array_equal(near.sender[heard], rows)
    assert (near.a != near.b).all()
    assert (np.linalg.norm(there - positions[near.b], axis=1) <= reach).all()
    assert (np.linalg.norm(there - positions[near.a], axis=1) <= reach).all()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_tdoas_are_of_two_anchors_of_one_cell(protocol):
    cells = np.arange(40) // 10
    near, _, _ = across_a_hall(protocol, 30.0, 0, cells)
    np.testing.assert_array_equal(cells[near.a], cells[near.b])
    assert (near.a != near.b).all() and len(np.unique(cells[near.a])) == 4
    mixed, _, _ = across_a_hall(protocol, 30.0, 0)
    assert (cells[mixed.a] != cells[mixed.b]).any()
