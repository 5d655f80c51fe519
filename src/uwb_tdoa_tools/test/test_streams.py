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
