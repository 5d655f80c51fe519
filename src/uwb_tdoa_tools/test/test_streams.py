import numpy as np
import pytest

from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_tools.readers.streams import protocol


def tdoas(a, b):
    return Tdoas(np.arange(len(a)) * 1e-3, np.asarray(a), np.asarray(b), np.zeros(len(a)))


@pytest.mark.parametrize("ids", [np.arange(8), np.array([2, 3, 5, 11, 13])])
def test_ring_with_missed_slots_is_tdoa2(ids):
    a = np.arange(200) % len(ids)
    step = np.where(np.arange(200) % 10 == 0, 2, 1)
    assert protocol(tdoas(ids[a], ids[(a + step) % len(ids)])) == "tdoa2"


def test_any_pair_is_tdoa3():
    rng = np.random.default_rng(1)
    a = rng.integers(0, 8, 500)
    assert protocol(tdoas(a, (a + rng.integers(1, 8, 500)) % 8)) == "tdoa3"


RING = [4, 1, 7, 0, 3, 6]  # the order in which anchors send need not be that of their ids


def test_a_ring_in_any_order_whichever_id_a_tool_writes_first():
    rng = np.random.default_rng(0)
    a = np.arange(300) % 6
    pair = (
        np.array([RING[k] for k in a]),
        np.array([RING[k] for k in (a + 1 + (rng.random(300) < 0.1)) % 6]),
    )
    assert protocol(tdoas(*pair)) == protocol(tdoas(*np.sort(pair, axis=0))) == "tdoa2"


@pytest.mark.parametrize("n", [4, 5, 6])
def test_any_pair_of_few_anchors_is_tdoa3(n):
    rng = np.random.default_rng(n)
    a = rng.integers(0, n, 500)
    assert protocol(tdoas(a, (a + rng.integers(1, n, 500)) % n)) == "tdoa3"


def test_two_rings_are_none():
    a = np.arange(300) % 6
    assert protocol(tdoas(a, np.where(a < 3, (a + 1) % 3, 3 + (a - 2) % 3))) == "tdoa3"


def test_three_anchors_in_turn_and_at_random():
    a, rng = np.arange(60) % 3, np.random.default_rng(0)
    assert protocol(tdoas(a, (a + 1) % 3)) == "tdoa2"
    assert protocol(tdoas(a, (a + rng.integers(1, 3, 60)) % 3)) == "tdoa3"


def test_one_reference_is_said():
    others = 1 + np.arange(100) % 5
    assert protocol(tdoas(np.zeros(100, int), others)) == "tdoa, one reference"
