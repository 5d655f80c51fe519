# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from covariances import assert_covariance
from flights import (
    WORKSPACE,
    corners,
    errors_of,
    fly,
    kept,
    leaving,
    position_at,
    with_ranges,
    without_tdoas,
)
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf import smoother
from uwb_tdoa_ekf.core.config import ROBUST, FilterConfig
from uwb_tdoa_ekf.offline import run_offline, without_offset
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_ekf.smoother import smooth

NOISE = dict(accel_noise=0.05, gyro_noise=0.003)


def rmse(flight, odometry):
    error, _ = errors_of(flight, odometry, 1.0)
    return np.sqrt(np.mean(np.sum(error**2, axis=1)))


def batch(t, a, b, d, positions, p0, prior_std, q, tdoa_std):
    """Solve the least-squares problem of a whole recording as one system of equations.

    The tag moves along a straight line with white acceleration noise. TDOAs are linearized about
    p0.

    Returns positions (n, 3) and their covariances.
    """
    n = len(t)
    rows, values = [], []

    def add(entries, value, std):
        row = np.zeros(6 * n)
        for place, number in entries:
            row[place] += number
        rows.append(row / std), values.append(value / std)

    for k in range(3):
        add([(k, 1.0)], 0.0, prior_std[0])
        add([(3 + k, 1.0)], 0.0, prior_std[1])
    for i in range(1, n):
        dt = t[i] - t[i - 1]
        for k in range(3):
            add([(6 * i + k, 1.0), (6 * i - 6 + k, -1.0), (6 * i - 3 + k, -dt)], 0.0, 1e-6)
            add([(6 * i + 3 + k, 1.0), (6 * i - 3 + k, -1.0)], 0.0, q * np.sqrt(dt))
    for i in range(n):
        ra, rb = p0 - positions[a[i]], p0 - positions[b[i]]
        g = rb / np.linalg.norm(rb) - ra / np.linalg.norm(ra)
        add(
            [(6 * i + k, g[k]) for k in range(3)],
            d[i] - np.linalg.norm(rb) + np.linalg.norm(ra),
            tdoa_std,
        )
    A = np.array(rows)
    solution = np.linalg.lstsq(A, np.array(values), rcond=None)[0]
    covariance = np.linalg.inv(A.T @ A)
    return solution.reshape(n, 6)[:, :3], np.array(
        [covariance[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] for i in range(n)]
    )


@pytest.mark.parametrize("use_imu", [True, False])
def test_smoothing_halves_what_filtering_leaves(use_imu):
    ratios = []
    for seed in range(4):
        flight = fly(seed, 12.0, tdoa_std=0.25, outliers=0.05, **NOISE)
        config = FilterConfig(use_imu=use_imu, initial_yaw_std=0.5)
        ratios.append(
            rmse(flight, smooth(flight, config).odometry)
            / rmse(flight, run_offline(flight, config).odometry)
        )
    assert np.mean(ratios) < 0.75


def test_few_tdoas_without_imu_give_the_path_that_batch_least_squares_gives():
    """It is linearized on itself, with the noise and the motion that all TDOAs show."""
    errors, filtered, nees = [], [], []
    for seed in range(6):
        flight = fly(seed, 60.0, tdoa_rate=2.0, tdoa_std=0.1)
        flight = flight.replaced(imu=None)
        config = FilterConfig(use_imu=False)
        odometry = smooth(flight, config).odometry
        assert_covariance(odometry.covariance)
        assert odometry.t[0] == flight.tdoa.t[0]
        error, of_all = errors_of(flight, odometry, 5.0)
        assert np.linalg.norm(np.diff(error, axis=0), axis=1).max() < 0.5
        errors.append(np.mean(np.sum(error**2, axis=1)))
        filtered.append(rmse(flight, run_offline(flight, config).odometry) ** 2)
        nees.append(of_all.mean() / 3.0)
    assert np.sqrt(np.mean(errors)) < 0.5 * np.sqrt(np.mean(filtered))
    assert 0.3 < np.mean(nees) < 3.0


@pytest.mark.parametrize("use_imu", [True, False])
def test_its_covariance_is_honest_and_never_larger_than_the_filters(use_imu):
    nees = []
    for seed in range(8):
        flight = fly(seed, 12.0, tdoa_std=0.1, accel_bias=0.1, gyro_bias=0.01, **NOISE)
        config = FilterConfig(
            use_imu=use_imu,
            tdoa_std=0.1,
            robust="gate",
            gate=1e6,
            adapt_noise=False,
            accel_noise=0.05,
            gyro_noise=0.003,
            vibration_gain=0.0,
            initial_yaw_std=0.5,
        )
        filtered, smoothed = run_offline(flight, config).odometry, smooth(flight, config).odometry
        assert_covariance(smoothed.covariance)
        variance = [
            np.einsum("nii->ni", odometry.covariance)[:, :3] for odometry in (filtered, smoothed)
        ]
        common = np.isin(filtered.t, smoothed.t), np.isin(smoothed.t, filtered.t)
        assert (variance[1][common[1]] <= variance[0][common[0]] * (1 + 1e-6)).all()
        middle = rows_of(smoothed, (smoothed.t > 2.0) & (smoothed.t < 11.0))
        nees.append(errors_of(flight, middle)[1].mean())
    # The path is a wave, unlike white acceleration.
    assert 2.0 < np.mean(nees) < (4.0 if use_imu else 6.0)


def test_it_is_not_too_certain_beside_a_line_of_anchors(monkeypatch):
    """TDOAs of a line do not show the angle about it. The smoother took the circle for its tangent."""

    def nees():
        out, line = [], np.linspace([0.0, 1.0, 3.0], [7.0, 6.0, 3.0], 8)
        for seed in range(5):
            flight = fly(seed, 40.0, tdoa_rate=100.0, **NOISE)
            tdoas, rng = flight.tdoa, np.random.default_rng(seed)
            a, b = (line[flight.anchors.index(ids)] for ids in (tdoas.a, tdoas.b))
            d = tdoa(position_at(flight, tdoas.t), a, b) + 0.1 * rng.normal(size=len(tdoas))
            flight = replace(flight, anchors=flight.anchors.at(line), tdoa=replace(tdoas, d=d))
            out.append(errors_of(flight, smooth(flight).odometry, 5.0)[1].mean() / 3.0)
        return np.median(out)

    assert nees() < 3.0
    monkeypatch.setattr(smoother, "_with_curvature", lambda smoothed, *_: smoothed)
    assert nees() > 5.0


def test_its_covariance_holds_errors_that_do_not_average_out():
    """The consider covariance equals that of the filter: smoothing does not average it out."""
    flight = fly(2, 14.0, **NOISE)
    # With an unknown yaw, the smoother first finds it and runs the filter again.
    config = FilterConfig(initial_yaw_std=0.1)
    filtered, smoothed = (engine(flight, config).odometry for engine in (run_offline, smooth))
    rows = np.searchsorted(filtered.t, smoothed.t, side="right") - 1
    known = (rows > 0) & (smoothed.t > 2.0)
    expected = np.einsum("nii->n", filtered.consider_covariance[rows[known]])
    np.testing.assert_array_equal(
        np.einsum("nii->n", smoothed.consider_covariance[known]), expected
    )
    assert (
        np.einsum("nii->n", smoothed.covariance[known, :3, :3]) > expected
    ).all() and expected.min() > 0.0


def test_its_covariance_holds_what_an_offset_of_all_ranges_may_be_off_by():
    """The noise is white and stated, so that the covariance holds no other error that persists.

    The anchors have nearly equal heights, so an offset error causes a much larger height error.
    """
    told = dict(
        range_std=0.1,
        robust="gate",
        gate=1e6,
        adapt_noise=False,
        **NOISE,
    )
    config, nees = (
        FilterConfig(vibration_gain=0.0, initial_yaw_std=0.5, range_offset_std=0.3, **told),
        [],
    )
    for seed in range(8):
        flight = with_ranges(
            fly(seed, 5.0, anchors=corners((7.0, 8.0, 0.3)), **NOISE), seed, 100.0, 0.1
        )
        smoothed = smooth(without_offset(without_tdoas(flight), -0.3), config).odometry
        middle = rows_of(smoothed, (smoothed.t > 1.5) & (smoothed.t < 4.5))
        covariance = middle.covariance.copy()
        covariance[:, :3, :3] -= middle.consider_covariance
        both = middle, replace(middle, covariance=covariance)
        nees.append([errors_of(flight, one)[1].mean() for one in both])
    honest, less = np.mean(nees, axis=0)
    assert 2.0 < honest < 5.0 and less > 1.2 * honest


def test_without_imu_it_is_the_least_squares_solution():
    """The comparison begins after the start.

    Noise is white and the tag is at rest, so the problem is linear.
    """
    flight = fly(3, 2.0, hover=True, tdoa_rate=50.0, tdoa_std=0.05)
    config = FilterConfig(
        use_imu=False,
        tdoa_std=0.05,
        robust="gate",
        gate=1e6,
        adapt_noise=False,
        recover=False,
        odometry_rate=1e4,
    )
    first = run_offline(flight, config)
    smoothed = smooth(flight, config).odometry
    used = np.isin(flight.tdoa.t, smoothed.t)
    used[np.flatnonzero(used)[0]] = False  # this TDOA completed the start
    t = flight.tdoa.t[used]
    a, b = flight.anchors.index(flight.tdoa.a[used]), flight.anchors.index(flight.tdoa.b[used])
    p0 = flight.truth.p[0]
    p, covariance = batch(
        t,
        a,
        b,
        flight.tdoa.d[used],
        flight.anchors.positions,
        p0,
        (1e3, 1e3),
        config.motion_noise,
        0.05,
    )
    late = t > t[0] + 0.6  # the covariance of the start is forgotten by then
    at = np.searchsorted(smoothed.t, t[late])
    np.testing.assert_allclose(smoothed.p[at] - p0, p[late], atol=0.01)
    std, expected = (
        np.sqrt(np.einsum("nii->ni", c))
        for c in (smoothed.covariance[at, :3, :3], covariance[late])
    )
    np.testing.assert_allclose(std, expected, rtol=0.1)
    assert len(first.odometry) > 0


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.sampled_from(ROBUST), st.booleans())
def test_sound_for_any_weights_gaps_and_recoveries(seed, robust, use_imu):
    rng = np.random.default_rng(seed)
    flight = fly(seed, 6.0, outliers=0.3, **NOISE)
    kept = (flight.tdoa.t < rng.uniform(1.0, 3.0)) | (flight.tdoa.t > rng.uniform(3.0, 4.0))
    d = flight.tdoa.d + np.where(flight.tdoa.t > 4.5, 1.5 * rng.standard_normal(), 0.0)
    flight = replace(
        flight, tdoa=Tdoas(flight.tdoa.t[kept], flight.tdoa.a[kept], flight.tdoa.b[kept], d[kept])
    )
    odometry = smooth(flight, FilterConfig(robust=robust, use_imu=use_imu)).odometry
    assert np.isfinite(odometry.p).all() and (np.diff(odometry.t) > 0.0).all()
    assert_covariance(odometry.covariance, tolerance=1e-6)


def test_the_unknown_yaw_is_known_from_the_beginning():
    flight = fly(4, 12.0, **NOISE)
    odometry = smooth(flight, FilterConfig(initial_yaw=2.0)).odometry
    attitude = flight.meta["wave"].motion(odometry.t)[2]
    from scipy.spatial.transform import Rotation

    yaw = (attitude.inv() * Rotation.from_quat(odometry.q)).as_rotvec()[:, 2]
    assert np.abs(yaw).max() < np.radians(10.0)


@pytest.mark.parametrize("yaw", [-6.9, 4.5, 7.0])
def test_any_yaw_that_can_be_given_is_smoothed(yaw):
    """The yaw of the filter differs from the given one by a multiple of 90 degrees.

    Their sum may exceed the range of a yaw.
    """
    flight = fly(4, 6.0, **NOISE)
    given, same = (
        smooth(flight, FilterConfig(initial_yaw=each)).odometry
        for each in (yaw, np.remainder(yaw, 2.0 * np.pi) - np.pi)
    )
    assert len(given) and np.isfinite(given.p).all()
    assert rmse(flight, given) < 1.5 * rmse(flight, same) + 0.01


def test_a_tag_outside_of_its_workspace_is_smoothed_to_the_end():
    """The inertial sensor does not feel this motion, so it is not used."""
    flight = leaving(fly(6, 4.0, hover=True, tdoa_rate=400.0))
    odometry = smooth(flight, FilterConfig(use_imu=False)).odometry
    assert odometry.t[-1] > flight.tdoa.t[-1] - 0.01
    assert np.diff(odometry.t).max() < 0.1
    outside = odometry.t > 2.0
    assert (odometry.p[outside] > WORKSPACE[1]).all(axis=1).mean() > 0.5


@pytest.mark.parametrize("seed, late", [(4, 1.5), (2, 3.0), (4, 3.0)])
def test_an_inertial_sensor_that_comes_later_leaves_a_covariance(seed, late):
    """The sensor makes the yaw unknown in flight.

    The filter then changes between yaw hypotheses, each with its own path.
    """
    flight = fly(seed, 10.0, accel_noise=0.05, gyro_noise=0.003, tdoa_std=0.3, tdoa_rate=60.0)
    flight = replace(flight, imu=kept(flight.imu, flight.imu.t > late))
    assert_covariance(smooth(flight).odometry.covariance, tolerance=1e-6)


def ranged(seed, time, size=0.1):
    """Return a flight with ranges only.

    They have white noise. The error of each anchor has a correlation time of `time` s.
    """
    flight = with_ranges(fly(seed, 24.0, **NOISE), seed)
    d, rng = flight.range.d.copy(), np.random.default_rng(seed)
    for anchor in flight.anchors.ids if time else ():
        own = flight.range.anchor == anchor
        stays = np.exp(-np.mean(np.diff(flight.range.t[own])) / time)
        error = size * rng.standard_normal()
        for row in np.flatnonzero(own):
            error = stays * error + size * np.sqrt(1.0 - stays**2) * rng.standard_normal()
            d[row] += error
    return without_tdoas(replace(flight, range=replace(flight.range, d=d)))


def test_the_correlation_of_ranges_is_measured():
    """Eight anchors share 200 ranges a second: 25 for each."""
    lengths = []
    for time in (0.0, 0.5, 1.0):
        flight = ranged(0, time)
        path = smooth(flight).odometry
        lengths.append(smoother.correlation_length(flight, path, EffectSet()))
    assert lengths[0] <= 4.0 and 12.0 < lengths[1] < 38.0 and lengths[1] < lengths[2] < 76.0


def test_ranges_with_errors_that_persist_count_less(monkeypatch):
    flights = [ranged(seed, 1.0) for seed in range(3)]
    measured = [rmse(flight, smooth(flight).odometry) for flight in flights]
    monkeypatch.setattr(smoother, "correlation_length", lambda *_: 1.0)
    as_configured = [rmse(flight, smooth(flight).odometry) for flight in flights]
    white = [
        rmse(flight, smooth(flight, FilterConfig(adapt_noise=False)).odometry) for flight in flights
    ]
    assert np.mean(measured) < 0.9 * np.mean(white)
    assert np.mean(measured) < 0.98 * np.mean(as_configured)


def test_white_ranges_and_ranges_beside_tdoas_are_smoothed_as_configured(monkeypatch):
    beside = with_ranges(fly(0, 6.0, **NOISE))
    for flight in (ranged(0, 0.0), beside):
        one = smooth(flight).odometry
        with monkeypatch.context() as patch:
            patch.setattr(smoother, "correlation_length", lambda *_: 1.0)
            np.testing.assert_array_equal(one.p, smooth(flight).odometry.p)


def test_a_flight_too_short_to_start():
    flight = with_ranges(fly(5, 0.2))
    for short in (flight.without("range"), without_tdoas(flight)):
        assert len(smooth(short).odometry) == 0


@pytest.mark.parametrize("seed", [0, 2])
def test_before_a_restart_the_smoother_keeps_the_yaw_of_the_first_start(seed):
    """After 33 s without data the filter starts again, with four yaws about another one.

    The hypothesis that is best at the end does not belong to the first start.
    """
    low, high = 40.0, 73.0
    flight = fly(seed, 85.0, **NOISE)
    imu, tdoa = (kept(one, (one.t < low) | (one.t > high)) for one in (flight.imu, flight.tdoa))
    flight = replace(flight, imu=imu, tdoa=tdoa)
    smoothed = smooth(flight).odometry
    early = rows_of(smoothed, (smoothed.t > 2.0) & (smoothed.t < low - 1.0))
    true = [np.interp(early.t, flight.truth.t, column) for column in flight.truth.q.T]
    turned = Rotation.from_quat(np.transpose(true)).inv() * Rotation.from_quat(early.q)
    assert np.degrees(turned.magnitude()).max() < 30.0
    assert np.abs(errors_of(flight, early)[0]).max() < 0.5
