"""Anchors found where they are, from TDOAs alone."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_tools.checking.ordered import SurveyFit, displacement
from uwb_tdoa_tools.checking.tdoa_rules import SAME, gained

BOX = np.array([[x, y, z] for x in (0.0, 6.0) for y in (0.0, 7.0) for z in (0.2, 3.0)])


def measured(positions, seconds=40.0, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.004)
    a = rng.integers(0, 8, len(t))
    b = (a + rng.integers(1, 8, len(t))) % 8
    p = [3.0, 3.5, 1.5] + np.sin(np.outer(t, [0.5, 0.7, 0.3])) * [2.0, 2.5, 1.0]
    return t, a, b, tdoa(p, positions[a], positions[b]) + noise * rng.normal(size=len(t))


def test_a_right_survey_is_not_moved():
    fit = SurveyFit(*measured(BOX), BOX)
    left, anchors = fit.solve()
    assert left <= fit.before and gained(fit) is None
    assert displacement(BOX, anchors).max() < SAME


@pytest.mark.parametrize(
    "row, shift", [(0, [1.0, 0.0, 0.0]), (5, [0.0, -1.5, 0.0]), (7, [0.5, 0.5, -1.0])]
)
def test_a_moved_anchor_is_found(row, shift):
    surveyed = BOX.copy()
    surveyed[row] -= shift
    fit = SurveyFit(*measured(BOX), surveyed)
    alone = [fit.solve([k]) for k in range(8)]
    assert int(np.argmin([loss for loss, _ in alone])) == row
    assert np.allclose(alone[row][1][row], BOX[row], atol=0.25)
    others = np.delete(np.arange(8), row)
    assert np.array_equal(alone[row][1][others], surveyed[others])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_rotation_and_translation_are_no_displacement(seed):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-5.0, 5.0, (6, 3))
    moved = Rotation.random(random_state=seed).apply(positions) + rng.normal(size=3)
    assert displacement(positions, moved).max() < 1e-9
    mirrored = moved * [1.0, 1.0, -1.0]
    assert displacement(positions, mirrored).max() > 1e-3  # a mirror image is another survey


def test_few_tdoas_make_no_window():
    t, a, b, d = (column[:20] for column in measured(BOX))
    assert len(SurveyFit(t, a, b, d, BOX)) == 0
    assert len(SurveyFit(*(column[:0] for column in (t, a, b, d)), BOX)) == 0
