import numpy as np
import pytest
from test_ground import LOW, PARAMETERS, POSITIONS, heard

from uwb_tdoa_bias.foundation.compiled import compiled
from uwb_tdoa_ekf.core.ground import KnownHeight
from uwb_tdoa_ekf.core.memory import new_state
from uwb_tdoa_ekf.core.standing import weigh
from uwb_tdoa_ekf.core.workspace import set_bounds


@compiled
def weighed(ekf, pairs, anchors, parameters, x, covariance):
    return weigh(ekf[0], pairs, anchors, parameters[0], KnownHeight(np.nan, np.nan), x, covariance)


def placed(p, elsewhere, late=0.0, seed=0, state=None):
    """(position (3,), standard deviations (3,), on the ground?) of a tag at rest at p, if a start
    has found it `elsewhere`.
    """
    state = state or new_state(POSITIONS)
    set_bounds(state.record.extent, 1.0, state.record.workspace)
    x, covariance = np.array([*elsewhere, 0.0, 0.0, 0.0]), 0.04 * np.eye(6)
    lead = weighed(
        state.ekf, heard(p, late=late, seed=seed), state.anchors, PARAMETERS, x, covariance
    )
    return x[:3], np.sqrt(np.diag(covariance)[:3]), lead > 0.0


@pytest.mark.parametrize("seed", range(5))
def test_late_low_anchors_put_it_on_the_ground_and_not_above_the_hall(seed):
    """Free in z such TDOAs agree on a place high above the hall."""
    p = [2.5, 5.0, 0.03]
    x, std, on_ground = placed(p, [2.5, 5.0, 7.5], np.where(LOW, 3.3, 0.0), seed)
    assert on_ground and np.linalg.norm(x - p) < 0.3
    assert (np.abs(x - p) < 3.0 * std).all()


@pytest.mark.parametrize("height", [0.75, 1.5])
def test_what_stands_on_a_table_or_hovers_is_where_it_is_said_to_be_or_may_be(height):
    """With a quarter of a metre of error for each anchor the height is hardly known: both places
    are possible.
    """
    p = [2.5, 5.0, height]
    x, std, _ = placed(p, p)
    assert (np.abs(x - p) < 3.0 * std).all() and (std < 1.2).all()


def test_a_blocked_low_anchor_does_not_lift_it():
    """As on constellation 4: one anchor is 1.9 m late, at any height; without the ground in mind
    the tag is put 1.6 m up.
    """
    late = np.zeros(8)
    late[np.flatnonzero(LOW)[0]] = 1.9
    p = [2.5, 5.0, 0.08]
    x, std, on_ground = placed(p, [2.5, 5.0, 1.7], late)
    assert on_ground and np.linalg.norm(x - p) < 0.25 and (np.abs(x - p) < 3.0 * std).all()


def test_where_two_explanations_are_alike_its_deviation_is_as_large_as_they_are_apart():
    p = [2.5, 5.0, 0.35]
    x, std, _ = placed(p, [2.5, 5.0, 0.5])
    assert abs(x[2] - p[2]) < 3.0 * std[2]


@pytest.mark.parametrize(
    "seen, true", [([2.5, 5.0], True), ([np.nan, np.nan], True), ([6.5, 1.0], False)]
)
def test_delays_that_are_known_count_where_they_were_seen(seen, true):
    """Elsewhere the echoes are others: there they differ by what nobody knows."""
    floor, p = np.where(LOW, 3.4, 0.3) + 0.1 * np.arange(8), [2.5, 5.0, 0.03]
    state = new_state(POSITIONS, floor=(floor, 0.05, seen))
    late = floor if true else np.where(LOW, 2.2, 0.0)
    x, std, on_ground = placed(p, [2.5, 5.0, 7.5], late, state=state)
    assert on_ground and state.record.late_as_known == true
    assert np.linalg.norm(x - p) < (0.1 if true else 0.3) and (np.abs(x - p) < 3.0 * std).all()
