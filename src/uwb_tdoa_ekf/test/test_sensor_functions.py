# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from flights import fly, rms_error
from hypothesis import given, strategies as st
from live import assert_same
import numpy as np
import pytest

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.covariates import OF_STATE
from uwb_tdoa_ekf.core.inertial import rows_of, subtract
from uwb_tdoa_ekf.core.memory import IMU_SAMPLE
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline

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
    for height, expected in ((0.5, 0.3), (0.9, 1.3), (-9.0, 0.3), (9.0, 1.3)):
        x[2] = height
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
