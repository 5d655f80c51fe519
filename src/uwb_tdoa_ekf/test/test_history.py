from dataclasses import replace

from flights import fly, leaving, measurements
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.engine import feed, most_records, run
from uwb_tdoa_ekf.core.history import RECORD, RESET, UPDATE
from uwb_tdoa_ekf.core.memory import ODOMETRY, RESIDUAL, Output, new_state
from uwb_tdoa_ekf.core.verdicts import USED


def recorded(flight, config=None):
    """(records, residuals) of a flight that is fed at once."""
    records, fed = [], measurements(flight)
    _, residuals, _ = feed(
        new_state(flight.anchors.positions), (config or FilterConfig()).parameters(), fed, records
    )
    assert sum(map(len, records)) <= most_records(fed)
    return np.concatenate(records), residuals


@settings(max_examples=10)
@given(st.integers(0, 1000), st.booleans(), st.booleans())
def test_every_tdoa_that_is_used_has_its_record_and_none_is_without_room(seed, outside, use_imu):
    flight = fly(seed, 3.0, hover=True, accel_noise=1e-4, tdoa_rate=400.0, outliers=0.1)
    records, residuals = recorded(
        leaving(flight) if outside else flight, FilterConfig(use_imu=use_imu)
    )
    assert records["kind"][0] == RESET and (np.diff(records["t"]) >= 0.0).all()
    of_position = records[
        (records["kind"] == UPDATE) & (records["row"][:, :3] != 0.0).sum(axis=1).astype(bool)
    ]
    used = residuals["innovation"][residuals["verdict"] == USED]
    assert np.isin(used, of_position["innovation"]).all()


def test_a_record_leads_to_the_next():
    """P after an update is (I - K h) (Phi P Phi' + Q), with no Q for what no noise drives: of a tag
    without an IMU all but the yaw.
    """
    flight = fly(3, 2.0)
    records, _ = recorded(
        flight, FilterConfig(initial_yaw_std=0.5, motion_noise=1e-6, use_imu=False)
    )
    for before, record in zip(records[5:60], records[6:61]):
        phi = np.eye(15)
        phi[:9] = record["transition"]
        prior = phi @ before["P"] @ phi.T
        prior[8, 8] += FilterConfig().turn_noise ** 2 * (record["t"] - before["t"])
        gain, row = record["gain"], record["row"]
        np.testing.assert_allclose(
            record["P"], (np.eye(15) - np.outer(gain, row)) @ prior, atol=1e-9
        )
        assert record["variance"] * gain == pytest.approx(prior @ row, abs=1e-9)


def test_what_a_record_does_not_lead_to_is_noise():
    """A tag is lifted from its rest: of what was known of its velocity nothing carries over.

    Q = P before the update - Phi P Phi' >= 0.
    """
    flight = lifted(np.random.default_rng(1))
    records, _ = recorded(flight, FilterConfig(initial_yaw_std=0.5))
    assert (records["t"] > 5.5).any()
    updates = 0
    for before, record in zip(records[5:], records[6:]):
        if record["kind"] == RESET:
            continue
        phi, gain = np.eye(15), record["gain"]
        phi[:9] = record["transition"]
        prior = record["P"] + record["variance"] * np.outer(gain, gain)
        std = np.sqrt(np.diag(prior))
        noise = (prior - phi @ before["P"] @ phi.T) / np.outer(std, std)
        assert np.linalg.eigvalsh(0.5 * (noise + noise.T)).min() > -1e-6
        updates += 1
    assert updates > 100


def lifted(rng):
    """A Flight that lies still for 4 s, and is lifted then: with 0.5 m/s^2 for a second."""
    flight = fly(2, 6.0, hover=True, tdoa_std=0.05)
    accel = flight.imu.accel + np.where((flight.imu.t > 4.0) & (flight.imu.t < 5.0), 0.5, 0.0)[
        :, None
    ] * [0.0, 0.0, 1.0]
    accel = accel + 0.001 * rng.standard_normal(accel.shape)
    return replace(flight, imu=replace(flight.imu, accel=accel))


def test_a_history_that_is_full_is_an_error_and_no_silence():
    flight = fly(7, 2.0)
    state, fed = new_state(flight.anchors.positions), measurements(flight)
    n, k = len(fed.imu), len(fed.tdoa)
    output = Output(np.empty(n + k, ODOMETRY), np.empty(k, RESIDUAL), np.empty(k // 2, RECORD))
    with pytest.raises(IndexError, match="history is full"):
        run(state, FilterConfig().parameters(), fed, output)


def test_nothing_is_recorded_unless_asked_for():
    flight = fly(8, 2.0)
    state = new_state(flight.anchors.positions)
    feed(state, FilterConfig().parameters(), measurements(flight))
    assert state.record.recorded == 0
    np.testing.assert_array_equal(state.record.since_record, np.eye(15))
