"""When a tag is lost, and when it is not."""

from dataclasses import replace

from flights import fly, position_at, with_aids
from live import assert_same_as_offline, feed
import numpy as np

from uwb_tdoa_ekf.estimator import Estimator


def without_tdoas(flight, low, high):
    """The Flight without its TDOAs between two stamps, s."""
    kept = (flight.tdoa.t < low) | (flight.tdoa.t > high)
    return replace(
        flight, tdoa=type(flight.tdoa)(*(column[kept] for column in vars(flight.tdoa).values()))
    )


def test_a_tag_without_tdoas_is_lost_once_it_may_be_anywhere_and_found_when_they_are_back():
    flight = without_tdoas(fly(3, 45.0, imu_rate=50.0, tdoa_rate=100.0), 3.0, 40.0)
    estimator, lost = Estimator(flight.anchors), {}

    def note():
        lost[estimator.newest] = estimator.lost
        return True

    odometry, _ = feed(estimator, flight, advance=note)
    assert not (
        (odometry.t > 34.0) & (odometry.t < 40.0)
    ).any()  # metres by the dozen are no odometry
    assert (odometry.t < 33.0).any() and odometry.t[-1] > 44.9
    error = np.linalg.norm(odometry.p - position_at(flight, odometry.t), axis=1)
    assert error[odometry.t > 42.0].max() < 0.5
    said = {t: sentence for t, sentence in lost.items() if sentence}
    assert 33.0 < min(said) < 34.0 and 40.0 < max(said) < 41.5 and "no TDOA" in said[min(said)]
    assert_same_as_offline(flight)


def test_a_tag_whose_velocity_is_measured_is_not_lost_without_tdoas():
    flight = without_tdoas(
        replace(
            with_aids(fly(3, 45.0, imu_rate=50.0, tdoa_rate=100.0)), height=None, pressure=None
        ),
        5.0,
        40.0,
    )
    estimator = Estimator(flight.anchors)
    odometry, _ = feed(estimator, flight)
    assert np.diff(odometry.t).max() < 0.1 and estimator.lost is None
