# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from covariances import assert_covariance
from flights import corners, errors_of, fly, position_at, rms_error
from live import IMU, assert_same, joined, messages
import numpy as np
import pytest
from scipy.stats import chi2

from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas
from uwb_tdoa_bias.correction.corrector import Corrector, known_yaw_std
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet, SmoothTerm, TagLeverArm
from uwb_tdoa_bias.effects.pair import PairOffset
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import INVALID, STARTUP, USED
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import rows_of, to_odometry

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
        tdoa_correlation_length=1.0,
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
    nees, nis, count = consistency(robust, loss)
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
        for runs, tdoa in ((untold, noisy), (told, replace(noisy, variance=std**2))):
            runs.append(rms_error(flight, run_offline(replace(flight, tdoa=tdoa)).odometry))
    assert np.mean(told) < 0.5 * np.mean(untold)
