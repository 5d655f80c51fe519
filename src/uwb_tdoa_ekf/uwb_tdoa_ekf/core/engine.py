"""The compiled filter: events in stamp order in, odometry and residuals out.

Everything it remembers is in FilterState.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.geometry import linearized_tdoa
from uwb_tdoa_bias.effects.samples import N_STATES

from . import (
    aids,
    auxiliary,
    ground,
    height,
    history,
    hypotheses,
    imu_fault_detector,
    inertial,
    initialization,
    noise,
    plane,
    ranges,
    robust,
    stationarity,
    update,
    velocity,
    workspace,
    yaw_test,
)
from .memory import (
    COMPENSATED,
    HYPOTHESES,
    N_YAWS,
    ODOMETRY,
    REJECTED,
    REPEATED,
    RESIDUAL,
    STARTUP,
    USED,
    FilterState,
    Measurements,
    Output,
)
from .sensor_functions import subtract
from .startup import INLIER
from .state import coast, predict, turn_about_vertical
from .update import project

CONSISTENCY_TIME = 0.3  # s over which the share of TDOAs that the filter explains is averaged
INCONSISTENT = 0.5  # share below which the tag is looked for elsewhere
# s of TDOAs, after a silence in which a tag got lost, in which it is looked for anew
UNSURE_TIME = 0.5
# s without a TDOA after which a tag that may be anywhere in its workspace is lost: the filter
# starts anew
LOST_TIME = 30.0
MAX_STEP = 0.05  # s, longest single prediction
# s of inertial samples that tell how a sensor is mounted which comes when the filter runs
AVERAGED = 0.25
# m or m/s of the state, within which the slope of a bias tells what it is elsewhere
LINEAR_RANGE = 1.0

# In a history, at most: its update, workspace, a place at rest, another hypothesis, starts or
# recoveries, a yaw opened again
RECORDS_OF_TDOA = 1 + 4 + 6 + 1 + 2 + 2
RECORDS_OF_REST = 3  # one per axis
# a range has as many, a velocity one per component, and a yaw opened again
RECORDS_OF_AID = RECORDS_OF_TDOA


@compiled
def run(
    state: FilterState, parameters: np.ndarray, measurements: Measurements, output: Output
) -> int:
    """Feed Measurements in stamp order, neither before what was fed earlier.

    state : FilterState, whose functions are taken out of the inertial samples where they lie;
        parameters : (1,) of config.PARAMETERS;
    output : Output, which is filled. Returns the number of odometry
    rows. Raises IndexError if a history has less room than `most_records`.
    """
    ekf, anchors, values = state.ekf[0], state.anchors, parameters[0]
    imu, tdoa, aid = measurements.imu, measurements.tdoa, measurements.aids
    i = k = m = rows = 0
    while i < len(imu) or k < len(tdoa) or m < len(aid):
        of_imu = imu[i].t if i < len(imu) else np.inf
        of_tdoa = tdoa[k].t if k < len(tdoa) else np.inf
        of_aid = aid[m].t if m < len(aid) else np.inf
        t = min(of_imu, of_tdoa, of_aid)
        if of_imu == t and i < len(imu):
            if len(state.functions) and ekf.running:
                subtract(state.functions, ekf.hypotheses[ekf.best].x, imu[i])
            _on_imu(ekf, values, imu[i], output.history)
            i += 1
        elif of_tdoa == t and k < len(tdoa):
            _on_tdoa(ekf, anchors, values, tdoa[k], output.residuals[k], output.history)
            k += 1
        else:
            _on_aid(ekf, anchors, values, aid[m], output.aids[m], output.history)
            m += 1
        if ekf.running and t >= ekf.next_odometry:
            ekf.next_odometry = (
                math.floor(t * values.odometry_rate + 1e-6) + 1.0
            ) / values.odometry_rate
            _report(ekf, values, t, output.odometry[rows])
            rows += 1
    return rows


@compiled
def _set_pose(
    state: FilterState, parameters: np.ndarray, poses: np.ndarray, records: np.ndarray
) -> None:
    ekf, pose = state.ekf[0], poses[0]
    if ekf.running:
        _advance(ekf, parameters[0], pose.t, records)
    initialization.place(ekf, state.anchors, parameters[0], pose.t, pose, records)


def set_pose(state: FilterState, parameters: np.ndarray, pose: np.ndarray) -> None:
    """Put the filter at a pose, (1,) of POSE, that is not before what was fed earlier.

    Is not recorded in a history.
    """
    _set_pose(state, parameters, pose, history.NOTHING)


def most_records(measurements: Measurements) -> int:
    """Room that a history needs for Measurements that are fed at once."""
    imu, tdoa, aid = measurements
    spans = [part["t"][-1] - part["t"][0] for part in measurements if len(part)]
    most, seconds = len(imu) + len(tdoa) + len(aid), max(spans, default=0.0)
    periods = stationarity.PERIOD, plane.PERIOD, 0.5 * imu_fault_detector.CLEARED
    rests, floors, switches = (min(most, 2 + int(seconds / period)) for period in periods)
    of_events = RECORDS_OF_TDOA * len(tdoa) + RECORDS_OF_AID * len(aid)
    return of_events + RECORDS_OF_REST * rests + plane.RECORDS * floors + switches


@compiled
def _on_imu(ekf: Record, parameters: Record, sample: Record, records: np.ndarray) -> None:
    continuous = inertial.observe(ekf.imu, sample, parameters.imu_timeout)
    imu_faulty = imu_fault_detector.update(
        ekf.imu_fault_detector, ekf.imu, sample, continuous, ekf.imu_faulty
    )
    if imu_faulty != ekf.imu_faulty:
        ekf.imu_faulty = imu_faulty
        _switch(ekf, parameters, records)
    first, averaged = (
        ekf.imu.t == -np.inf,
        ekf.attitude_averaged_until > -np.inf and sample.t >= ekf.attitude_averaged_until,
    )
    if first and ekf.running and parameters.use_imu:
        ekf.attitude_averaged_until = sample.t + AVERAGED
    elif averaged or not ekf.running:
        ekf.attitude_averaged_until = -np.inf
    if ekf.running and _advance(ekf, parameters, sample.t, records):
        if averaged and not ekf.imu_faulty:
            initialization.level_first(ekf, parameters, records)
        if continuous and not ekf.imu_faulty:
            stationarity.detect_liftoff(ekf, sample, sample.t - ekf.imu.t, records)
        ekf.quiet = (
            parameters.zero_velocity
            and continuous
            and not ekf.imu_faulty
            and inertial.is_quiet(ekf.imu)
        )
        stationarity.update_zero_velocity(ekf, sample.t, records)
    inertial.store(ekf.imu, sample)


@compiled
def _switch(ekf: Record, parameters: Record, records: np.ndarray) -> None:
    """Go without inertial samples from here on, or with them again: from the attitude that they
    then have.
    """
    if ekf.running and ekf.imu_faulty:
        initialization.widen(ekf, records)
    elif ekf.running:
        initialization.reset_attitude(ekf, parameters, 2.0 * math.pi, records)


@compiled
def _on_tdoa(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    tdoa: Record,
    residual: Record,
    records: np.ndarray,
) -> None:
    residual.innovation = residual.variance = np.nan
    residual.weight, residual.verdict = 0.0, STARTUP
    if initialization.is_repeat(ekf, tdoa, anchors):
        residual.verdict = REPEATED
        return
    initialization.remember(ekf, tdoa, anchors)
    t = tdoa.t
    if not _reach(ekf, anchors, parameters, t, records):
        return
    before = ekf.position_unknown_until
    _before_update(ekf, anchors, parameters, t, records)
    if parameters.recover and initialization.waits(
        ekf, anchors, parameters, t, ekf.position_unknown_until > before, records
    ):
        ekf.last_tdoa = t
        return
    late = _update(ekf, anchors, parameters, tdoa, residual, records)
    initialization.relocate(ekf, anchors, parameters, t, records)
    known = anchors[tdoa.b].delay - anchors[tdoa.a].delay
    _after_update(
        ekf, anchors, parameters, t, not late, abs(residual.innovation - known) < INLIER, records
    )


@compiled
def _on_range(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    aid: Record,
    residual: Record,
    records: np.ndarray,
) -> None:
    """The distance to an anchor, one of AID; as a TDOA with the one before it tells the start."""
    if ranges.is_repeat(ekf, aid):
        residual.verdict = REPEATED
        return
    if ranges.pair(ekf, aid):
        initialization.remember(ekf, ekf.paired[0], anchors)
    t = aid.t
    if not _reach(ekf, anchors, parameters, t, records):
        return
    _before_update(ekf, anchors, parameters, t, records)
    anchor, innovation = anchors[aid.anchor], ekf.innovation
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        if not hypotheses.alive(hypothesis):
            continue
        ranges.compare(hypothesis, anchor.position, aid, parameters, innovation)
        innovation.variance_inflation, innovation.curvature = stationarity.repetition(ekf, t), 0.0
        _assimilate(ekf, h, parameters, t, residual, records, False)
        if h == ekf.best:
            ranges.keep_offset(ekf, hypothesis)
            noise.observe(ekf.information, anchor, anchor, innovation, t, ekf.last_tdoa)
    _after_update(ekf, anchors, parameters, t, True, abs(residual.innovation) < INLIER, records)


@compiled
def _before_update(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, records: np.ndarray
) -> None:
    """Before an update stamped t, s: whether the tag is at rest, which anchors are heard, and
    whether a silence left the place open.
    """
    if parameters.zero_velocity:
        if t >= ekf.next_look:
            stationarity.check_stationarity(
                ekf,
                anchors,
                parameters,
                initialization.recent(ekf, stationarity.LOOK_WINDOW),
                t,
                records,
            )
        if not parameters.use_imu or t - ekf.imu.t > parameters.imu_timeout:
            stationarity.update_zero_velocity(ekf, t, records)
    if t >= ekf.next_bounds:
        initialization.look_around(ekf, anchors, parameters, t)
    if t - ekf.last_tdoa > parameters.start_window and initialization.is_unsure(ekf):
        ekf.position_unknown_until = t + UNSURE_TIME


@compiled
def _after_update(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    t: float,
    counts: bool,
    agrees: bool,
    records: np.ndarray,
) -> None:
    """After an update stamped t, s: what holds anyway, which hypothesis is best, and whether the
    tag is elsewhere. counts : what was measured shows that; agrees : with the best hypothesis.
    """
    _stay_in_workspace(ekf, t, records)
    followed = ekf.best
    alone = hypotheses.select(ekf, t) and parameters.use_imu and not (ekf.quiet or ekf.resting)
    # At another place. Or with another yaw, after one was opened again: the yaws of a start share
    # the history before the choice.
    opened = ekf.yaw_test.count > 0 or not parameters.use_imu
    if ekf.best // N_YAWS != followed // N_YAWS or (ekf.best != followed and opened):
        history.add_reset(ekf, t, records)
    if alone and yaw_test.contradicts(ekf, t):
        initialization.open_yaw(ekf, parameters, records)
        alone = False
    if not alone:
        yaw_test.clear(ekf.yaw_test)
    ekf.yaw_test.alone = alone
    if counts:
        ekf.consistency += min(1.0, (t - ekf.last_tdoa) / CONSISTENCY_TIME) * (
            (1.0 if agrees else 0.0) - ekf.consistency
        )
    ekf.last_tdoa = t
    if ekf.consistency > initialization.AGREE:
        ekf.last_agreement = t
    unsure = t < ekf.position_unknown_until
    if parameters.recover and (unsure or ekf.consistency < INCONSISTENT) and t >= ekf.next_search:
        initialization.recover(ekf, anchors, parameters, t, unsure, records)


@compiled
def _on_aid(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    aid: Record,
    residual: Record,
    records: np.ndarray,
) -> None:
    residual.innovation = residual.variance = np.nan
    residual.weight, residual.verdict = 0.0, STARTUP
    if aid.kind == aids.RANGE:
        _on_range(ekf, anchors, parameters, aid, residual, records)
    elif ekf.running and _advance(ekf, parameters, aid.t, records):
        if aid.kind == aids.VELOCITY and not parameters.use_imu:
            initialization.open_unknown_yaw(ekf, parameters, records)
        aids.observe(ekf, parameters, aid, residual, records)
    else:
        aids.record(ekf, aid)


@compiled
def _reach(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, records: np.ndarray
) -> bool:
    """A TDOA or range stamped t, s, has come: predict a filter that runs, or wait for its start.

    Returns whether it runs at t.
    """
    if not ekf.running:
        _wait_for_start(ekf, anchors, parameters, t, records)
        return False
    return _advance(ekf, parameters, t, records)


@compiled
def _wait_for_start(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, records: np.ndarray
) -> None:
    """A TDOA stamped t has come while the filter does not run."""
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
def _advance(ekf: Record, parameters: Record, t: float, records: np.ndarray) -> bool:
    """Predict every hypothesis to stamp t, with the inertial sample at hand or, if it is too old,
    with the last velocity of wheels, or without either. Returns False if the filter has stopped,
    because nothing has shown for too long where the tag is.
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
                        yaw_test.predict(ekf, vx, vy)
            else:
                _coast(ekf, hypothesis, parameters, dt)
                if auxiliary.present(hypothesis):
                    auxiliary.coast(hypothesis, dt)
                if h == ekf.best:
                    history.add_coasting(ekf, dt, records)
                    yaw_test.clear(ekf.yaw_test)
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
    """Advance a HYPOTHESIS by dt seconds without inertial samples: as wheels tell, or as it was.
    Nothing measures a tilt where no IMU is used; then the tag is taken to be level.
    """
    wheels = ekf.velocity
    driven = velocity.drives(wheels, ekf.t)
    alike = 2.0 * velocity.CORRELATION_TIME
    turn_psd = parameters.turn_noise**2
    yaw_psd = alike * wheels.yaw_rate_variance if driven else turn_psd
    if not parameters.use_imu and hypothesis.P[8, 8] > initialization.ANY_YAW**2:
        yaw_psd = 0.0
    coast(
        hypothesis,
        dt,
        parameters.motion_noise**2,
        turn_psd if parameters.use_imu else 0.0,
        yaw_psd,
    )
    if driven:
        turn_about_vertical(hypothesis.x, wheels.yaw_rate * dt)
        for k in range(2):
            hypothesis.P[k, k] += dt * alike * wheels.speed_variance


@compiled
def _stop(ekf: Record, t: float) -> bool:
    """Go on as before the start. Returns False."""
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
    """Every hypothesis with one TDOA; the best one's innovation becomes the residual. Returns
    whether one of its anchors is late because it is near the ground: then it tells nothing.
    """
    a, b, innovation = anchors[tdoa.a], anchors[tdoa.b], ekf.innovation
    innovation.noise_variance = (
        parameters.tdoa_std**2 + tdoa.variance + a.delay_variance + b.delay_variance
    )
    change = known = b.delay - a.delay
    on_floor = ekf.resting and ekf.late_as_known
    if on_floor and not math.isnan(a.floor_delay):
        known -= a.floor_delay
        innovation.noise_variance += a.floor_std**2
    if on_floor and not math.isnan(b.floor_delay):
        known += b.floor_delay
        innovation.noise_variance += b.floor_std**2
    if parameters.adapt_noise:
        innovation.noise_variance += noise.excess_variance(a, b)
    innovation.noise_variance += ground.blur(ekf.hypotheses[ekf.best], parameters.ground_height)
    if not on_floor and ground.find_lateness(
        a, b, ekf.hypotheses[ekf.best], tdoa.t, parameters.ground_height
    ):
        _compare(ekf.hypotheses[ekf.best], a, b, tdoa, known, innovation)
        in_time = ground.in_time(a, b, innovation)
        if in_time < ground.NOT_USED:
            residual.innovation = innovation.value + change
            residual.variance = innovation.prior_variance + innovation.noise_variance
            residual.verdict = REJECTED
            return True
        innovation.noise_variance /= in_time
    if tdoa.t < ekf.rival_until and _is_of_rival(ekf, a, b, tdoa, known, residual):
        residual.innovation += change
        return False
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        if not hypotheses.alive(hypothesis):
            continue
        _compare(hypothesis, a, b, tdoa, known, innovation)
        innovation.variance_inflation = stationarity.repetition(ekf, tdoa.t)
        _assimilate(ekf, h, parameters, tdoa.t, residual, records, True)
        if h == ekf.best:
            noise.observe(ekf.information, a, b, innovation, tdoa.t, ekf.last_tdoa)
            height.update_pull(ekf.height, parameters, innovation, tdoa.t)
            if parameters.adapt_noise:
                noise.learn(a, b, tdoa.t, innovation, parameters)
    if a.delay != 0.0 or b.delay != 0.0:
        residual.innovation += change
        if residual.verdict == USED:
            residual.verdict = COMPENSATED
    return False


@compiled
def _is_of_rival(
    ekf: Record, a: Record, b: Record, tdoa: Record, known: float, residual: Record
) -> bool:
    """Whether a TDOA contradicts the place that wheels have gone to, while they outweigh those that
    agree on another one; fills one of RESIDUAL. A robust weight would leave it some, and many pull.
    """
    innovation = ekf.innovation
    noise_variance = innovation.noise_variance
    _compare(ekf.hypotheses[ekf.best], a, b, tdoa, known, innovation)
    residual.innovation, residual.variance = (
        innovation.value,
        innovation.prior_variance + noise_variance,
    )
    residual.weight, residual.verdict = 0.0, REJECTED
    return abs(innovation.value) > INLIER


@compiled
def _compare(
    hypothesis: Record, a: Record, b: Record, tdoa: Record, known: float, innovation: Record
) -> None:
    """Fill in what a TDOA between two of ANCHOR, `known` (m) too long, says to a HYPOTHESIS; its
    Jacobian is that of the position, and of what its bias changes with, where the state is about as
    it was when the bias was given.
    """
    innovation.value = (
        tdoa.d - known - linearized_tdoa(hypothesis.x, a.position, b.position, innovation.row)
    )
    innovation.entries = 3
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
    innovation.curvature = update.variance(hypothesis.x, hypothesis.P, a.position, b.position)
    innovation.prior_variance += innovation.curvature


@compiled
def _assimilate(
    ekf: Record,
    h: int,
    parameters: Record,
    t: float,
    residual: Record,
    records: np.ndarray,
    of_tdoa: bool,
) -> None:
    """Hypothesis h with ekf.innovation, of whatever kind; that of the best one becomes the
    RESIDUAL. of_tdoa : it shows whether the yaw is right; ranges may be off by an offset, which
    looks alike.
    """
    hypothesis, innovation = ekf.hypotheses[h], ekf.innovation
    hypotheses.add_log_likelihood(
        hypothesis, innovation, parameters.tdoa_correlation_length * innovation.variance_inflation
    )
    robust.update(hypothesis, innovation, parameters)
    if h == ekf.best:
        residual.innovation = innovation.value
        residual.variance = innovation.prior_variance + innovation.noise_variance
        residual.weight = innovation.weight
        residual.verdict = USED if innovation.weight > 0.0 else REJECTED
        if ekf.yaw_test.alone:
            yaw_test.observe(
                ekf, parameters.tdoa_correlation_length * innovation.variance_inflation, of_tdoa
            )
        if residual.verdict == USED:
            history.add_update(ekf, t, records)


@compiled
def _stay_in_workspace(ekf: Record, t: float, records: np.ndarray) -> None:
    """Soft constraints of every axis, for each hypothesis that is outside."""
    for h in range(HYPOTHESES):
        if not hypotheses.alive(ekf.hypotheses[h]):
            continue
        if workspace.stay_on_side(ekf.hypotheses[h], ekf.side) and h == ekf.best:
            history.add_reset(ekf, t, records)
        for axis in range(3):
            outside = workspace.constrain(ekf.hypotheses[h], ekf.innovation, ekf.workspace, axis)
            if outside and h == ekf.best:
                history.add_update(ekf, t, records)


@compiled
def _report(ekf: Record, parameters: Record, t: float, row: Record) -> None:
    """Write the best hypothesis to one of ODOMETRY."""
    best = ekf.hypotheses[ekf.best]
    row.t = t
    row.x[:] = best.x
    row.covariance[:] = best.P[:9, :9]
    hypotheses.add_spread_of_means(ekf, row.covariance)
    workspace.add_circle(
        ekf,
        parameters.fixed_height_std > 0.0 or t - ekf.height.used < height.LONGEST_GAP,
        best.x,
        row.covariance,
    )
    wrong = height.contradiction(ekf.height, parameters, t)
    row.covariance[2, 2] += wrong**2
    noise.fill(
        ekf.information,
        best.P,
        parameters.tdoa_correlation_length,
        parameters.fixed_height_std,
        row.consider_covariance,
    )
    row.covariance[:3, :3] += row.consider_covariance
    if t < ekf.rival_until:
        _widen(ekf, best.x, row.covariance)
    if parameters.planar:
        plane.flatten(row, parameters, wrong)


@compiled
def _widen(ekf: Record, x: np.ndarray, covariance: np.ndarray) -> None:
    """Add to the (9, 9) covariance of a position x (3,), m, how far away the place is that TDOAs
    agree on.
    """
    square = 0.0
    for k in range(3):
        square += (ekf.rival[k] - x[k]) ** 2
    for k in range(3):
        covariance[k, k] += square


def feed(
    state: FilterState,
    parameters: np.ndarray,
    measurements: Measurements,
    records: list[np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`run`, with room for what it gives: (odometry of ODOMETRY, residuals of TDOAs and those of
    aids, of RESIDUAL).

    records : list to which the records of the history are appended, an array for each call; None:
        nothing is recorded.
    """
    imu, tdoa, aid = measurements
    room = (
        history.NOTHING if records is None else np.empty(most_records(measurements), history.RECORD)
    )
    n = len(imu) + len(tdoa) + len(aid)
    output = Output(
        np.empty(n, ODOMETRY), np.empty(len(tdoa), RESIDUAL), room, np.empty(len(aid), RESIDUAL)
    )
    rows = run(state, parameters, measurements, output)
    if records is not None:
        records.append(room[: state.record.recorded].copy())
        state.record.recorded = 0
    return output.odometry[:rows], output.residuals, output.aids
