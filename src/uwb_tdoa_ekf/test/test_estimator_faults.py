"""Streams that are wrong, through the Estimator and off line: the same to the bit, and the
covariance knows.
"""

from dataclasses import fields, replace

from flights import fly, position_at
from live import arriving, assert_same, assert_same_as_offline
import numpy as np
import pytest

from uwb_tdoa_ekf.core.verdicts import REPEATED
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.reorder_buffer import MOST_WAITING

BEGIN, END = 5.0, 9.0  # s, of a fault
IMU_FAULTS = {
    "in g": lambda w, f: (w, f / 9.81),
    "degrees/s": lambda w, f: (np.rad2deg(w), f),
    "upside down": lambda w, f: (w, f * [1.0, -1.0, -1.0]),
}


@pytest.mark.parametrize("fault", IMU_FAULTS)
def test_without_an_imu_that_cannot_be_right_the_filter_knows_how_well_it_does_whatever_the_arrival(
    fault,
):
    flight, rng = (
        fly(3, 14.0, imu_rate=100.0, tdoa_rate=100.0, tdoa_std=0.05),
        np.random.default_rng(1),
    )
    imu = flight.imu
    wrong = ((imu.t > BEGIN) & (imu.t < END))[:, None]
    gyro, accel = (
        np.where(wrong, bad, good)
        for bad, good in zip(IMU_FAULTS[fault](imu.gyro, imu.accel), (imu.gyro, imu.accel))
    )
    harmed = replace(flight, imu=replace(imu, gyro=gyro, accel=accel))
    order = arriving(harmed, rng, tdoa_delay=0.05)
    assert_same_as_offline(harmed, order=order, advance=lambda: rng.random() < 0.2)
    odometry = run_offline(harmed).odometry
    error = odometry.p - position_at(flight, odometry.t)
    nees = np.einsum(
        "ni,ni->n", error, np.linalg.solve(odometry.covariance[:, :3, :3], error[..., None])[..., 0]
    )
    assert nees[odometry.t > 1.0].max() < 8.0
    assert np.linalg.norm(error, axis=1)[odometry.t > BEGIN].max() < 0.6
    assert np.linalg.norm(error, axis=1)[odometry.t > END + 1.0].max() < 0.2


def twice(flight):
    """The Flight with every TDOA twice, the second one right after the first."""
    repeated = {
        field.name: np.repeat(getattr(flight.tdoa, field.name), 2) for field in fields(flight.tdoa)
    }
    return replace(flight, tdoa=replace(flight.tdoa, **repeated))


def test_what_is_sent_twice_counts_once_whenever_the_second_comes():
    flight, rng = fly(2, 4.0), np.random.default_rng(1)
    once, run = run_offline(flight), run_offline(twice(flight))
    assert_same(run.odometry, once.odometry)
    assert run.counts == once.counts | {"repeated": len(flight.tdoa)}
    assert (run.residuals.verdict[1::2] == REPEATED).all()
    assert_same_as_offline(twice(flight), advance=lambda: rng.random() < 0.3)


def test_equal_values_of_other_pairs_or_stamps_are_no_repeats():
    flight = fly(2, 2.0)
    same = replace(flight, tdoa=replace(flight.tdoa, d=np.zeros(len(flight.tdoa))))
    assert run_offline(same).counts["repeated"] == 0
    estimator = Estimator(flight.anchors)
    a, b = flight.anchors.ids[:2]
    for pair, d in (((a, b), 0.5), ((b, a), 0.5), ((a, b), 0.6), ((a, b), 0.5)):
        estimator.add_tdoa(1.0, *pair, d)
    estimator.finish()
    assert estimator.counts["repeated"] == 1


@pytest.mark.parametrize("step", [0.0, 1e-9])
def test_a_stream_whose_stamps_do_not_go_on_is_used_and_does_not_grow(step):
    flight = fly(3, 3.0, imu_rate=100.0, tdoa_rate=100.0)
    imu, tdoa, n = flight.imu, flight.tdoa, MOST_WAITING + 500
    estimator = Estimator(flight.anchors)
    estimator.add_imu(imu.t, imu.gyro, imu.accel)
    estimator.add_tdoa(
        tdoa.t[[1, 0]], tdoa.a[:2], tdoa.b[:2], tdoa.d[:2]
    )  # out of order: what is stamped alike is waited for
    ids = flight.anchors.ids[np.arange(n) % len(flight.anchors)]
    for k in range(3):
        estimator.add_tdoa(100.0 + step * (k * n + np.arange(n)), ids, np.roll(ids, 1), np.zeros(n))
        estimator.advance()
        assert estimator.waiting[1] <= MOST_WAITING
