# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The compiled filter: events in stamp order in, odometry and residuals out.

FilterState holds the entire state between two calls. Each TDOA or range takes six steps:

1. `_predict` to its stamp (state.predict), or `_initialize` a filter that does not run
   (initialization.start).
2. `_prepare`: detect rest (stationarity) and a position that is unknown after a silence.
3. `_update` each hypothesis: innovation and Jacobian row (`_compare`, ranges.compare), weight
   (update.weigh), gain (update.kalman), probability (hypotheses.add_log_likelihood).
4. Estimate the last TDOAs together, if the tag is alone and sends few (horizon.step).
5. `_select` the best hypothesis (hypotheses.select).
6. `_recover` a filter that its TDOAs contradict (initialization.recover).
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.geometry import linearized_tdoa
from uwb_tdoa_bias.effects.samples import N_STATES

from . import (
    auxiliary,
    ground,
    height,
    history,
    horizon,
    hypotheses,
    imu_fault_detector,
    inertial,
    initialization,
    noise,
    plane,
    ranges,
    sensors,
    stationarity,
    update,
    velocity,
    workspace,
    yaw_check,
)
from .initialization import LOST_TIME, RECOVERY_WINDOW
from .memory import (
    COMPENSATED,
    HYPOTHESES,
    N_YAWS,
    ODOMETRY,
    OFF,
    REPEATED,
    RESIDUAL,
    STARTUP,
    USED,
    FilterState,
    Measurements,
    Output,
    fill_residual,
)
from .startup import INLIER
from .state import CONSTRAINT_PERIOD, coast, predict, turn_about_vertical
from .update import project

# s for which `status` reports a recovery, after a single yaw is left
RECOVERY_NAMED = 5.0
INCONSISTENT = 0.5  # share below which the filter searches for the tag elsewhere
UNSURE_TIME = 0.5  # s of TDOAs after a silence in which the filter searches for a lost tag
MAX_STEP = 0.05  # s, longest single prediction
# s of inertial samples that determine the initial attitude if the IMU starts after the filter
AVERAGED = 0.25
ITERATIONS = 3  # of an update with an uncertain position
# TDOAs/s from which the second-order term of a tag with an IMU adds no variance: the same position
# error acts on many TDOAs, so it is no noise. Set on simulated lines of anchors (gain from 8 on) and
# on measured flights with a tenth of their TDOAs (loss below 20).
LINEAR_RATE = 20.0
# least number of TDOAs that count as one in the choice between hypotheses: outliers must not decide
LEAST_LENGTH = 3.0
# m or m/s from the linearization point, within which the slope of a bias is used
LINEAR_RANGE = 1.0

# Most records in a history per TDOA: its update, workspace, position at rest, another hypothesis,
# starts or recoveries with an opened attitude, an opened yaw, a turned yaw.
RECORDS_OF_TDOA = 1 + 4 + 6 + 1 + 3 + 2 + 1
RECORDS_OF_REST = 3  # one per axis
# a range has the same number; a velocity has one per component, plus an opened yaw
RECORDS_OF_SENSOR = RECORDS_OF_TDOA


@compiled
def run(
    state: FilterState, parameters: np.ndarray, measurements: Measurements, output: Output
) -> int:
    """Run the filter over measurements in stamp order and return the number of odometry rows.

    No measurement may be earlier than measurements of the last call.

    Parameters
    ----------
    state : FilterState
        Updated in place.
    parameters : (1,) PARAMETERS
        Tuning of the filter.
    measurements : Measurements
        Inertial samples, TDOAs and other measurements, each by rising stamp. The sensor functions
        are subtracted from the samples in place, and the delays of the anchors from the TDOAs.
    output : Output
        Filled by this function.

    Returns
    -------
    int
        Number of odometry rows.

    Raises
    ------
    IndexError
        If a history has less room than `most_records`.
    """
    ekf, anchors, values = state.ekf[0], state.anchors, parameters[0]
    imu, tdoa, sensor = measurements.imu, measurements.tdoa, measurements.sensors
    i = k = m = rows = 0
    while i < len(imu) or k < len(tdoa) or m < len(sensor):
        of_imu = imu[i].t if i < len(imu) else np.inf
        of_tdoa = tdoa[k].t if k < len(tdoa) else np.inf
        of_sensor = sensor[m].t if m < len(sensor) else np.inf
        t = min(of_imu, of_tdoa, of_sensor)
        if of_imu == t and i < len(imu):
            if len(state.functions) and ekf.running:
                inertial.subtract(state.functions, ekf.hypotheses[ekf.best].x, imu[i])
            _on_imu(ekf, values, imu[i], output.history)
            i += 1
        elif of_tdoa == t and k < len(tdoa):
            _on_tdoa(ekf, anchors, values, tdoa[k], output.residuals[k], output.history)
            k += 1
        else:
            _on_sensor(ekf, anchors, values, sensor[m], output.sensors[m], output.history)
            m += 1
        if ekf.running and t >= ekf.next_odometry:
            number = math.floor(t * values.odometry_rate + 1e-6) + 1.0
            ekf.next_odometry = number / values.odometry_rate
            _report(ekf, values, t, output.odometry[rows])
            rows += 1
    return rows


# Compiled part of `set_pose`.
@compiled
def _set_pose(
    state: FilterState, parameters: np.ndarray, poses: np.ndarray, records: np.ndarray
) -> None:
    ekf, pose = state.ekf[0], poses[0]
    if ekf.running:
        _predict(ekf, parameters[0], pose.t, records)
    initialization.set_pose(ekf, state.anchors, parameters[0], pose.t, pose, records)


def set_pose(state: FilterState, parameters: np.ndarray, pose: np.ndarray) -> None:
    """Set the pose of the filter; the history does not record it.

    Parameters
    ----------
    state : FilterState
        Updated in place.
    parameters : (1,) PARAMETERS
        Tuning of the filter.
    pose : (1,) POSE
        New pose. It must not be earlier than measurements of the last call.
    """
    _set_pose(state, parameters, pose, history.NOTHING)


def most_records(measurements: Measurements) -> int:
    """Return the number of history records that a call with these Measurements can need."""
    imu, tdoa, sensor = measurements
    spans = [part["t"][-1] - part["t"][0] for part in measurements if len(part)]
    most, seconds = len(imu) + len(tdoa) + len(sensor), max(spans, default=0.0)
    periods = CONSTRAINT_PERIOD, 0.5 * imu_fault_detector.CLEARED
    constraints, switches = (min(most, 2 + int(seconds / period)) for period in periods)
    of_events = RECORDS_OF_TDOA * len(tdoa) + RECORDS_OF_SENSOR * len(sensor)
    return of_events + (RECORDS_OF_REST + plane.RECORDS) * constraints + switches


# Process an IMU_SAMPLE: fault detection, prediction, rest and zero-velocity updates.
@compiled
def _on_imu(ekf: Record, parameters: Record, sample: Record, records: np.ndarray) -> None:
    continuous = inertial.observe(ekf.imu, sample, parameters.imu_timeout)
    imu_faulty = imu_fault_detector.update(
        ekf.imu_fault_detector, ekf.imu, sample, continuous, ekf.imu_faulty
    )
    if imu_faulty != ekf.imu_faulty:
        ekf.imu_faulty = imu_faulty
        _switch(ekf, parameters, records)
    first, calm = ekf.imu.t == -np.inf, continuous and inertial.is_quiet(ekf.imu)
    if not calm:
        ekf.shaken = sample.t
    averaged = -np.inf < ekf.attitude_averaged_until <= sample.t
    if first and ekf.running and parameters.use_imu:
        ekf.attitude_averaged_until = sample.t + AVERAGED
    elif averaged or not ekf.running:
        ekf.attitude_averaged_until = -np.inf
    if ekf.running and _predict(ekf, parameters, sample.t, records):
        if averaged and not ekf.imu_faulty:
            initialization.level_first(ekf, parameters, records)
        if continuous and not ekf.imu_faulty:
            stationarity.detect_liftoff(ekf, sample, sample.t - ekf.imu.t, records)
        ekf.quiet = parameters.zero_velocity and calm and not ekf.imu_faulty
        stationarity.update_zero_velocity(ekf, sample.t, records)
    inertial.store(ekf.imu, sample)


@compiled
def _switch(ekf: Record, parameters: Record, records: np.ndarray) -> None:
    """Stop or resume the use of inertial samples, depending on ekf.imu_faulty.

    A stop increases the covariance. A resumption resets the attitude.
    """
    if ekf.running and ekf.imu_faulty:
        initialization.widen(ekf, records)
    elif ekf.running:
        initialization.reset_attitude(ekf, parameters, initialization.YAW_SEARCH_STD, records)


# Process a TDOA: reject a repeat, predict, update, and search for a lost tag.
@compiled
def _on_tdoa(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    tdoa: Record,
    residual: Record,
    records: np.ndarray,
) -> None:
    _wait(residual)
    delay = _subtract_delays(tdoa, anchors)
    if initialization.is_repeat(ekf, tdoa):
        residual.verdict = REPEATED
        return
    initialization.remember(ekf, tdoa)
    t = tdoa.t
    if not _predict_or_initialize(ekf, anchors, parameters, t, records):
        if ekf.running and not len(records):
            horizon.step(ekf, anchors, parameters, t)
        return
    before = ekf.position_unknown_until
    _prepare(ekf, anchors, parameters, t, records)
    if parameters.recover and initialization.hold_for_search(
        ekf, anchors, parameters, t, ekf.position_unknown_until > before, records
    ):
        ekf.last_tdoa, ekf.horizon.state = t, OFF
        return
    late = _update(ekf, anchors, parameters, tdoa, residual, records)
    initialization.relocate(ekf, anchors, parameters, t, records)
    if not len(records):  # the smoother needs a recursive filter
        horizon.step(ekf, anchors, parameters, t)
    _select(ekf, parameters, t, records)
    if not late:
        _note_agreement(ekf, t, abs(residual.innovation) < INLIER)
    _recover(ekf, anchors, parameters, t, records)
    if anchors[tdoa.a].delay != 0.0 or anchors[tdoa.b].delay != 0.0:
        residual.innovation += delay
        if residual.verdict == USED:
            residual.verdict = COMPENSATED


@compiled
def _subtract_delays(tdoa: Record, anchors: np.ndarray) -> float:
    """Subtract the delays of its anchors from a TDOA, and return their difference, in m."""
    delay = anchors[tdoa.b].delay - anchors[tdoa.a].delay
    tdoa.d -= delay
    return delay


@compiled
def _on_range(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    sensor: Record,
    residual: Record,
    records: np.ndarray,
) -> None:
    """Process the distance to an anchor.

    The TDOA with the distance before serves initialization and recovery.
    """
    if ranges.is_repeat(ekf, sensor):
        residual.verdict = REPEATED
        return
    if ranges.pair(ekf, sensor):
        _subtract_delays(ekf.paired[0], anchors)
        initialization.remember(ekf, ekf.paired[0])
    t = sensor.t
    if not _predict_or_initialize(ekf, anchors, parameters, t, records):
        return
    _prepare(ekf, anchors, parameters, t, records)
    anchor, innovation = anchors[sensor.anchor], ekf.innovation
    # a range shares the error of one anchor with others, a TDOA those of two
    inflation = 0.5 * (1.0 + noise.variance_inflation(ekf, parameters))
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        if not hypotheses.alive(hypothesis):
            continue
        ranges.compare(hypothesis, anchor.position, sensor, parameters, innovation)
        innovation.variance_inflation, innovation.curvature = inflation, 0.0
        _update_hypothesis(ekf, h, parameters, t, residual, records, False)
        if h == ekf.best:
            ranges.keep_offset(ekf, hypothesis)
            noise.observe(ekf.information, anchor, anchor, innovation, t, ekf.last_tdoa)
    _select(ekf, parameters, t, records)
    _note_agreement(ekf, t, abs(residual.innovation) < INLIER)
    _recover(ekf, anchors, parameters, t, records)


@compiled
def _prepare(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, records: np.ndarray
) -> None:
    """Prepare an update stamped t (s): detect rest, heard anchors, and an unknown position.

    The position is unknown after a silence that has made it uncertain.
    """
    if parameters.zero_velocity:
        if t >= ekf.next_look:
            stationarity.check_stationarity(ekf, anchors, parameters, t, records)
        if not parameters.use_imu or t - ekf.imu.t > parameters.imu_timeout:
            stationarity.update_zero_velocity(ekf, t, records)
    if t >= ekf.velocity.next_look:
        window = initialization.recent(ekf, velocity.SECONDS)
        angle = velocity.compare_path(ekf, anchors, window, parameters.tdoa_std, t)
        if angle != 0.0:
            initialization.turn_yaw(ekf, angle, records)
    ekf.tdoa_rate += 1.0 - min(1.0, t - ekf.last_tdoa) * ekf.tdoa_rate
    if t >= ekf.next_workspace:
        initialization.update_workspace(ekf, anchors, parameters, t)
    if t - ekf.last_tdoa > parameters.start_window and initialization.is_unsure(ekf):
        ekf.position_unknown_until = t + UNSURE_TIME


@compiled
def _select(ekf: Record, parameters: Record, t: float, records: np.ndarray) -> None:
    """Apply the constraints of the workspace, then select the best hypothesis at stamp t (s)."""
    _stay_in_workspace(ekf, t, records)
    followed = ekf.best
    alone = hypotheses.select(ekf, t) and parameters.use_imu and not (ekf.quiet or ekf.resting)
    # If the best hypothesis is at another place, the history needs a reset. If only the yaw
    # differs, it needs a reset after the attitude was reset in flight. The yaws of a start share the
    # history before the choice, so they need none.
    opened = ekf.attitude_reset or not parameters.use_imu
    if ekf.best // N_YAWS != followed // N_YAWS or (ekf.best != followed and opened):
        history.add_reset(ekf, t, records)
    if alone and yaw_check.contradicts(ekf, t):
        initialization.open_yaw(ekf, parameters, records)
        alone = False
    if ekf.distrusted:
        initialization.distrust(ekf, parameters, records)
        alone = False
    if not alone:
        yaw_check.clear(ekf.yaw_test)
    ekf.yaw_test.alone = alone


@compiled
def _note_agreement(ekf: Record, t: float, agrees: bool) -> None:
    """Average the share of measurements that agree with the best hypothesis; t is a stamp (s)."""
    share = min(1.0, (t - ekf.last_tdoa) / RECOVERY_WINDOW)
    ekf.consistency += share * ((1.0 if agrees else 0.0) - ekf.consistency)


@compiled
def _recover(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, records: np.ndarray
) -> None:
    """Search for the tag elsewhere if recent TDOAs contradict the filter at stamp t (s)."""
    ekf.last_tdoa = t
    if ekf.consistency > initialization.AGREE:
        ekf.last_agreement = t
    unsure = t < ekf.position_unknown_until
    if parameters.recover and (unsure or ekf.consistency < INCONSISTENT) and t >= ekf.next_search:
        initialization.recover(ekf, anchors, parameters, t, unsure, records)


# Process a SENSOR_ROW: update a running filter, or store the measurement.
@compiled
def _on_sensor(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    sensor: Record,
    residual: Record,
    records: np.ndarray,
) -> None:
    _wait(residual)
    if sensor.kind == sensors.RANGE:
        _on_range(ekf, anchors, parameters, sensor, residual, records)
    elif ekf.running and _predict(ekf, parameters, sensor.t, records):
        if sensor.kind == sensors.VELOCITY:
            if initialization.yaw_stays_unknown(ekf, parameters):
                return
            if not (parameters.use_imu or ekf.velocity.refused):
                initialization.open_unknown_yaw(ekf, parameters, records)
        sensors.observe(ekf, parameters, sensor, residual, records)
    elif sensor.kind == sensors.HEIGHT:
        height.record(ekf, sensor)


@compiled
def _predict_or_initialize(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, records: np.ndarray
) -> bool:
    """Predict a running filter to the stamp t (s) of a TDOA or range, or wait for its start.

    Return whether the filter runs at t.
    """
    if not ekf.running:
        _initialize(ekf, anchors, parameters, t, records)
        return False
    return _predict(ekf, parameters, t, records)


@compiled
def _initialize(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, records: np.ndarray
) -> None:
    """Try to start the filter after a TDOA or range stamped t (s)."""
    if t - ekf.last_tdoa > parameters.start_window:
        ekf.first_tdoa = t
    ekf.last_tdoa = t
    waited = t - ekf.first_tdoa
    if t < ekf.next_search:
        return
    if waited > 0.9 * parameters.start_window:
        initialization.start(
            ekf, anchors, parameters, t, waited > parameters.start_timeout, records
        )
    if t >= ekf.next_search:
        initialization.start_slowly(ekf, anchors, parameters, t, records)


@compiled
def _predict(ekf: Record, parameters: Record, t: float, records: np.ndarray) -> bool:
    """Predict every hypothesis to stamp t (s).

    The prediction uses the last inertial sample. If it is too old, it uses the last velocity of
    wheels. Without both, it uses constant velocity. Return False if the filter has stopped, because
    its position has been unknown for too long.
    """
    if t - ekf.t > LOST_TIME:
        return _stop(ekf, t)
    sensed = (
        parameters.use_imu
        and t - ekf.imu.t < parameters.imu_timeout
        and not ekf.imu_faulty
        and t >= ekf.attitude_averaged_until
    )
    ekf.sensed = sensed
    if sensed and ekf.t < t:
        inertial.weigh(ekf.imu, ekf.quiet, parameters)
    while ekf.t < t:
        dt = min(t - ekf.t, MAX_STEP)
        for h in range(HYPOTHESES):
            hypothesis = ekf.hypotheses[h]
            if not hypotheses.alive(hypothesis):
                continue
            if sensed:
                vx, vy = hypothesis.x[3], hypothesis.x[4]
                predict(hypothesis, ekf.imu, parameters, dt, ekf.transition)
                if auxiliary.present(hypothesis):
                    auxiliary.predict(hypothesis, ekf.transition)
                if h == ekf.best:
                    history.add_prediction(ekf, records)
                    if ekf.yaw_test.alone:
                        yaw_check.predict(ekf, vx, vy)
            else:
                _coast(ekf, hypothesis, parameters, dt)
                if auxiliary.present(hypothesis):
                    auxiliary.coast(hypothesis, dt)
                if h == ekf.best:
                    history.add_coasting(ekf, dt, records)
                    yaw_check.clear(ekf.yaw_test)
        ekf.t = t if t - ekf.t <= MAX_STEP else ekf.t + dt
    if t >= ekf.next_floor and plane.is_given(parameters):
        plane.hold(ekf, parameters, t, records)
    if t - ekf.last_tdoa > LOST_TIME and workspace.is_filled(
        ekf.workspace, ekf.hypotheses[ekf.best].P
    ):
        return _stop(ekf, t)
    return True


@compiled
def _coast(ekf: Record, hypothesis: Record, parameters: Record, dt: float) -> None:
    """Predict a HYPOTHESIS over dt (s) without inertial samples.

    The velocity of wheels drives it, or the last velocity. If no IMU is used, no sensor measures a
    tilt. Then the tag counts as level.
    """
    wheels = ekf.velocity
    driven = velocity.agrees(wheels, ekf.t, velocity.HELD)
    alike = 2.0 * velocity.CORRELATION_TIME
    turn_psd = parameters.turn_noise**2
    yaw_psd = alike * wheels.yaw_rate_variance if driven else turn_psd
    if not parameters.use_imu and hypothesis.P[8, 8] > initialization.ANY_YAW**2:
        yaw_psd = 0.0
    tilt_psd = turn_psd if parameters.use_imu else 0.0
    coast(hypothesis, dt, ekf.motion_ratio * parameters.motion_noise**2, tilt_psd, yaw_psd)
    if driven:
        turn_about_vertical(hypothesis.x, wheels.yaw_rate * dt)
        for k in range(2):
            hypothesis.P[k, k] += dt * alike * wheels.speed_variance


@compiled
def _stop(ekf: Record, t: float) -> bool:
    """Stop the filter at stamp t (s), until the next start; return False."""
    ekf.running, ekf.first_tdoa, ekf.next_search = False, t, -np.inf
    return False


@compiled
def _update(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    tdoa: Record,
    residual: Record,
    records: np.ndarray,
) -> bool:
    """Update every hypothesis with a TDOA; the innovation of the best one becomes the residual.

    Return whether the TDOA was rejected because an anchor is late near the ground. Then the TDOA
    does not show if the filter is consistent.
    """
    a, b, innovation = anchors[tdoa.a], anchors[tdoa.b], ekf.innovation
    innovation.noise_variance = (
        parameters.tdoa_std**2 + tdoa.variance + a.delay_variance + b.delay_variance
    )
    known = 0.0
    on_floor = ekf.resting and ekf.late_as_known
    if on_floor and not math.isnan(a.floor_delay):
        known -= a.floor_delay
        innovation.noise_variance += a.floor_std**2
    if on_floor and not math.isnan(b.floor_delay):
        known += b.floor_delay
        innovation.noise_variance += b.floor_std**2
    if parameters.adapt_noise:
        innovation.noise_variance += a.excess_variance + b.excess_variance
    innovation.noise_variance += ground.blur(ekf.hypotheses[ekf.best], parameters.ground_height)
    if not on_floor and ground.find_lateness(
        a, b, ekf.hypotheses[ekf.best], tdoa.t, parameters.ground_height
    ):
        _compare(ekf.hypotheses[ekf.best], a, b, tdoa, known, innovation)
        innovation.prior_variance += innovation.curvature
        in_time = ground.in_time(a, b, innovation)
        if in_time < ground.NOT_USED:
            fill_residual(residual, innovation, 0.0)
            return True
        innovation.noise_variance /= in_time
    if tdoa.t < ekf.rival_until:
        # Wheels outweigh TDOAs that agree on another place for a while. Even with small robust
        # weights, many such TDOAs would pull the position.
        _compare(ekf.hypotheses[ekf.best], a, b, tdoa, known, innovation)
        if abs(innovation.value) > INLIER:
            fill_residual(residual, innovation, 0.0)
            return False
    inflation = noise.variance_inflation(ekf, parameters)
    linear = ekf.sensed and ekf.tdoa_rate >= LINEAR_RATE
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        if not hypotheses.alive(hypothesis):
            continue
        _compare(hypothesis, a, b, tdoa, known, innovation)
        if innovation.curvature > 0.0 and not linear:
            _iterate(hypothesis, a, b, tdoa, known, inflation, innovation)
        innovation.variance_inflation = inflation
        _update_hypothesis(ekf, h, parameters, tdoa.t, residual, records, True)
        if h == ekf.best:
            noise.observe(ekf.information, a, b, innovation, tdoa.t, ekf.last_tdoa)
            height.update_pull(ekf.height, parameters, innovation, tdoa.t)
            if parameters.adapt_noise:
                noise.learn(a, b, tdoa.t, innovation, parameters)
            if parameters.adapt_noise and ekf.heard > noise.FREE:
                last = b.innovation - a.innovation
                b.innovation = noise.learn_persistence(ekf, last, tdoa.t, innovation)
                a.innovation = -b.innovation
    return False


@compiled
def _wait(residual: Record) -> None:
    """Fill in the RESIDUAL of a measurement that waits for the start of the filter."""
    residual.innovation = residual.variance = np.nan
    residual.weight, residual.verdict = 0.0, STARTUP


@compiled
def _compare(
    hypothesis: Record, a: Record, b: Record, tdoa: Record, known: float, innovation: Record
) -> None:
    """Fill in the innovation of a TDOA for a HYPOTHESIS.

    The Jacobian contains the position, and the slope of the bias. The slope counts only within
    LINEAR_RANGE of the state at which the bias was computed.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Hypothesis, predicted to the stamp.
    a, b : ANCHOR
        Anchors of the TDOA.
    tdoa : TDOA
        Measurement, m.
    known : float
        Known error of the TDOA by late anchors near the ground, m.
    innovation : INNOVATION
        Filled by this function.
    """
    predicted = linearized_tdoa(hypothesis.x, a.position, b.position, innovation.row)
    innovation.curvature = update.second_order_variance(
        hypothesis.x, hypothesis.P, a.position, b.position
    )
    innovation.value, innovation.entries = tdoa.d - known - predicted, 3
    for k in range(N_STATES):
        innovation.states[k] = k
        if k >= 3:
            innovation.row[k] = 0.0
        apart = hypothesis.x[k] - tdoa.state[k]
        if tdoa.slope[k] != 0.0 and abs(apart) < LINEAR_RANGE:
            innovation.value -= tdoa.slope[k] * apart
            innovation.row[k] += tdoa.slope[k]
            innovation.entries = max(innovation.entries, k + 1)
    project(hypothesis.P, innovation)


@compiled
def _iterate(
    hypothesis: Record,
    a: Record,
    b: Record,
    tdoa: Record,
    known: float,
    inflation: float,
    innovation: Record,
) -> None:
    """Linearize the INNOVATION of a TDOA anew, at the position that an update with it gives.

    The second-order variance is added to the prior variance.

    This is the iterated Kalman filter (Bar-Shalom et al., section 10.5.2). It matters if the position
    is uncertain, because a TDOA is then far from linear. The parameters are those of `_compare`, and
    the inflation of the noise. The slope of a bias stays out, because the position is uncertain.
    """
    x, P, row, at = hypothesis.x, hypothesis.P, innovation.row, hypothesis.x[:3].copy()
    curvature, value = innovation.curvature, innovation.value
    for _ in range(ITERATIONS):
        project(P, innovation)
        total = innovation.prior_variance + curvature + innovation.noise_variance * inflation
        for i in range(3):
            at[i] = x[i] + innovation.cross_covariance[i] * value / total
        value = tdoa.d - known - linearized_tdoa(at, a.position, b.position, row)
        for i in range(3):
            value += row[i] * (at[i] - x[i])
    innovation.entries, innovation.value = 3, value
    project(P, innovation)
    innovation.prior_variance += curvature


@compiled
def _update_hypothesis(
    ekf: Record,
    h: int,
    parameters: Record,
    t: float,
    residual: Record,
    records: np.ndarray,
    of_tdoa: bool,
) -> None:
    """Update hypothesis h with ekf.innovation of any kind.

    The innovation of the best hypothesis becomes the RESIDUAL. of_tdoa is whether the innovation is
    evidence for the yaw. Ranges are not: their common offset looks the same as a wrong yaw.
    """
    hypothesis, innovation = ekf.hypotheses[h], ekf.innovation
    correlation_length = max(innovation.variance_inflation, LEAST_LENGTH)
    hypotheses.add_log_likelihood(hypothesis, innovation, correlation_length)
    update.weigh(hypothesis, innovation, parameters)
    if innovation.weight > 0.0:
        update.kalman(hypothesis, innovation)
    if h == ekf.best:
        if ekf.yaw_test.alone:
            yaw_check.observe(ekf, correlation_length, of_tdoa)
        fill_residual(residual, innovation, innovation.weight)
        if innovation.weight > 0.0:
            history.add_update(ekf, h, t, records)
            if of_tdoa and parameters.adapt_noise and not ekf.sensed:
                noise.learn_motion(ekf, parameters, t, innovation)


@compiled
def _stay_in_workspace(ekf: Record, t: float, records: np.ndarray) -> None:
    """Apply the soft constraints of the workspace to each hypothesis outside, for every axis."""
    for h in range(HYPOTHESES):
        if not hypotheses.alive(ekf.hypotheses[h]):
            continue
        if workspace.stay_on_side(ekf.hypotheses[h], ekf.side) and h == ekf.best:
            history.add_reset(ekf, t, records)
        for axis in range(3):
            outside = workspace.constrain(ekf.hypotheses[h], ekf.innovation, ekf.workspace, axis)
            if outside:
                history.add_update(ekf, h, t, records)


@compiled
def _report(ekf: Record, parameters: Record, t: float, row: Record) -> None:
    """Write the best hypothesis to an ODOMETRY row at stamp t (s)."""
    best = ekf.hypotheses[ekf.best]
    row.t = t
    row.x[:] = best.x
    row.covariance[:] = best.P[:9, :9]
    hypotheses.add_spread_of_means(ekf, row.covariance)
    if t - ekf.recovered < RECOVERY_NAMED and ekf.sensed:
        if not (hypotheses.alike(ekf) and yaw_check.known(best.x, best.P)):
            ekf.recovered = t
    workspace.add_circle(
        ekf,
        parameters.fixed_height_std > 0.0 or t - ekf.height.used < height.MEMORY,
        best.x,
        row.covariance,
    )
    wrong = height.contradiction(ekf.height, parameters, t)
    row.covariance[2, 2] += wrong**2
    noise.fill(
        ekf.information,
        best.P,
        noise.persisting_share(ekf, parameters),
        parameters.fixed_height_std,
        ekf.workspace,
        row.consider_covariance,
    )
    row.covariance[:3, :3] += row.consider_covariance
    squared = 0.0  # m^2, squared distance to where else the tag may be
    if t < ekf.rival_until:
        squared += np.sum((ekf.rival - best.x[:3]) ** 2)
    if ekf.consistency < INCONSISTENT:
        squared += initialization.reach(ekf, t) ** 2
    for k in range(3):  # no temporary arrays: this runs for each odometry
        row.covariance[k, k] += squared
    _report_rate(ekf, parameters, t, row)
    if parameters.planar:
        plane.flatten(row, parameters, wrong)


@compiled
def _report_rate(ekf: Record, parameters: Record, t: float, row: Record) -> None:
    """Write the angular rate at stamp t (s) to an ODOMETRY row.

    It is the rate of the last inertial sample minus the bias of the gyroscope. White noise of the
    density gyro_noise has the variance gyro_noise^2 / period in each sample. Without a recent
    sample, wheels give the rate about z.
    """
    row.rate[:], row.rate_variance[:] = np.nan, np.nan
    if t - ekf.imu.t <= parameters.imu_timeout:
        row.rate[:] = ekf.imu.gyro - row.x[13:]
        row.rate_variance[:] = parameters.gyro_noise**2 / ekf.imu.period
    elif t - ekf.velocity.agreed <= velocity.HELD:
        row.rate[2], row.rate_variance[2] = ekf.velocity.yaw_rate, ekf.velocity.yaw_rate_variance


def feed(
    state: FilterState,
    parameters: np.ndarray,
    measurements: Measurements,
    records: list[np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run the filter over measurements and return new arrays of odometry and residuals.

    Parameters
    ----------
    state : FilterState
        Updated in place.
    parameters : (1,) PARAMETERS
        Tuning of the filter.
    measurements : Measurements
        Measurements in stamp order, see `run`.
    records : list, optional
        A new array of history records is appended for each call. None: no recording.

    Returns
    -------
    tuple
        Odometry (ODOMETRY), residuals of TDOAs and residuals of other measurements (RESIDUAL).
    """
    imu, tdoa, sensor = measurements
    room = (
        history.NOTHING if records is None else np.empty(most_records(measurements), history.RECORD)
    )
    n = len(imu) + len(tdoa) + len(sensor)
    output = Output(
        np.empty(n, ODOMETRY), np.empty(len(tdoa), RESIDUAL), room, np.empty(len(sensor), RESIDUAL)
    )
    rows = run(state, parameters, measurements, output)
    if records is not None:
        records.append(room[: state.record.recorded].copy())
        state.record.recorded = 0
    return output.odometry[:rows], output.residuals, output.sensors
