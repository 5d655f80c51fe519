"""The change detector with more anchors, and over longer flights, than those of test_monitor."""

from monitor_cost import cost, row_of
import numpy as np
import pytest

from uwb_tdoa_ekf.monitoring.change import CAPACITY, ChangeDetector
from uwb_tdoa_ekf.monitoring.monitor import LIMIT
from uwb_tdoa_ekf.monitoring.slices import LENGTH, MOST, reduced


def test_memory_grows_with_the_number_of_anchors_not_with_its_square():
    cost(8, 8, 30)  # what is compiled, is
    (few, _), (many, _) = cost(100, 30, 30), cost(1000, 30, 30)
    assert many < 12.0 * few and many < 20e6  # bytes; 240 matrices of them would be 1.9 GB


def late(n, heard, row, since, slices, size=0.8, seed=1):
    """The Change that is found last in slices of a tag that hears the nearest anchors; one is late
    from slice `since` on.
    """
    rng, anchors, detector = np.random.default_rng(seed), row_of(n).positions, ChangeDetector()
    found = None
    for k in range(slices):
        p = np.array([2.0 * np.cos(0.3 * k), 2.0 * np.sin(0.3 * k), np.sin(0.5 * k)])
        near = np.argsort(np.linalg.norm(anchors - p, axis=1))[:heard]
        one = rng.permutation(max(400, 2 * heard)) % heard
        a, b = near[one], near[(one + 1 + rng.integers(heard - 1, size=len(one))) % heard]
        delays = size * (np.arange(n) == row) * (k >= since)
        innovation = delays[b] - delays[a] + 0.1 * rng.standard_normal(len(a))
        detector.add(reduced(LENGTH * k, p, anchors, a, b, innovation))
        found = detector.find(0.0) or found
    return found


@pytest.mark.parametrize(("n", "heard"), [(6, 6), (30, 20), (1000, 30), (1000, 80)])
def test_finds_the_one_that_changed_among_many_after_slices_were_forgotten(n, heard):
    since = CAPACITY + 30 if n < 100 else 20
    found = late(n, heard, row=3, since=since, slices=since + 12)
    assert found.row == 3 and found.ratio > LIMIT
    assert found.since == pytest.approx(
        LENGTH * since, abs=2 * LENGTH
    ) and found.size == pytest.approx(0.8, abs=0.2)


def test_of_more_than_it_takes_those_heard_most_count():
    rng, n = np.random.default_rng(0), 3 * MOST
    often = rng.permutation(n)[:MOST]
    a, b = (np.concatenate([rng.permutation(often) for _ in range(20)]) for _ in range(2))
    kept = a != b
    a, b = np.append(a[kept], np.arange(n - 1)), np.append(b[kept], np.arange(1, n))
    piece = reduced(0.0, np.zeros(3), row_of(n).positions, a, b, np.zeros(len(a)))
    assert piece.rows.tolist() == sorted(often.tolist()) and piece.response.shape == (MOST, MOST)


def test_an_anchor_that_is_not_heard_changes_nothing():
    rng, few, slices = np.random.default_rng(0), row_of(6).positions, []
    a = rng.integers(6, size=200)
    b, innovation = (a + 1 + rng.integers(5, size=200)) % 6, rng.normal(0.0, 0.1, 200)
    for positions in (few, np.concatenate([few, [[1.0, 1.0, 1.0]]])):
        slices.append(reduced(0.0, np.ones(3), positions, a, b, innovation))
    assert [vars(slices[0])[name].tolist() for name in ("rows", "delays", "response")] == [
        vars(slices[1])[name].tolist() for name in ("rows", "delays", "response")
    ]
