"""An inertial sensor that comes when the filter runs already, mounted any way round."""

from dataclasses import replace

from flights import fly, position_at
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.flight import Imu
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.frames import rotation_std
from uwb_tdoa_ekf.offline import run_offline

LATE = 2.0  # s
TURNS = {
    "upright": [0.0, 0.0, 0.0],
    "on its side": [1.5, 0.0, 0.0],
    "upside down, tilted": [2.7, 0.4, 1.0],
}


def flown(turn):
    """A flight with an inertial sensor that begins late, in axes that are turned by a rotation
    vector.
    """
    flight, turn = fly(seed=8, duration=16.0), Rotation.from_rotvec(turn)
    later = flight.imu.t > flight.imu.t[0] + LATE
    return replace(
        flight,
        imu=Imu(
            flight.imu.t[later],
            turn.apply(flight.imu.gyro[later]),
            turn.apply(flight.imu.accel[later]),
        ),
    )


def errors(flight, run):
    late = run.odometry.t > flight.imu.t[0] + 3.0
    error = run.odometry.p[late] - position_at(flight, run.odometry.t[late])
    nees = np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(run.odometry.covariance[late, :3, :3]), error
    )
    return np.sqrt(np.mean(np.sum(error**2, axis=1))), np.mean(nees)


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_however_it_is_mounted_the_estimate_is_right_and_knows_it(turn):
    flight = flown(turn)
    rmse, nees = errors(flight, run_offline(flight))
    alone, _ = errors(flight, run_offline(flight, FilterConfig(use_imu=False)))
    assert rmse < 1.1 * alone and rmse < 0.15 and nees < 6.0


def test_the_yaw_is_known_as_well_as_it_was():
    """A tag without an inertial sensor may have turned by some 0.7 rad in these two seconds."""
    flight, stated = flown(TURNS["upright"]), []
    for config in (FilterConfig(initial_yaw=0.0, initial_yaw_std=0.05), FilterConfig()):
        odometry = run_offline(flight, config).odometry
        just_after = np.searchsorted(odometry.t, flight.imu.t[0] + 0.5)
        stated.append(rotation_std(odometry.q, odometry.covariance)[just_after, 2])
    assert stated[0] < 1.0 and stated[1] > 1.2
