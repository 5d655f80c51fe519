# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filter core: flights, and the recorded history."""

from dataclasses import replace
from pathlib import Path
import re

from covariances import assert_covariance
from driving import assert_equal, assert_sound, cut, drive, errors, state_for
from flights import fly, kept, leaving, measurements, position_at, without_tdoas
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core import memory
from uwb_tdoa_ekf.core.config import ROBUST, FilterConfig
from uwb_tdoa_ekf.core.engine import feed, most_records, run
from uwb_tdoa_ekf.core.history import RECORD, RESET, UPDATE
from uwb_tdoa_ekf.core.memory import ODOMETRY, RESIDUAL, STARTUP, USED, Output, new_state
from uwb_tdoa_ekf.results import VERDICTS

# --- engine ---
MESSAGE = Path(__file__).resolve().parents[2] / "uwb_tdoa_msgs" / "msg" / "TdoaResidual.msg"


@pytest.mark.skipif(
    not MESSAGE.is_file(), reason="the message definitions are not beside this package"
)
def test_verdicts_are_those_of_the_message():
    declared = dict(re.findall(r"VERDICT_(\w+)=(\d)", MESSAGE.read_text()))
    assert declared == {name: str(getattr(memory, name)) for name in declared}
    assert {int(value) for value in declared.values()} == set(VERDICTS)


def without_imu(flight, low=-np.inf, high=np.inf):
    """Return the flight without the inertial samples between two stamps."""
    return replace(flight, imu=kept(flight.imu, (flight.imu.t < low) | (flight.imu.t >= high)))


@settings(max_examples=20)
@given(st.lists(st.floats(0.0, 3.0), max_size=8))
def test_feeding_in_pieces_changes_nothing(cuts):
    flight = fly(1, 3.0)
    assert_equal(drive(flight), drive(flight, cuts=cuts))


def test_tracks_a_flight_with_outliers():
    for robust in ROBUST:
        for adapt in (False, True):
            flight = fly(5, 15.0, outliers=0.1, accel_noise=0.02, gyro_noise=0.002)
            odometry, residuals = drive(flight, FilterConfig(robust=robust, adapt_noise=adapt))
            assert np.sqrt(np.mean(errors(flight, odometry[odometry.t > 3.0]) ** 2)) < 0.15, (
                robust,
                adapt,
            )
            far = np.abs(residuals.innovation) > 1.5
            wild, tame = (
                residuals.weight[far],
                residuals.weight[~far & np.isfinite(residuals.innovation)],
            )
            assert len(wild) > 50 and np.median(wild) < 0.5 * np.median(tame), (robust, adapt)
            # The filter may trust an anchor with a known noise.
            assert adapt or wild.max() < 0.6


def test_odometry_comes_at_the_first_event_of_each_period():
    flight = fly(6, 3.0, imu_rate=1000.0)
    odometry, residuals = drive(flight, FilterConfig(odometry_rate=50.0))
    start = flight.tdoa.t[residuals.verdict == STARTUP][-1]
    stamps = np.sort(np.concatenate([flight.imu.t, flight.tdoa.t]))
    stamps = stamps[stamps >= start]
    _, first = np.unique(np.floor(stamps * 50.0 + 1e-6), return_index=True)
    np.testing.assert_array_equal(odometry.t, stamps[first])


def test_residuals_are_innovation_and_its_variance():
    """Compare with the odometry.

    At 1 MHz every event gives odometry, so the one before a TDOA holds the prior state.
    """
    flight = fly(7, 2.0, imu_rate=1000.0)
    odometry, residuals = drive(
        flight, FilterConfig(odometry_rate=1e6, tdoa_std=0.2, tdoa_correlation_length=1.0)
    )
    tested = 0
    for k in np.flatnonzero(residuals.verdict == USED)[50:150]:
        before = np.searchsorted(odometry.t, flight.tdoa.t[k]) - 1
        x, dt = odometry.x[before], flight.tdoa.t[k] - odometry.t[before]
        p = x[:3] + dt * x[3:6]
        a, b = (
            flight.anchors.positions[flight.anchors.index(i[k])]
            for i in (flight.tdoa.a, flight.tdoa.b)
        )
        assert residuals.innovation[k] == pytest.approx(flight.tdoa.d[k] - tdoa(p, a, b), abs=1e-4)
        g = (p - b) / np.linalg.norm(p - b) - (p - a) / np.linalg.norm(p - a)
        prior = g @ odometry.covariance[before, :3, :3] @ g
        # An anchor near the ground may be late, and the filter adds noise for it.
        if max(a[2], b[2]) > 2.0 > 0.5 > min(a[2], b[2]) or max(a[2], b[2]) < 0.5:
            continue
        assert residuals.variance[k] == pytest.approx(0.2**2 + prior, rel=0.05)
        tested += 1
    assert tested > 15


@pytest.mark.parametrize("config", [FilterConfig(), FilterConfig(use_imu=False)])
def test_without_an_imu_it_follows_a_slow_tag(config):
    flight = without_imu(fly(8, 15.0))
    odometry, _ = drive(flight, config)
    assert errors(flight, odometry[odometry.t > 3.0]).max() < 0.5
    assert_covariance(odometry.covariance)


def test_bridges_seconds_without_imu_or_tdoas():
    flight = fly(9, 20.0)
    for gap in (without_imu(flight, 8.0, 11.0), replace(flight, tdoa=cut(flight.tdoa, 0.0, 8.0))):
        state = state_for(flight)
        assert_sound(state, drive(gap, state=state)[0])
    odometry, _ = drive(without_imu(flight, 8.0, 11.0))
    assert errors(flight, odometry[odometry.t > 3.0]).max() < 0.6
    odometry, _ = drive(without_tdoas(flight, 8.0, 10.0))
    blind = odometry[(odometry.t > 8.0) & (odometry.t < 10.0)]
    std = np.sqrt(np.einsum("nii->ni", blind.covariance[:, :3, :3]))
    # The stated deviation grows.
    assert (np.diff(std.sum(axis=1)) > 0.0).all()
    assert (np.abs(blind.x[:, :3] - position_at(flight, blind.t)) < 4.0 * std).all()
    assert errors(flight, odometry[odometry.t > 11.0]).max() < 0.4


def nasty(seed, imu_size):
    """Return streams that no sensor would send.

    They have huge and jumping IMU values, repeated stamps, gaps of seconds, TDOAs of any accepted
    value, and a tag at an anchor.
    """
    rng = np.random.default_rng(seed)
    flight = fly(seed, 2.0, imu_rate=float(rng.choice([20.0, 100.0, 1000.0])))

    def stretch(t):
        gaps = rng.choice([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 20.0], len(t)) * np.diff(t, prepend=0.0)
        pauses = np.where(rng.random(len(t)) < 0.002, rng.uniform(0.0, 3.0, len(t)), 0.0)
        return np.cumsum(gaps + pauses)

    wild = rng.random(len(flight.imu)) < rng.choice([0.0, 0.01, 0.5])
    gyro, accel = flight.imu.gyro.copy(), flight.imu.accel.copy()
    gyro[wild] = imu_size * rng.standard_normal((wild.sum(), 3))
    accel[wild] = 10.0 * imu_size * rng.standard_normal((wild.sum(), 3))
    a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
    baseline = np.linalg.norm(flight.anchors.positions[a] - flight.anchors.positions[b], axis=1)
    d = flight.tdoa.d.copy()
    wild = rng.random(len(d)) < rng.choice([0.0, 0.1, 1.0])
    d[wild] = (rng.uniform(-1.0, 1.0, len(d)) * (baseline + 1.0))[wild]
    # the tag is at the first anchor
    if rng.random() < 0.2:
        d = tdoa(
            flight.anchors.positions[0], flight.anchors.positions[a], flight.anchors.positions[b]
        )
    return replace(
        flight,
        imu=Imu(stretch(flight.imu.t), gyro, accel),
        tdoa=replace(flight.tdoa, t=stretch(flight.tdoa.t), d=d),
    )


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from(ROBUST), st.booleans())
def test_nothing_but_finite_states_and_covariances_comes_out(seed, robust, use_imu):
    flight = nasty(seed, 40.0)
    state = state_for(flight)
    odometry, _ = drive(flight, FilterConfig(robust=robust, use_imu=use_imu), state)
    assert_sound(state, odometry)


def test_the_zero_of_time_changes_nothing():
    """The interval between the zero of time and the first message does not matter either."""
    flight = fly(16, 4.0, tdoa_std=0.5)
    imu, d = flight.imu, flight.tdoa
    later = replace(flight, imu=replace(imu, t=imu.t + 1024.0), tdoa=replace(d, t=d.t + 1024.0))
    odometry, residuals = drive(flight)
    shifted, others = drive(later)
    np.testing.assert_allclose(shifted.x, odometry.x, atol=1e-9)
    np.testing.assert_allclose(others.innovation, residuals.innovation, atol=1e-9)


def test_stamps_that_repeat_are_used_and_move_nothing():
    flight = fly(12, 3.0)
    doubled = np.repeat(np.arange(len(flight.imu)), 2)
    twice = replace(flight, imu=kept(flight.imu, doubled))
    odometry, _ = drive(flight)
    again, _ = drive(twice)
    # The repeated sample is averaged with itself instead of the one before. The input differs by
    # half the change between samples.
    np.testing.assert_allclose(again.x[:, :3], odometry.x[:, :3], atol=0.02)


@pytest.mark.slow
def test_stays_sound_over_an_hour_of_updates():
    flight, config = (
        fly(13, 60.0, imu_rate=100.0, tdoa_rate=50.0),
        FilterConfig(odometry_rate=1.0),
    )
    state = state_for(flight)
    for lap in range(60):
        later = replace(
            flight,
            imu=replace(flight.imu, t=flight.imu.t + 60.0 * lap),
            tdoa=replace(flight.tdoa, t=flight.tdoa.t + 60.0 * lap),
        )
        assert_sound(state, drive(later, config, state)[0])
    assert state.record.running


@pytest.mark.slow
@pytest.mark.usefixtures("must_end")
def test_a_clock_that_leaps_forward_does_not_stall_the_filter():
    """The leap is 1.7e6 s: a thousandth of the leap from zero to the wall clock, 1.7e9 s."""
    flight = fly(14, 2.0)
    state = state_for(flight)
    drive(flight, state=state)
    imu, d = flight.imu, flight.tdoa
    leap = replace(flight, imu=replace(imu, t=imu.t + 1.7e6), tdoa=replace(d, t=d.t + 1.7e6))
    odometry, _ = drive(leap, state=state)
    assert_sound(state, odometry)


# --- history ---


def recorded(flight, config=None):
    """Return (records, residuals) of a flight that is fed at once."""
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
        (records["kind"] == UPDATE) & (records["jacobian"][:, :3] != 0.0).sum(axis=1).astype(bool)
    ]
    used = residuals["innovation"][residuals["verdict"] == USED]
    assert np.isin(used, of_position["innovation"]).all()


def test_a_record_leads_to_the_next():
    """P after an update is (I - K h) (Phi P Phi' + Q).

    States without process noise have Q = 0. Here, the tag has no IMU, and only the yaw has noise.
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
        gain, row = record["gain"], record["jacobian"]
        np.testing.assert_allclose(
            record["P"], (np.eye(15) - np.outer(gain, row)) @ prior, atol=1e-9
        )
        assert record["variance"] * gain == pytest.approx(prior @ row, abs=1e-9)


def test_what_a_record_does_not_lead_to_is_noise():
    """A tag is lifted from rest, and its old velocity gives no information.

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
    """Return a Flight that lies still for 4 s, then accelerates upwards at 0.5 m/s^2 for 1 s."""
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
