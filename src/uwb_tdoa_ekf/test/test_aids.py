"""Height, pressure and velocity in the core: each update against the textbook, and what goes wrong with them in flights."""

from dataclasses import replace

from flights import fly, position_at, with_aids
from hypothesis import given, settings, strategies as st
import numpy as np
from priors import Prior
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.core import auxiliary, height, update, velocity
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import AID
from uwb_tdoa_ekf.core.state import TRANSITION, inject
from uwb_tdoa_ekf.core.verdicts import USED
from uwb_tdoa_ekf.offline import run_offline

seeds = st.integers(0, 2**32 - 1)
STEP = 1e-6


def tilted(seed):
    """A prior with a random attitude and velocity."""
    prior = Prior(seed)
    prior.hypothesis.x[3:6] = prior.rng.uniform(-3.0, 3.0, 3)
    prior.hypothesis.x[6:10] = Rotation.random(random_state=prior.rng.integers(2**31)).as_quat()
    return prior


def assert_row_is_the_derivative(prior, compare):
    """compare() fills in the innovation; its row is by how much the innovation falls when the state errs."""
    compare()
    n = prior.innovation.entries
    row, states = prior.innovation.row[:n].copy(), prior.innovation.states[:n].tolist()
    value, x = prior.innovation.value, prior.hypothesis.x.copy()
    for j in range(15):
        inject(prior.hypothesis.x, np.eye(15)[j], STEP)
        compare()
        slope = (value - prior.innovation.value) / STEP
        assert slope == pytest.approx(row[states.index(j)] if j in states else 0.0, abs=1e-4)
        prior.hypothesis.x[:] = x


@given(seeds)
def test_a_range_depends_on_z_and_tilt(seed):
    prior, parameters = tilted(seed), FilterConfig().parameters()[0]
    R = np.empty((3, 3))
    assert_row_is_the_derivative(
        prior, lambda: height.compare(prior.hypothesis, 0.5, 1.3, parameters, R, prior.innovation)
    )


@given(seeds, st.integers(0, 2))
def test_a_velocity_depends_on_velocity_and_attitude(seed, axis):
    prior, aid = tilted(seed), np.zeros(1, AID)[0]
    aid["value"], aid["std"] = [1.0, -2.0, 0.5], 0.1
    R = np.empty((3, 3))
    assert_row_is_the_derivative(
        prior, lambda: velocity.compare(prior.hypothesis, aid, axis, R, prior.innovation)
    )


def with_offset(prior):
    """Random offset states for a prior; the joint covariance (18, 18)."""
    joint = np.zeros((18, 18))
    joint[:15, :15] = prior.hypothesis.P
    link = 0.1 * prior.rng.standard_normal((3, 15)) @ np.linalg.cholesky(prior.hypothesis.P).T
    joint[15:, :15], joint[:15, 15:] = link, link.T
    joint[15:, 15:] = [[2.0, 0.1, 0.2], [0.1, 1.0, -0.1], [0.2, -0.1, 1.5]]
    prior.hypothesis.offset_cross[:], prior.hypothesis.offset_P[:] = link, joint[15:, 15:]
    prior.hypothesis.offset[:] = [3.0, -0.2, 0.4]
    return joint


@given(seeds, st.sampled_from([None, auxiliary.PRESSURE, auxiliary.RANGE]))
def test_an_update_reaches_the_auxiliary_states_as_the_textbook_says(seed, of):
    prior = Prior(seed)
    joint, innovation = with_offset(prior), prior.innovation
    h = np.append(prior.h, np.zeros(3))
    if of is not None:
        h[15 + of] = 1.0
        auxiliary.depend(prior.hypothesis, innovation, of)
        np.testing.assert_allclose(innovation.prior_variance, h @ joint @ h, rtol=1e-9)
    innovation.total_variance = innovation.prior_variance + innovation.noise_variance
    gain = joint @ h / (h @ joint @ h + innovation.noise_variance)
    expected = joint - np.outer(gain, h @ joint)
    update.kalman(prior.hypothesis, innovation)
    scale = np.abs(joint).max()
    np.testing.assert_allclose(prior.hypothesis.P, expected[:15, :15], atol=1e-9 * scale)
    np.testing.assert_allclose(prior.hypothesis.offset_cross, expected[15:, :15], atol=1e-9 * scale)
    np.testing.assert_allclose(prior.hypothesis.offset_P, expected[15:, 15:], atol=1e-9 * scale)
    np.testing.assert_allclose(prior.hypothesis.offset, [3.0, -0.2, 0.4] + gain[15:] * innovation.value, atol=1e-9)


@given(seeds)
def test_the_covariance_with_the_offset_moves_with_the_state(seed):
    prior, transition = Prior(seed), np.zeros(1, TRANSITION).view(np.recarray)[0]
    joint, rng = with_offset(prior), prior.rng
    blocks = {name: rng.standard_normal((3, 3)) for name in ("velocity_attitude", "velocity_accel_bias")}
    transition.dt, transition.attitude_attitude = 0.01, Rotation.from_rotvec(rng.standard_normal(3)).as_matrix()
    phi = np.eye(18)
    phi[:3, 3:6], phi[6:9, 6:9], phi[6:9, 12:15] = 0.01 * np.eye(3), transition.attitude_attitude, -0.01 * np.eye(3)
    phi[15, 16] = 0.01
    for name, columns in (("velocity_attitude", slice(6, 9)), ("velocity_accel_bias", slice(9, 12))):
        transition[name] = blocks[name]
        phi[3:6, columns] = blocks[name]
    auxiliary.predict(prior.hypothesis, transition)
    expected = phi @ joint @ phi.T
    np.testing.assert_allclose(prior.hypothesis.offset_cross, expected[15:, :15], atol=1e-9)
    np.testing.assert_allclose(prior.hypothesis.offset_P, expected[15:, 15:], atol=1e-9)
    np.testing.assert_allclose(prior.hypothesis.offset, [3.0 - 0.01 * 0.2, -0.2, 0.4])


def only(flight, *names):
    return replace(flight, **{name: None for name in ("height", "pressure", "velocity") if name not in names})


def rms(flight, config=None, after=2.0):
    """RMS errors (3,) m per axis, from `after` s on."""
    odometry = run_offline(flight, config).odometry
    chosen = odometry.t > after
    return np.sqrt(np.mean((odometry.p[chosen] - position_at(flight, odometry.t[chosen])) ** 2, axis=0))


@pytest.fixture(scope="module")
def flight():
    return with_aids(fly(3, 20.0, tdoa_std=0.3, accel_noise=0.05, gyro_noise=0.002), drift=1.0 / 60.0)


@pytest.fixture(scope="module")
def without(flight):
    return rms(only(flight))


def test_each_aid_helps(flight, without):
    of_height, of_pressure, of_velocity = (rms(only(flight, name)) for name in ("height", "pressure", "velocity"))
    assert of_height[2] < 0.02 and of_height[2] < 0.5 * without[2]
    assert of_pressure[2] < without[2]
    assert np.linalg.norm(of_velocity) < np.linalg.norm(without)


def test_a_fixed_height_is_kept():
    low = fly(4, 8.0, hover=True, tdoa_std=0.3)
    z = low.truth.p[0, 2]
    odometry = run_offline(low, FilterConfig(fixed_height=float(z), fixed_height_std=0.02)).odometry
    assert np.abs(odometry.p[:, 2] - z).max() < 0.05
    assert np.abs(run_offline(low).odometry.p[:, 2] - z).max() > 0.05


def changed(flight, change):
    """The flight with change(t, range) (n,) instead of its ranges."""
    return replace(flight, height=replace(flight.height, range=change(flight.height.t, flight.height.range)))


HEIGHT_FAULTS = {
    "steps": lambda t, r: r - np.where((t % 6.0 > 3.0) & (t % 6.0 < 5.0), 0.5, 0.0),
    "gap": lambda t, r: np.where((t > 5.0) & (t < 10.0), np.inf, r),
    "stuck": lambda t, r: np.where(t > 8.0, 1.0, r),
    "factor": lambda t, r: 1000.0 * r,
    "sign": lambda t, r: -r,
    "multipath": lambda t, r: r + np.where(np.random.default_rng(0).random(len(t)) < 0.2, 1.0, 0.0),
}


@pytest.mark.parametrize("fault", HEIGHT_FAULTS)
def test_a_range_finder_that_is_wrong_does_no_harm(flight, fault):
    after = 11.0 if fault == "stuck" else 2.0  # 3 s are for finding out
    without = rms(only(flight), after=after)
    wrong = rms(changed(only(flight, "height"), HEIGHT_FAULTS[fault]), after=after)
    assert np.linalg.norm(wrong) < 1.1 * np.linalg.norm(without)


def test_what_is_below_may_change_for_seconds_and_the_height_stays(flight):
    assert rms(changed(only(flight, "height"), HEIGHT_FAULTS["steps"]))[2] < 0.04


def test_wheels_that_spin_are_not_used(flight, without):
    t, v = flight.velocity.t, flight.velocity.v
    spinning = v + np.where((t > 6.0) & (t < 8.0), 2.0, 0.0)[:, None] * [1.0, 0.0, 0.0]
    wrong = replace(only(flight, "velocity"), velocity=replace(flight.velocity, v=spinning))
    assert np.linalg.norm(rms(wrong)) < 1.1 * np.linalg.norm(without)
    verdict = run_offline(wrong).aids["velocity"]["verdict"]
    assert (verdict[(t > 6.0) & (t < 8.0)] != USED).mean() > 0.9 and (verdict[t > 9.0] == USED).mean() > 0.9


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_the_filter_is_never_locked_out_by_a_wrong_start(seed):
    """Ranges come only after 2 s; whatever z was by then, it is right soon after."""
    flight = only(with_aids(fly(seed % 1000, 6.0, tdoa_std=0.5)), "height")
    kept = flight.height.t > 2.0
    late = replace(flight, height=replace(flight.height, t=flight.height.t[kept], range=flight.height.range[kept]))
    run = run_offline(late)
    odometry = run.odometry
    error = odometry.p[:, 2] - position_at(late, odometry.t)[:, 2]
    assert np.abs(error[odometry.t > 4.0]).max() < 0.15
    assert np.mean(run.aids["height"]["verdict"] == USED) > 0.8
