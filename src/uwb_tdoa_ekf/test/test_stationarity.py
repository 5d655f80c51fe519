"""A tag that does not move, through the whole filter."""

from dataclasses import replace

from flights import corners, fly
import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline

PLACE = np.array([2.5, 5.0, 0.03])


def on_floor(seed, duration, late=3.3, shaking=0.0, lift=np.inf, back=np.inf, known=None):
    """A flight that stands at PLACE and, from `lift` s on, rises by 0.5 m/s^2 for 2 s, stays up,
    and comes down likewise from `back` s on; while it is below 0.12 m the anchors at 0.15 m are
    about `late` m later, or all by `known` (8,) m. shaking : m/s^2, white, of the accelerometer.
    """
    low = replace(corners(), positions=np.array(corners().positions) + [0.0, 0.0, 0.15])
    flight, rng = (
        fly(seed, duration, hover=True, anchors=low, imu_rate=400.0, tdoa_rate=360.0),
        np.random.default_rng(seed),
    )

    def risen(t):
        since = np.clip(t, 0.0, 2.0)
        return np.where(
            since < 1.0, 0.25 * since**2, 0.25 + 0.5 * (since - 1.0) - 0.25 * (since - 1.0) ** 2
        )

    def at(t):
        return PLACE + np.stack([0.0 * t, 0.0 * t, risen(t - lift) - risen(t - back)], axis=1)

    def force(t):
        return np.where((t >= 0.0) & (t < 1.0), 0.5, np.where((t >= 1.0) & (t < 2.0), -0.5, 0.0))

    t, positions = flight.tdoa.t, low.positions
    a, b = low.index(flight.tdoa.a), low.index(flight.tdoa.b)
    p = at(t)
    of_anchor = np.where(
        positions[:, 2] < 1.0, late + 0.2 * rng.standard_normal(len(positions)), 0.0
    )
    of_anchor = of_anchor if known is None else known
    near = p[:, 2] < 0.12
    d = (
        tdoa(p, positions[a], positions[b])
        + 0.08 * rng.standard_normal(len(t))
        + near * (of_anchor[b] - of_anchor[a])
    )
    up = force(flight.imu.t - lift) - force(flight.imu.t - back)
    accel = (
        flight.imu.accel
        + np.stack([0.0 * up, 0.0 * up, up], axis=1)
        + shaking * rng.standard_normal((len(up), 3))
    )
    truth = replace(flight.truth, p=at(flight.truth.t))
    return replace(
        flight,
        tdoa=replace(flight.tdoa, d=d),
        imu=Imu(flight.imu.t, flight.imu.gyro, accel),
        truth=truth,
    )


def run(flight, corrector=None, **config):
    """(t, error (n, 3) m, NEES (n,)) of the odometry."""
    odometry = run_offline(flight, FilterConfig(**config), corrector).odometry
    error = odometry.p - np.stack(
        [np.interp(odometry.t, flight.truth.t, flight.truth.p[:, k]) for k in range(3)], axis=1
    )
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(odometry.covariance[:, :3, :3]), error)
    return odometry.t, error, nees


@pytest.mark.parametrize("shaking", [0.0, 0.6])
def test_on_a_floor_where_low_anchors_are_late_it_is_right_and_honest(shaking):
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 6.0, shaking=shaking))
        assert t[0] < 0.7 and np.linalg.norm(error, axis=1).max() < 0.5
        assert nees.mean() < 9.0


@pytest.mark.parametrize("margin", [5.0, 1000.0])
def test_in_a_wide_workspace_it_starts_on_the_floor_too(margin):
    """Free in z late low anchors put it metres above the hall, which is within such a workspace."""
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 3.0, shaking=0.6), workspace_margin=margin)
        assert t[0] < 0.7 and np.linalg.norm(error, axis=1).max() < 0.5 and nees.mean() < 9.0


@pytest.mark.parametrize("shaking", [0.0, 0.6])
def test_it_leaves_the_floor_with_the_tag(shaking):
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 8.0, shaking=shaking, lift=3.0))
        step = np.linalg.norm(np.diff(error, axis=0), axis=1).max()
        assert np.linalg.norm(error, axis=1).max() < 0.5 and step < 0.3
        assert np.linalg.norm(error[t > 6.0], axis=1).max() < 0.25
        assert nees.mean() < 9.0


def test_it_comes_down_with_the_tag_while_rotors_still_turn():
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 12.0, shaking=0.6, lift=3.0, back=7.0))
        landed = t > 9.5
        assert np.linalg.norm(error[landed], axis=1).max() < 0.5 and nees[landed].mean() < 9.0
        assert np.linalg.norm(error[(t > 6.0) & ~landed], axis=1).max() < 0.5


def test_delays_that_are_known_of_the_floor_make_it_sharp():
    delays = np.where(
        np.array(corners().positions)[:, 2] < 1.0, 3.3, [0.0, 0.6, 0.0, 0.0] * 2
    ) + 0.05 * np.arange(8)
    values = {f"{i}.delay": delay for i, delay in zip(corners().ids, delays)} | {
        "x": PLACE[0],
        "y": PLACE[1],
    }
    for seed in range(4):
        flight = on_floor(seed, 8.0, shaking=0.6, lift=5.0, known=delays)
        corrector = Corrector(flight.anchors, EffectSet((EFFECTS["floor_multipath"](values),)))
        (t, without, _), (_, error, nees) = run(flight), run(flight, corrector)
        rest = t < 4.9
        assert np.linalg.norm(error[rest], axis=1).max() < 0.25 and nees[rest].mean() < 9.0
        assert np.sqrt(np.mean(error[rest] ** 2)) < 0.6 * np.sqrt(np.mean(without[rest] ** 2))
        assert np.linalg.norm(error[t > 7.0], axis=1).max() < 0.3


def test_a_tag_that_lies_still_stays_where_it_is_without_tdoas():
    """One second of TDOAs, then nothing for ten: the firmware's own test asks for 5 m."""
    for seed in range(4):
        flight = on_floor(seed, 11.0, late=0.0)
        heard = flight.tdoa.t < 1.0
        flight = replace(
            flight, tdoa=Tdoas(*(column[heard] for column in vars(flight.tdoa).values()))
        )
        t, error, nees = run(flight)
        assert t[-1] > 10.9 and np.linalg.norm(error, axis=1).max() < 0.5 and nees.max() < 20.0


def test_without_an_imu_it_stands_too():
    for seed in range(4):
        flight = replace(on_floor(seed, 5.0), imu=None)
        _, error, nees = run(flight, use_imu=False)
        assert np.linalg.norm(error, axis=1).max() < 0.6 and nees.mean() < 9.0


def share_at_rest(flight):
    """Share of the time, from 1 s on, in which a filter takes the tag for one at rest."""
    estimator, resting = Estimator(flight.anchors, FilterConfig()), []
    for now in np.arange(0.1, flight.imu.t[-1], 0.1):
        for stream, add in ((flight.imu, estimator.add_imu), (flight.tdoa, estimator.add_tdoa)):
            rows = (stream.t >= now - 0.1) & (stream.t < now)
            add(*(column[rows] for column in list(vars(stream).values())[:4]))
        estimator.advance()
        if now > 1.0:
            resting.append(estimator._ekf.resting)
    return np.mean(resting)


def test_too_few_tdoas_are_no_evidence_of_motion():
    """Pairs at random, as TDoA3 has them: in many looks no pair is heard often enough.

    Counted as motion, such looks left 0.15 of the time.
    """
    at_rest = [
        fly(seed, 20.0, hover=True, tdoa_rate=240.0, accel_noise=0.003, gyro_noise=0.0005)
        for seed in range(3)
    ]
    assert np.mean([share_at_rest(flight) for flight in at_rest]) > 0.6
    assert (
        share_at_rest(fly(0, 20.0, tdoa_rate=240.0, accel_noise=0.003, gyro_noise=0.0005)) == 0.0
    )  # it flies
