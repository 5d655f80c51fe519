# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Height, pressure and velocity in the core.

The tests compare each update with the textbook, and fly with sensor faults.
"""

from dataclasses import replace
from importlib import import_module
from importlib.util import module_from_spec

from covariances import assert_covariance
from flights import (
    corners,
    errors_of,
    fly,
    measurements,
    position_at,
    rms_error,
    with_ranges,
    with_sensors,
)
from hypothesis import given, settings, strategies as st
from live import assert_same
import numpy as np
from priors import Prior, with_offset
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.robust_loss import LOSSES
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.samples import OF_STATE
from uwb_tdoa_ekf.core import auxiliary, config, height, plane, sensors, update, velocity
from uwb_tdoa_ekf.core.config import ROBUST, FilterConfig
from uwb_tdoa_ekf.core.engine import feed
from uwb_tdoa_ekf.core.history import NOTHING
from uwb_tdoa_ekf.core.hypotheses import IMPROBABLE
from uwb_tdoa_ekf.core.inertial import rows_of, subtract
from uwb_tdoa_ekf.core.memory import (
    IMU_SAMPLE,
    N_YAWS,
    RESIDUAL,
    SENSOR_ROW,
    USED,
    new_state,
    sensor_rows,
)
from uwb_tdoa_ekf.core.state import TRANSITION, inject
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline

# --- auxiliary sensors ---

seeds = st.integers(0, 2**32 - 1)
STEP = 1e-6


def tilted(seed):
    """Return a prior with a random attitude and velocity."""
    prior = Prior(seed)
    prior.hypothesis.x[3:6] = prior.rng.uniform(-3.0, 3.0, 3)
    prior.hypothesis.x[6:10] = Rotation.random(random_state=prior.rng.integers(2**31)).as_quat()
    return prior


def assert_row_is_the_derivative(prior, compare):
    """Check the row of an innovation by differences.

    compare() computes the innovation. Each entry of its row is the decrease of the innovation per
    unit of error of that state.
    """
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
    prior, value, R = tilted(seed), (1.0, -2.0, 0.5)[axis], np.empty((3, 3))
    assert_row_is_the_derivative(
        prior, lambda: velocity.compare(prior.hypothesis, value, 0.1, axis, R, prior.innovation)
    )


@given(seeds, st.integers(0, 1))
def test_a_tilt_depends_on_the_attitude(seed, axis):
    prior, R = tilted(seed), np.empty((3, 3))
    assert_row_is_the_derivative(
        prior, lambda: plane._is_tilted(prior.hypothesis, axis, 0.02, R, prior.innovation)
    )
    plane._is_tilted(prior.hypothesis, axis, 0.02, R, prior.innovation)
    x, y, z, w = prior.hypothesis.x[6:10]
    up = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x)
    assert prior.innovation.value == pytest.approx(-up[axis])


@given(seeds)
def test_a_yaw_rate_depends_on_the_bias_of_the_gyroscope(seed):
    prior, sensor, imu = tilted(seed), np.zeros(1, SENSOR_ROW)[0], new_state(np.eye(3)).record.imu
    sensor["value"], sensor["std"], imu.gyro[:] = [0.0, 0.0, 0.0, 0.7], 0.1, [0.1, 0.2, 0.5]
    assert_row_is_the_derivative(
        prior, lambda: velocity._compare_yaw_rate(prior.hypothesis, sensor, imu, prior.innovation)
    )
    velocity._compare_yaw_rate(prior.hypothesis, sensor, imu, prior.innovation)
    assert prior.innovation.value == pytest.approx(0.7 - (0.5 - prior.hypothesis.x[15]))


@given(seeds, st.sampled_from([None, auxiliary.PRESSURE, auxiliary.RANGE]))
def test_an_update_reaches_the_auxiliary_states_as_the_textbook_says(seed, of):
    prior = Prior(seed)
    joint, innovation = with_offset(prior), prior.innovation
    h = np.append(prior.h, np.zeros(3))
    if of is not None:
        h[15 + of] = 1.0
        auxiliary.add_offset_jacobian(prior.hypothesis, innovation, of)
        np.testing.assert_allclose(innovation.prior_variance, h @ joint @ h, rtol=1e-9)
    innovation.total_variance = innovation.prior_variance + innovation.noise_variance
    gain = joint @ h / (h @ joint @ h + innovation.noise_variance)
    expected = joint - np.outer(gain, h @ joint)
    update.kalman(prior.hypothesis, innovation)
    scale = np.abs(joint).max()
    np.testing.assert_allclose(prior.hypothesis.P, expected[:15, :15], atol=1e-9 * scale)
    np.testing.assert_allclose(prior.hypothesis.offset_cross, expected[15:, :15], atol=1e-9 * scale)
    np.testing.assert_allclose(prior.hypothesis.offset_P, expected[15:, 15:], atol=1e-9 * scale)
    np.testing.assert_allclose(
        prior.hypothesis.offset, [3.0, -0.2, 0.4] + gain[15:] * innovation.value, atol=1e-9
    )


@given(seeds)
def test_the_covariance_with_the_offset_moves_with_the_state(seed):
    prior, transition = Prior(seed), np.zeros(1, TRANSITION).view(np.recarray)[0]
    joint, rng = with_offset(prior), prior.rng
    blocks = {
        name: rng.standard_normal((3, 3)) for name in ("velocity_attitude", "velocity_accel_bias")
    }
    transition.dt, transition.attitude_attitude = (
        0.01,
        Rotation.from_rotvec(rng.standard_normal(3)).as_matrix(),
    )
    phi = np.eye(18)
    phi[:3, 3:6], phi[6:9, 6:9], phi[6:9, 12:15] = (
        0.01 * np.eye(3),
        transition.attitude_attitude,
        -0.01 * np.eye(3),
    )
    phi[15, 16] = 0.01
    for name, columns in (
        ("velocity_attitude", slice(6, 9)),
        ("velocity_accel_bias", slice(9, 12)),
    ):
        transition[name] = blocks[name]
        phi[3:6, columns] = blocks[name]
    auxiliary.predict(prior.hypothesis, transition)
    expected = phi @ joint @ phi.T
    np.testing.assert_allclose(prior.hypothesis.offset_cross, expected[15:, :15], atol=1e-9)
    np.testing.assert_allclose(prior.hypothesis.offset_P, expected[15:, 15:], atol=1e-9)
    np.testing.assert_allclose(prior.hypothesis.offset, [3.0 - 0.01 * 0.2, -0.2, 0.4])


def only(flight, *names):
    return replace(
        flight, **{name: None for name in ("height", "pressure", "velocity") if name not in names}
    )


def rms(flight, config=None, after=2.0):
    """Return the RMS errors (3,) per axis, in m, from `after` s on."""
    odometry = run_offline(flight, config).odometry
    chosen = odometry.t > after
    return np.sqrt(
        np.mean((odometry.p[chosen] - position_at(flight, odometry.t[chosen])) ** 2, axis=0)
    )


@pytest.fixture(scope="module")
def flight():
    return with_sensors(
        fly(3, 20.0, tdoa_std=0.3, accel_noise=0.05, gyro_noise=0.002), drift=1.0 / 60.0
    )


@pytest.fixture(scope="module")
def without(flight):
    return rms(only(flight))


def test_each_sensor_helps(flight, without):
    of_height, of_pressure, of_velocity = (
        rms(only(flight, name)) for name in ("height", "pressure", "velocity")
    )
    assert of_height[2] < 0.02 and of_height[2] < 0.5 * without[2]
    assert of_pressure[2] < without[2]
    assert np.linalg.norm(of_velocity) < np.linalg.norm(without)


def changed(flight, change):
    """Return the flight with change(t, range) (n,) in place of its ranges."""
    return replace(
        flight, height=replace(flight.height, range=change(flight.height.t, flight.height.range))
    )


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
    # The filter needs 3 s to detect a stuck sensor.
    after = 11.0 if fault == "stuck" else 2.0
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
    verdict = run_offline(wrong).sensors["velocity"]["verdict"]
    assert (verdict[(t > 6.0) & (t < 8.0)] != USED).mean() > 0.9 and (
        verdict[t > 9.0] == USED
    ).mean() > 0.9


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_the_filter_is_never_locked_out_by_a_wrong_start(seed):
    """Ranges begin after 2 s. The error of z falls below 0.15 m by 4 s, whatever it was before."""
    flight = only(with_sensors(fly(seed % 1000, 6.0, tdoa_std=0.5)), "height")
    kept = flight.height.t > 2.0
    late = replace(
        flight,
        height=replace(flight.height, t=flight.height.t[kept], range=flight.height.range[kept]),
    )
    run = run_offline(late)
    odometry = run.odometry
    error = odometry.p[:, 2] - position_at(late, odometry.t)[:, 2]
    assert np.abs(error[odometry.t > 4.0]).max() < 0.15
    assert np.mean(run.sensors["height"]["verdict"] == USED) > 0.8


SENSOR_NAMES = "height", "pressure", "velocity", "range"


@settings(max_examples=25, deadline=None)
@given(
    seeds,
    st.sampled_from(ROBUST),
    st.sampled_from(LOSSES),
    st.sets(st.sampled_from(SENSOR_NAMES)),
    st.booleans(),
    st.booleans(),
)
def test_any_sensors_in_any_mode_leave_covariances(seed, robust, loss, names, slopes, wrong):
    """Test states and covariances with random sensors, options and faults.

    slopes : the biases of TDOAs change with position and velocity.
    wrong : each sensor has outliers.
    """
    rng = np.random.default_rng(seed)
    flight = with_ranges(with_sensors(fly(seed % 1000, 3.0, accel_noise=0.05, outliers=0.05)))
    fed, sensors = measurements(flight), []
    if slopes:
        fed.tdoa["slope"], fed.tdoa["state"] = (
            0.3 * rng.standard_normal((len(fed.tdoa), 6)),
            0.3 * rng.standard_normal((len(fed.tdoa), 6)),
        )
    for name in names:
        rows, usable = sensor_rows(name, getattr(flight, name), flight.anchors)
        rows["value"][:, 0] += np.where(wrong & (rng.random(len(rows)) < 0.1), 2.0, 0.0)
        sensors.append(rows[usable])
    together = np.concatenate([np.empty(0, SENSOR_ROW), *sensors])
    fed = fed._replace(sensors=together[np.argsort(together["t"], kind="stable")])
    state = new_state(flight.anchors.positions)
    odometry, _, of_sensors = feed(state, FilterConfig(robust=robust, loss=loss).parameters(), fed)
    assert len(odometry) and all(np.isfinite(odometry[name]).all() for name in ("x", "covariance"))
    assert (
        np.isfinite(state.record.barometer.nis)
        and (of_sensors["variance"][~np.isnan(of_sensors["variance"])] > 0.0).all()
    )
    for hypothesis in state.record.hypotheses:
        if hypothesis["log_weight"] > -np.inf:
            there = np.flatnonzero(np.append(np.ones(15), np.diag(hypothesis["offset_P"]) > 0.0))
            joint = np.block(
                [
                    [hypothesis["P"], hypothesis["offset_cross"].T],
                    [hypothesis["offset_cross"], hypothesis["offset_P"]],
                ]
            )
            assert_covariance(joint[np.ix_(there, there)], tolerance=1e-6)


@pytest.mark.parametrize("name", [name for name in SENSORS if name != "range"])  # engine.py has it
def test_two_measurements_of_one_stamp_leave_a_finite_state(name):
    """Call `observe` alone: compiled code raises no error for a division by 0."""
    ekf, parameters = new_state(np.eye(3)).record, FilterConfig().parameters()[0]
    ekf.hypotheses[0]["log_weight"], ekf.hypotheses[0]["P"] = 0.0, np.eye(15)
    ekf.hypotheses[0]["x"][:] = np.eye(16)[9]
    rows, residuals = np.zeros(2, SENSOR_ROW), np.zeros(2, RESIDUAL)
    rows["t"], rows["value"], rows["std"] = 5.0, 0.1, 0.1
    observe = import_module(f"uwb_tdoa_ekf.core.{name}").observe
    for row, residual in zip(rows.view(np.recarray), residuals.view(np.recarray)):
        observe(ekf, parameters, row, residual, NOTHING)
    finite = all(np.isfinite(ekf.hypotheses[0][field]).all() for field in ("x", "P", "log_weight"))
    assert finite and np.isfinite(residuals["innovation"]).all(), (
        f"`observe` of core/{name}.py divides by 0: limit a difference of stamps from below"
    )


@pytest.mark.parametrize(
    "module, parameter, error, message",
    [
        (sensors, "use_sonar", NotImplementedError, "no branch for sonar of SENSORS"),
        (
            config,
            "gyro_noise",
            InputError,
            "sonar, `parameters`: the filter has gyro_noise already",
        ),
    ],
)
def test_a_sensor_that_does_not_fit_the_filter_is_refused_at_the_start(
    module, parameter, error, message, monkeypatch
):
    """Both modules look at the registry when they are imported. Here they run once more."""
    velocity = SENSORS["velocity"]
    parameters = {parameter: velocity.parameters["use_velocity"]}
    monkeypatch.setitem(SENSORS, "sonar", replace(velocity, name="sonar", parameters=parameters))
    with pytest.raises(error, match=message):
        module.__spec__.loader.exec_module(module_from_spec(module.__spec__))


def test_an_update_that_compiled_code_cannot_call_is_named():
    @compiled
    def short(ekf, parameters, sensor):
        pass

    for wrong in (height.observe.py_func, short):
        with pytest.raises(NotImplementedError, match="`observe` of core.sonar must be @compiled"):
            sensors._check("core.sonar", wrong)
    sensors._check("core.sonar", height.observe)


def test_a_kind_without_a_branch_raises():
    flight = with_sensors(fly(1, 3.0))
    fed = measurements(flight)
    rows, _ = sensor_rows("velocity", flight.velocity, flight.anchors)
    rows["kind"] = len(SENSORS)
    state = new_state(flight.anchors.positions)
    with pytest.raises(NotImplementedError, match="without a branch"):
        feed(state, FilterConfig().parameters(), fed._replace(sensors=rows))


@pytest.mark.slow
@pytest.mark.parametrize("followed", [0, 1])
def test_a_range_finder_decides_between_mirrored_places(followed):
    """Two equally probable hypotheses lie 1.4 m below and above anchors in a plane.

    The tag is at the lower one.
    """
    state, parameters = new_state(np.array(corners().positions)), FilterConfig().parameters()[0]
    ekf, sensor, residual, places = (
        state.record,
        np.zeros(1, SENSOR_ROW)[0],
        np.zeros(1, RESIDUAL)[0],
        (0, N_YAWS),
    )
    ekf.workspace[:], ekf.running, ekf.best = (
        [[-1.0, -1.0, -1.0], [8.0, 9.0, 4.0]],
        True,
        places[followed],
    )
    ekf.hypotheses["log_weight"] = -np.inf
    for h, z in zip(places, (1.1, 2.5)):
        ekf.hypotheses["log_weight"][h], ekf.hypotheses["x"][h, [2, 9]], ekf.hypotheses["P"][h] = (
            0.0,
            [z, 1.0],
            0.01 * np.eye(15),
        )
    for t in np.arange(0.0, 3.0, 0.04):
        sensor["t"], sensor["value"] = t, [1.1 + 0.01 * np.sin(40.0 * t), 0.0, 0.0, 0.0]
        height.observe(ekf, parameters, sensor, residual, NOTHING)
        if t < 0.04:
            assert (
                ekf.hypotheses["log_weight"][places[1]] - ekf.hypotheses["log_weight"][0]
                > -IMPROBABLE
            )
    right, mirrored = ekf.hypotheses["log_weight"][list(places)]
    # The mirrored hypothesis is 150 times less probable. A filter that followed it switches.
    assert right - mirrored > 5.0


def test_a_velocity_that_does_not_change_any_more_is_not_used(flight):
    """The velocity freezes while the tag moves. Later the TDOAs end."""
    t, v = flight.velocity.t, flight.velocity.v.copy()
    v[t > 8.0] = v[t > 8.0][0]
    heard = flight.tdoa.t < 10.0
    cut = replace(
        flight.tdoa, **{name: column[heard] for name, column in vars(flight.tdoa).items()}
    )
    noise = 0.2 * np.random.default_rng(1).standard_normal(flight.imu.accel.shape)  # of motors
    imu = replace(flight.imu, accel=flight.imu.accel + noise)
    run = run_offline(
        replace(only(flight, "velocity"), velocity=replace(flight.velocity, v=v), tdoa=cut, imu=imu)
    )
    verdict, odometry = run.sensors["velocity"]["verdict"], run.odometry
    assert (verdict[t > 8.8] != USED).all() and (
        verdict[(t > 2.0) & (t < 8.0)] == USED
    ).mean() > 0.9
    error = np.linalg.norm(odometry.p - position_at(flight, odometry.t), axis=1)
    stated = np.sqrt(np.trace(odometry.covariance[:, :3, :3], axis1=1, axis2=2))
    assert (error < 3.0 * stated + 0.1).all()


def test_wheels_that_stand_may_repeat_zero():
    still = with_sensors(fly(2, 8.0, hover=True, accel_noise=0.02))
    zero = replace(
        only(still, "velocity"), velocity=replace(still.velocity, v=np.zeros_like(still.velocity.v))
    )
    t = zero.velocity.t
    assert (run_offline(zero).sensors["velocity"]["verdict"][t > 2.0] == USED).mean() > 0.9


@pytest.mark.parametrize("off", [1.4, -0.8, 0.0])
def test_a_fixed_height_that_tdoas_contradict_is_left_and_one_that_they_do_not_holds(off):
    flight = fly(4, 12.0, hover=True, tdoa_std=0.15)
    z = flight.truth.p[0, 2]
    config = FilterConfig(fixed_height=float(z - off), fixed_height_std=0.05)
    odometry = run_offline(flight, config).odometry
    error = np.abs(odometry.p[:, 2] - position_at(flight, odometry.t)[:, 2])
    stated = np.sqrt(odometry.covariance[:, 2, 2])
    late = odometry.t > 4.0
    assert (error < 3.0 * stated + 0.01)[late].all() and error[late].max() < 0.5
    assert (stated[late].max() < 0.1) == (off == 0.0)


def test_a_tag_in_a_lift_is_not_held_at_the_height_that_it_passes():
    flight = fly(4, 40.0, tdoa_rate=50.0)
    z = flight.truth.p[:, 2]
    config = FilterConfig(fixed_height=float(np.mean(z)), fixed_height_std=0.05)
    errors, nees = errors_of(flight, run_offline(flight, config).odometry, after=10.0)
    assert np.ptp(z) > 1.2 and np.sqrt(np.mean(errors[:, 2] ** 2)) < 0.1 and nees.mean() < 6.0


# --- sensor functions ---

SHAPES = {
    "line": (0.2, 1.4),
    "step": (0.2, 0.7, 1.4),
    "wave": (0.2, 0.9),
    "parabola": (0.2, 1.4),
    "spline": (0.2, 0.6, 1.4),
}


def function(channel="accel.z", covariate="height", shape="line", size=1.0):
    knots = SHAPES[shape]
    values = dict(zip(("c0", "c1", "c2", "c3"), size * np.array([0.3, 1.0, -0.5, 0.2])))
    count = {"line": 2, "step": 2, "wave": 3, "parabola": 3, "spline": 4}[shape]
    return SmoothTerm(
        channel=channel,
        covariate=covariate,
        knots=knots,
        shape=shape,
        values=dict(list(values.items())[:count]),
    )


def taken(effect, x):
    """Return the correction that is subtracted from a sample at a nominal state."""
    samples = np.zeros(1, IMU_SAMPLE)
    subtract(rows_of(EffectSet((effect,)).sensor_functions), x, samples[0])
    return -samples["gyro"][0], -samples["accel"][0]


@given(
    state=st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6),
    shape=st.sampled_from([s for s in SHAPES if s != "step"]),
)
def test_it_is_the_curve_at_the_state(state, shape):
    x = np.array([*state, *np.zeros(10)])
    at = {"x": x[0], "y": x[1], "height": x[2], "speed": np.linalg.norm(x[3:6]), "climb_rate": x[5]}
    for covariate in OF_STATE:
        effect = function("gyro.y", covariate, shape)
        gyro, accel = taken(effect, x)
        expected = effect.curve(np.array([at[covariate]]))[0]
        np.testing.assert_allclose(gyro, [0.0, expected, 0.0], atol=2e-3)
        assert not accel.any()


def test_a_step_is_one():
    x = np.zeros(16)
    for z, expected in ((0.5, 0.3), (0.9, 1.3), (-9.0, 0.3), (9.0, 1.3)):
        x[2] = z
        assert taken(function(shape="step"), x)[1][2] == pytest.approx(expected)


def test_several_add_up_on_their_axes():
    samples, x = np.zeros(1, IMU_SAMPLE), np.ones(16)
    effects = [function("gyro.x", "x"), function("accel.y", "y"), function("accel.y", "height")]
    subtract(rows_of(EffectSet(tuple(effects)).sensor_functions), x, samples[0])
    expected = [effect.curve(np.ones(1))[0] for effect in effects]
    np.testing.assert_allclose(samples["gyro"][0], [-expected[0], 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(
        samples["accel"][0], [0.0, -expected[1] - expected[2], 0.0], atol=1e-3
    )


def with_error(flight, effect):
    """Return the Flight with an effect at the true positions on its inertial samples."""
    at = np.interp(flight.imu.t, flight.truth.t, flight.truth.p[:, 2])
    accel = flight.imu.accel.copy()
    accel[:, 2] += effect.curve(at)
    return replace(flight, imu=replace(flight.imu, accel=accel))


def test_the_filter_takes_it_out():
    flight, effect = fly(21, 12.0, tdoa_std=0.1), function(size=2.0)
    wrong = with_error(flight, effect)

    def error(flight, *effects):
        run = run_offline(flight, None, Corrector(flight.anchors, EffectSet(effects)))
        return rms_error(flight, run.odometry, 3.0)

    plain, before, after = error(flight), error(wrong), error(wrong, effect)
    assert before > 1.5 * plain and after < plain + 0.1 * (before - plain)


def test_live_it_is_the_same_and_the_recording_stays_as_it_is():
    flight, effect = fly(22, 4.0), function()
    known, accel = EffectSet((effect,)), flight.imu.accel.copy()
    offline = run_offline(flight, None, Corrector(flight.anchors, known))
    estimator = Estimator(flight.anchors, reorder=0.0, effects=known)
    estimator.add_imu(flight.imu.t, flight.imu.gyro, flight.imu.accel)
    estimator.add_tdoa(flight.tdoa.t, flight.tdoa.a, flight.tdoa.b, flight.tdoa.d)
    assert_same(estimator.finish()[0], offline.odometry)
    np.testing.assert_array_equal(flight.imu.accel, accel)
    assert np.abs(offline.odometry.p - run_offline(flight).odometry.p).max() > 1e-3


@pytest.mark.parametrize("covariate", ["vibration", "rate_x", "time"])
def test_what_streams_tell_is_not_for_the_filter(covariate):
    assert EffectSet((function("gyro.x", covariate),)).sensor_functions == ()
