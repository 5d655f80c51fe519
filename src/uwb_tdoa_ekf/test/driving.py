# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Feed a flight to the core and check the results."""

from covariances import assert_covariance
from flights import kept, measurements, position_at
import numpy as np

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.engine import feed
from uwb_tdoa_ekf.core.memory import Measurements, new_state


def drive(flight, config=None, state=None, cuts=()):
    """Return odometry and residuals of the engine, with fields as attributes.

    The flight is fed in pieces between the stamps `cuts`.
    """
    state = state_for(flight) if state is None else state
    parameters, whole, parts = (config or FilterConfig()).parameters(), measurements(flight), []
    edges = [-np.inf, *sorted(cuts), np.inf]
    for low, high in zip(edges, edges[1:]):
        piece = Measurements(*(part[(part["t"] > low) & (part["t"] <= high)] for part in whole))
        parts.append(feed(state, parameters, piece)[:2])
    return tuple(np.concatenate(column).view(np.recarray) for column in zip(*parts))


def state_for(flight):
    """Return the FilterState of a filter before its first measurement of a Flight."""
    return new_state(flight.anchors.positions)


def errors(flight, odometry):
    """Return the distances to the true positions, (n,), in m."""
    return np.linalg.norm(odometry.x[:, :3] - position_at(flight, odometry.t), axis=1)


def assert_equal(left, right):
    """Check that two pairs of odometry and residuals agree to the bit."""
    for one, other in zip(left, right):
        for name in one.dtype.names:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def assert_sound(state, odometry):
    """Check for finite states, unit quaternions and valid covariances."""
    assert np.isfinite(odometry.x).all()
    np.testing.assert_allclose(np.linalg.norm(odometry.x[:, 6:10], axis=1), 1.0, atol=1e-9)
    assert (np.diff(odometry.t) >= 0.0).all()
    if len(odometry):
        assert_covariance(odometry.covariance)
    hypotheses = state.record.hypotheses
    assert np.isfinite(hypotheses["x"]).all()
    for P in hypotheses["P"][np.isfinite(hypotheses["log_weight"])]:
        assert_covariance(P)
        np.testing.assert_array_equal(P, P.T)


def cut(stream, low, high):
    """Return the part of an Imu or Tdoas between two stamps."""
    return kept(stream, (stream.t >= low) & (stream.t < high))
