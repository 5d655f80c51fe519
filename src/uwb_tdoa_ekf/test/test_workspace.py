from dataclasses import replace

from flights import corners, fly
import numpy as np
import pytest

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core.memory import new_state
from uwb_tdoa_ekf.core.workspace import SMALLEST, STD, constrain, contains, set_bounds
from uwb_tdoa_ekf.offline import run_offline

MARGIN = 1.0  # m


def bounds_of(positions):
    bounds = np.empty((2, 3))
    set_bounds(new_state(positions).record.extent, MARGIN, bounds)
    return bounds


def test_it_ends_a_margin_beyond_the_anchors_and_is_never_flat():
    positions = np.array(corners().positions)
    bounds = bounds_of(positions)
    middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    half = np.array([3.5 + MARGIN, 4.0 + MARGIN, SMALLEST])
    np.testing.assert_allclose(bounds, [middle - half, middle + half])
    for k in range(3):
        x = middle.copy()
        x[k] += half[k] - 0.01
        assert contains(bounds, x)
        x[k] += 0.02
        assert not contains(bounds, x)


@pytest.mark.parametrize("axis, off", [(0, -2.0), (1, 0.7), (2, 5.0)])
def test_a_tag_outside_is_drawn_back_by_as_much_as_it_is_uncertain(axis, off):
    bounds, ekf = (
        bounds_of(np.array(corners().positions)),
        new_state(np.array(corners().positions)).record,
    )
    hypothesis = ekf.hypotheses[0]
    hypothesis.x[:3] = 0.5 * (bounds[0] + bounds[1])
    hypothesis.x[axis] = bounds[int(off > 0.0), axis] + off
    hypothesis.P[axis, axis] = 3.0
    before = hypothesis.x.copy()
    assert [constrain(hypothesis, ekf.innovation, bounds, k) for k in range(3)] == [
        k == axis for k in range(3)
    ]
    gain = 3.0 / (3.0 + STD**2)
    assert hypothesis.x[axis] == pytest.approx(before[axis] - gain * off)
    assert hypothesis.P[axis, axis] == pytest.approx((1.0 - gain) * 3.0)
    assert np.delete(hypothesis.x, axis) == pytest.approx(np.delete(before, axis))


@pytest.mark.parametrize("beyond", [1.0, 3.0])
def test_a_tag_outside_is_right_or_says_how_wrong_it_is(beyond):
    found = []
    for seed in range(5):
        flight = fly(seed, 6.0, hover=True, anchors=corners((8.0, 8.0, 3.0)), tdoa_rate=300.0)
        p = np.array([8.0 + MARGIN + beyond, 3.0, 1.2])
        a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
        d = tdoa(p, flight.anchors.positions[a], flight.anchors.positions[b])
        d += 0.1 * np.random.default_rng(seed).standard_normal(len(d))
        odometry = run_offline(replace(flight, tdoa=replace(flight.tdoa, d=d))).odometry
        error = (odometry.p - p)[odometry.t > 3.0]
        P = odometry.covariance[odometry.t > 3.0, :3, :3]
        found.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error).mean())
    assert np.mean(found) < 6.0
