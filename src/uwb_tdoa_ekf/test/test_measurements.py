import numpy as np
import pytest

from uwb_tdoa_ekf.core.measurements import (
    FARTHEST,
    LARGEST_ERROR,
    STEEPEST,
    usable,
    usable_all,
    usable_slopes,
)

POSITIONS = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 2.0]])
CASES = [
    (0, 1, 0.0, 0.0, True),
    (0, 1, 5.0, 0.0, True),  # right behind anchor 0
    (0, 1, 5.0 + LARGEST_ERROR, 0.0, True),
    (0, 1, -5.0 - LARGEST_ERROR, 0.0, True),
    (0, 1, 5.001 + LARGEST_ERROR, 0.0, False),  # no place hears that
    (1, 0, -5.001 - LARGEST_ERROR, 0.0, False),
    (0, 2, 5.0, 0.0, False),
    (0, 0, 0.0, 0.0, False),
    (-1, 1, 0.0, 0.0, False),
    (1, -1, 0.0, 0.0, False),
    (-1, -1, 0.0, 0.0, False),
    (0, 1, np.nan, 0.0, False),
    (0, 1, np.inf, 0.0, False),
    (0, 1, -np.inf, 0.0, False),
    (0, 1, 0.0, np.nan, False),
    (0, 1, 0.0, np.inf, False),
    (0, 1, 0.0, -0.1, False),
    (0, 1, 0.0, 0.3, True),
]


@pytest.mark.parametrize("a, b, d, variance, expected", CASES)
def test_one(a, b, d, variance, expected):
    assert usable(a, b, d, variance, POSITIONS) == expected


def test_all_is_one_for_each():
    a, b, d, variance, expected = (np.array(column) for column in zip(*CASES))
    assert usable_all(a, b, d, variance, POSITIONS).tolist() == expected.tolist()


@pytest.mark.parametrize(
    "slope, state, expected",
    [
        (0.0, 0.0, True),
        (-0.99 * STEEPEST, -0.99 * FARTHEST, True),
        (STEEPEST, 0.0, False),
        (0.0, FARTHEST, False),
        (np.nan, 0.0, False),
        (0.0, np.nan, False),
        (-np.inf, 0.0, False),
        (0.0, np.inf, False),
    ],
)
def test_slopes(slope, state, expected):
    slopes, states = np.zeros((2, 3, 6))
    slopes[1, 5], states[1, 0] = slope, state
    assert usable_slopes(slopes, states).tolist() == [True, expected, True]
