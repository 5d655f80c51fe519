# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filter core: flights, and the recorded history."""

from dataclasses import replace
from pathlib import Path
import re

from covariances import assert_covariance
from driving import assert_equal, assert_sound, cut, drive, errors, state_for
from flights import (
    corners,
    errors_of,
    fly,
    kept,
    leaving,
    measurements,
    position_at,
    rms_error,
    without_tdoas,
)
import halls
from hypothesis import example, given, settings, strategies as st
from live import IMU, assert_same, joined, messages
import numpy as np
import pytest
from scipy.stats import chi2

from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.correction.corrector import Corrector, known_yaw_std
from uwb_tdoa_bias.correction.model import Network
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet, SmoothTerm, TagLeverArm
from uwb_tdoa_bias.effects.pair import PairOffset
from uwb_tdoa_ekf.core import memory
from uwb_tdoa_ekf.core.config import ROBUST, FilterConfig
from uwb_tdoa_ekf.core.engine import feed, most_records, run
from uwb_tdoa_ekf.core.history import RECORD, RESET, UPDATE
from uwb_tdoa_ekf.core.memory import INVALID, ODOMETRY, RESIDUAL, STARTUP, USED, Output, new_state
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import VERDICTS, rows_of, to_odometry

# --- engine ---

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
        flight, FilterConfig(odometry_rate=1e6, tdoa_std=0.2, adapt_noise=False)
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
@example(3908289501, "gate", False)  # an inverse at a start was not symmetric by 2e-16
@example(2617070708, "innovation", True)
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


# --- offline ---

IDS = corners().ids.tolist()
STEEP = SmoothTerm(
    covariate="height",
    form="common",
    knots=(0.5, 2.5),
    shape="parabola",
    values={"c0": 0.1, "c1": 0.3, "c2": 0.4},
)
EFFECTS = EffectSet(
    (AnchorDelay({IDS[0]: 0.3, IDS[4]: -0.2}), TagLeverArm({"x": 0.05, "z": 0.2}), STEEP)
)


def live(flight, corrector, config=None):
    """Run Estimator and corrector as the two nodes do, message by message in stamp order.

    The corrector uses only the poses that the filter has published until then.
    """
    estimator, parts, corrected = Estimator(flight.anchors, config, reorder=0.0), [], []

    def advance():
        odometry, residuals = estimator.advance()
        told = (
            to_odometry(odometry.q, odometry.v, odometry.covariance)[1]
            if len(odometry)
            else np.empty((0, 9, 9))
        )
        yaw_std = known_yaw_std(np.sqrt(told[:, [3, 4, 5], [3, 4, 5]]))
        for pose in zip(odometry.t, odometry.p, odometry.q, odometry.v, yaw_std):
            corrector.add_pose(*pose)
        parts.append((odometry, residuals))

    for t, stream, i in messages(flight):
        if stream == IMU:
            estimator.add_imu(t, flight.imu.gyro[i], flight.imu.accel[i])
        else:
            a, b = int(flight.tdoa.a[i]), int(flight.tdoa.b[i])
            rows = flight.anchors.index([a]), flight.anchors.index([b])
            correction = corrector.correct(np.array([t]), *rows, flight.tdoa.d[i : i + 1])
            corrected.append((correction.bias[0], correction.std[0]))
            about = correction.slope, correction.state
            estimator.add_tdoa(t, a, b, correction.corrected[0], correction.std[0] ** 2, *about)
        advance()
    odometry, residuals = estimator.finish()
    parts.append((odometry, residuals))
    return (
        joined([part[0] for part in parts]),
        joined([part[1] for part in parts]),
        np.array(corrected),
    )


class Doubt(Network):
    """Stand in for a network with a bias and a deviation that depend on the pose."""

    name = "doubt"

    def __init__(self):
        pass

    def predict(self, samples):
        std = 0.05 + 0.02 * np.abs(samples.q[:, 2])
        return 0.1 * np.sin(samples.p[:, 0]), std, np.ones(len(samples))


@pytest.mark.parametrize(
    ("lag", "network", "grid"),
    [
        (0.05, Doubt(), False),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in ((0.01, None, False), (0.2, Doubt(), False), (0.05, Doubt(), True))
        ),
    ],
)
def test_corrections_are_those_of_live_feeding(lag, network, grid):
    """With `grid`, poses exactly `lag` old and ends of batches coincide with stamps of TDOAs."""
    flight = fly(1, 4.0, imu_rate=100.0 if grid else 200.0, tdoa_rate=200.0, outliers=0.02)
    if grid:
        stamps = np.arange(len(flight.tdoa)) / 200.0
        flight = replace(flight, tdoa=replace(flight.tdoa, t=stamps))
    baseline = run_offline(flight, None, Corrector(flight.anchors, EFFECTS, network, lag))
    odometry, residuals, corrected = live(flight, Corrector(flight.anchors, EFFECTS, network, lag))
    assert_same(odometry, baseline.odometry, 1e-9)
    valid = baseline.residuals.verdict != INVALID
    np.testing.assert_allclose(
        corrected[valid], np.stack([baseline.bias, baseline.bias_std], axis=1)[valid], atol=1e-9
    )
    assert np.abs(baseline.bias).max() > 0.3 and (baseline.residuals.verdict == USED).sum() > 500


class Waiting(Corrector):
    """Wait for poses that no correction depends on."""

    uses_pose = True


def test_constant_corrections_wait_for_no_poses():
    flight = fly(3, 4.0)
    constant = EffectSet((AnchorDelay({IDS[0]: 0.5}), PairOffset({f"{IDS[0]}-{IDS[1]}": 0.1})))
    at_once = Corrector(flight.anchors, constant)
    assert not at_once.uses_pose and Corrector(flight.anchors, EFFECTS).uses_pose
    one, other = (
        run_offline(flight, None, each) for each in (at_once, Waiting(flight.anchors, constant))
    )
    assert_same(one.odometry, other.odometry, 0.0)
    np.testing.assert_array_equal(one.bias, other.bias)
    np.testing.assert_array_equal(one.residuals.innovation, other.residuals.innovation)


def test_what_is_corrected_is_what_was_wrong():
    flight = fly(3, 8.0, tdoa_std=0.05)
    a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
    delay = np.where(flight.anchors.ids == IDS[0], 0.5, 0.0)
    wrong = replace(flight, tdoa=replace(flight.tdoa, d=flight.tdoa.d + delay[b] - delay[a]))
    right = run_offline(
        wrong, None, Corrector(flight.anchors, EffectSet((AnchorDelay({IDS[0]: 0.5}),)))
    )
    np.testing.assert_allclose(right.bias, delay[b] - delay[a], atol=1e-12)
    expected = run_offline(flight)
    np.testing.assert_allclose(right.odometry.p, expected.odometry.p, atol=1e-9)


def climbing(flight, steep):
    """Return a Flight with TDOA errors proportional to the climb rate, and that effect."""
    effect = SmoothTerm(
        covariate="climb_rate",
        knots=(-5.0, 5.0),
        shape="line",
        values={"c0": 0.0, "c1": 10.0 * steep},
    )
    rate = np.gradient(flight.truth.p[:, 2], flight.truth.t)
    d = flight.tdoa.d + effect.curve(np.interp(flight.tdoa.t, flight.truth.t, rate))
    return replace(flight, tdoa=replace(flight.tdoa, d=d)), effect


def test_a_bias_that_changes_with_the_state_is_taken_out_at_the_state(monkeypatch):
    """A correction at an earlier pose alone is insufficient.

    The velocity error then causes a position error.
    """
    wrong, effect = climbing(fly(3, 12.0), 1.5)

    def error(effects=EffectSet()):
        corrector = Corrector(wrong.anchors, effects)
        odometry = run_offline(wrong, FilterConfig(use_imu=False), corrector).odometry
        return rms_error(wrong, odometry, 3.0)

    followed, before = error(EffectSet((effect,))), error()
    monkeypatch.setattr(SmoothTerm, "jacobian_states", ())
    assert followed < 0.2 * before and followed < 0.2 * error(EffectSet((effect,)))


def test_a_slope_tells_nothing_of_a_place_far_away():
    """A slope has no effect if its linearization point is 5 m away.

    This happens after a lost tag is found elsewhere: the bias still belongs to the wrong position.
    """
    flight = fly(7, 2.0)
    slope, state = np.ones((2, len(flight.tdoa), 6))
    state[:, :3] = position_at(flight, flight.tdoa.t) + 5.0
    slope[:, 3:] = 0.0

    def positions(*about):
        estimator = Estimator(flight.anchors, FilterConfig(use_imu=False))
        estimator.add_tdoa(
            *(getattr(flight.tdoa, name) for name in ("t", "a", "b", "d")), 0.0, *about
        )
        return estimator.finish()[0].p

    np.testing.assert_array_equal(positions(slope, state), positions())
    state[:, :3] -= 5.2
    assert np.abs(positions(slope, state) - positions()).max() > 0.1


def test_no_effects_and_no_corrector_are_the_same():
    flight = fly(4, 2.0)
    one, other = run_offline(flight), run_offline(flight, FilterConfig(), Corrector(flight.anchors))
    assert_same(one.odometry, other.odometry)
    assert not one.bias.any() and not one.bias_std.any()


@pytest.mark.parametrize("effects", [None, EFFECTS])
def test_every_tdoa_gets_one_verdict_in_the_order_of_the_flight(effects):
    flight = fly(5, 3.0, outliers=0.1)
    a, d, t = flight.tdoa.a.copy(), flight.tdoa.d.copy(), flight.tdoa.t.copy()
    a[100], a[300], d[301], d[302] = 99, flight.tdoa.b[300], np.nan, 50.0
    t[303] = np.nan
    flight = replace(flight, tdoa=Tdoas(t, a, flight.tdoa.b, d))
    result = run_offline(flight, None, Corrector(flight.anchors, effects))
    residuals = result.residuals
    np.testing.assert_array_equal(residuals.t, t)
    np.testing.assert_array_equal(residuals.a, a)
    assert (residuals.verdict[[100, 300, 301, 302, 303]] == INVALID).all()
    refused = residuals.verdict == INVALID
    beyond = ~(np.abs(d) <= 1.0 + _baseline(flight))
    np.testing.assert_array_equal(refused, beyond | np.isin(np.arange(len(d)), [100, 300, 303]))
    assert np.isnan(residuals.innovation[refused]).all() and not residuals.weight[refused].any()
    assert sum(result.counts.values()) == len(flight.tdoa)
    assert result.counts["startup"] == np.sum(residuals.verdict == STARTUP) > 0


def _baseline(flight):
    positions, anchors = flight.anchors.positions, flight.anchors
    return np.linalg.norm(
        positions[anchors.index(flight.tdoa.a)] - positions[anchors.index(flight.tdoa.b)], axis=1
    )


@pytest.mark.parametrize("size", [np.nan, np.inf, 1e3, 1e308])
@pytest.mark.parametrize("stream", ["gyro", "accel"])
def test_one_absurd_inertial_sample_does_not_poison_the_filter(stream, size):
    flight = fly(11, 3.0)
    getattr(flight.imu, stream)[400] = [size, -size, 0.5 * size]
    odometry = run_offline(flight).odometry
    assert np.isfinite(odometry.p).all() and np.isfinite(odometry.q).all()
    assert_covariance(odometry.covariance)


@pytest.mark.parametrize("effects", [None, EFFECTS])
@pytest.mark.parametrize("count", [0, 11])
def test_flights_too_short_to_start(effects, count):
    flight = fly(7, 2.0)
    tdoa = Tdoas(
        *(column[:count] for column in (flight.tdoa.t, flight.tdoa.a, flight.tdoa.b, flight.tdoa.d))
    )
    none = Imu(np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    for samples in (flight.imu, None, none):
        short = Flight("short", flight.anchors, tdoa, samples)
        result = run_offline(short, None, Corrector(flight.anchors, effects))
        assert len(result.odometry) == 0 and result.odometry.covariance.shape == (0, 9, 9)
        assert result.counts["startup"] == count == len(result.residuals.t) == len(result.bias)


def test_no_anchor_of_the_flight_is_known():
    flight = fly(8, 2.0)
    lost = replace(flight, tdoa=replace(flight.tdoa, a=flight.tdoa.a + 100, b=flight.tdoa.b + 100))
    for effects in (None, EFFECTS):
        result = run_offline(lost, None, Corrector(flight.anchors, effects))
        assert result.counts["invalid"] == len(flight.tdoa) and len(result.odometry) == 0


def test_leaves_the_flight_as_it_was_and_gives_the_same_twice():
    flight = fly(9, 2.0)
    before = flight.tdoa.d.copy(), flight.imu.accel.copy()
    one = run_offline(flight, None, Corrector(flight.anchors, EFFECTS))
    two = run_offline(flight, None, Corrector(flight.anchors, EFFECTS))
    assert_same(one.odometry, two.odometry)
    np.testing.assert_array_equal(flight.tdoa.d, before[0])
    np.testing.assert_array_equal(flight.imu.accel, before[1])


def consistency(
    robust, loss="geman_mcclure", seeds=range(40), duration=20.0, tdoa_std=0.1, **config
):
    """Return NEES and NIS of flights with errors of the filter's own model.

    The filter has the true sizes of all errors.

    Returns
    -------
    nees : (flights, times) array
        At 20 Hz, after 3 s.
    nis : (flights,) array
        Mean over that time.
    count : int
        Number of TDOAs in that time.
    """
    sizes = dict(accel_noise=0.05, gyro_noise=0.003, accel_bias_walk=0.01, gyro_bias_walk=1e-4)
    settings = FilterConfig(
        robust=robust,
        loss=loss,
        tdoa_std=tdoa_std,
        gate=1e6,
        initial_accel_bias_std=0.1,
        initial_gyro_bias_std=0.01,
        **sizes,
        **config,
    )
    times, nees, nis = np.arange(3.0, duration - 0.1, 0.05), [], []
    for seed in seeds:
        flight = fly(seed, duration, tdoa_std=tdoa_std, accel_bias=0.1, gyro_bias=0.01, **sizes)
        result = run_offline(flight, settings)
        at = np.searchsorted(result.odometry.t, times)
        nees.append(errors_of(flight, rows_of(result.odometry, at))[1])
        residuals = result.residuals
        counted = (residuals.verdict <= 1) & (residuals.t > 3.0)
        nis.append(np.mean(residuals.innovation[counted] ** 2 / residuals.variance[counted]))
    return np.array(nees), np.array(nis), int(counted.sum())


def shares_inside(nees, nis, count, what):
    """Return the shares of times and of flights inside the two-sided 95 % chi-square bounds.

    NEES is averaged over flights, NIS over time: Bar-Shalom et al., Estimation with Applications to
    Tracking and Navigation, sec. 5.4.2.
    """
    flights = len(nees)
    low, high = chi2.ppf([0.025, 0.975], 3 * flights) / flights
    mean = nees.mean(axis=0)
    times = np.mean((mean > low) & (mean < high))
    nis_low, nis_high = chi2.ppf([0.025, 0.975], count) / count
    inside = np.mean((nis > nis_low) & (nis < nis_high))
    print(
        f"{what}, {flights} flights: NEES {nees.mean():.2f}, {times:.0%} of the times in "
        f"{low:.2f} ... {high:.2f}; "
        f"NIS {nis.mean():.3f}, {inside:.0%} of the flights in {nis_low:.3f} ... {nis_high:.3f}"
    )
    return times, inside


@pytest.mark.slow
def test_a_plain_update_is_consistent():
    """The noise is white, and the filter has its true size.

    The average position NEES of 40 flights must be inside its 95 % bounds at 90 % of the times. NIS
    must be inside for 85 % of the flights. 38 of 40 are expected. A consistent filter has fewer
    than 34 once in 300 times.
    """
    times, flights = shares_inside(
        *consistency("gate", vibration_gain=0.0, adapt_noise=False), "no gate"
    )
    assert times >= 0.9 and flights >= 0.85


@pytest.mark.slow
@pytest.mark.parametrize(
    "robust, loss",
    [("innovation", "geman_mcclure"), ("m_estimation", "huber")],
)
def test_robust_updates_are_cautious_but_not_overconfident(robust, loss):
    """The weights discard information although the noise is Gaussian.

    Therefore, the covariance may only be too large.
    """
    nees, nis, count = consistency(robust, loss, adapt_noise=False)
    shares_inside(nees, nis, count, f"{robust}, {loss}")
    high = chi2.ppf(0.975, 3 * len(nees)) / len(nees)
    assert np.mean(nees.mean(axis=0) < high) >= 0.9 and nees.mean() > 1.0


def test_a_tag_that_knows_its_noise_is_located_better():
    told, untold = [], []
    for seed in range(4):
        flight, rng = fly(seed, 8.0), np.random.default_rng(seed)
        # In m, in addition to the 0.1 m of every TDOA.
        std = rng.choice([0.0, 1.5], len(flight.tdoa))
        noisy = replace(flight.tdoa, d=flight.tdoa.d + std * rng.standard_normal(len(std)))
        for runs, stream in ((untold, noisy), (told, replace(noisy, variance=std**2))):
            runs.append(rms_error(flight, run_offline(replace(flight, tdoa=stream)).odometry))
    assert np.mean(told) < 0.5 * np.mean(untold)


def test_an_imu_finds_the_place_beside_a_line_of_anchors():
    """The median 3D RMSE is 2.3 m, and 6.6 m if the second-order term adds variance here too."""
    off, shares = [], []
    for seed in range(7):
        flight = halls.fly(halls.room("line, 5"), seed, rate=30.0, speed=1.0)
        odometry = run_offline(flight).odometry
        error, nees = errors_of(flight, odometry, odometry.t[0] + 5.0)
        off.append(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        shares.append(np.mean(nees > chi2.ppf(0.95, 3)))
    assert np.median(off) < 4.0 and np.mean(shares) < 0.05
