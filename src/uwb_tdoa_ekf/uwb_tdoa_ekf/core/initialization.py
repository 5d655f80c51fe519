# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Initialization of the filter, and recovery of a lost tag."""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import (
    ground,
    height,
    hypotheses,
    imu_fault_detector,
    inertial,
    noise,
    stationary_position,
    velocity,
    workspace,
    yaw_check,
)
from .ground import SPEED, KnownHeight
from .history import add_reset
from .memory import HYPOTHESES, N_PLACES, N_YAWS, OFF, STARTED, WINDOW
from .startup import APART, Places, anywhere, inliers, level, locate, room_for, split
from .state import CHECK_PERIOD, GRAVITY, turn_about_vertical, yaw_of
from .workspace import ANY_YAW

MINIMUM = 12  # least number of TDOAs for a search
AGREE, AGREE_RECOVERY = 0.7, 0.6  # share of TDOAs that a start, and a recovery, must explain
CLEARLY_MORE = 0.2  # share of TDOAs by which a recovery must exceed the filter
# s of TDOAs for a recovery, and over which the share of TDOAs that agree with the filter is averaged.
# It is short, because a tag that leaves the floor must not wait until TDOAs of the floor have left it.
RECOVERY_WINDOW = 0.3
# s: the window of a recovery if ENOUGH TDOAs are in it, because a drone that races changes its velocity
# by 10 m/s in RECOVERY_WINDOW; and the window if few TDOAs come
SHORT_WINDOW, ENOUGH, LONG_WINDOW = (0.12, 20, 0.7)
SLOW_TDOAS, SLOW_STAMPS = (20, 3)  # TDOAs and stamps of a start if few TDOAs come
# s; older TDOAs do not show where the tag is. After so long without one, a tag that may be anywhere
# in its workspace is lost: the filter stops, then starts again
LOST_TIME = 30.0
# m, standard deviation of an unknown position; share of its variance below which another position
# is better
UNKNOWN, BETTER = (2.0, 0.5)
# longest gap, as a share of the duration of all TDOAs above. A longer gap means that the tag has
# just been switched on.
LONGEST_GAP = 0.6
# s, and least number of TDOAs in it, that find the yaw of a tag with wheels and without an IMU: with 7 a
# second a rover has 0.13 m, with 5 0.30 m, and 0.19 m without its wheels
YAW_SECONDS, FEWEST_OF_YAW = (2.0, 12)
TILT_STD = 0.1  # rad, roll and pitch at the start
# rad, the same after a reset in flight: a drone that leans feels its thrust alone
RESET_TILT_STD = 0.5
# rad, standard deviation with which hypotheses of all yaws start, with nearly the same weight
YAW_SEARCH_STD = 2.0 * math.pi
WRONG_POSITION = 1.0  # m, standard deviation of the position error after faulty inertial samples
SMALLEST_STD = 0.03  # m, least standard deviation of a known height at the start
# m, m/s, m/s^2: a recovery is limited to this distance, as a function of the time since the filter
# agreed
REACH, REACH_SPEED, REACH_ACCELERATION = (0.5, 0.5, 0.5)
# s for which TDOAs must agree on a place that the IMU cannot have led to, and s between two openings of
# the yaw: then the IMU is wrong. In 22 measured flights TDOAs contradict for 0.5 s at most. A second
# recovery within AGAIN s shows that the attitude is wrong.
IMU_CONTRADICTED, TWICE, AGAIN = (2.0, 20.0, 1.0)
# s, instead of IMU_CONTRADICTED, if the velocity there differs by OTHER_MOTION, m/s: that of TDOAs that
# jump does not
RUNS_AWAY, OTHER_MOTION = (1.0, 3.0)
# number of late anchors that may explain TDOAs that contradict wheels: two late anchors are as
# probable as a rover that jumps
LATE_ANCHORS = 2
AMONG_OTHERS = 6, 3  # least number of other TDOAs and anchors that agree with wheels
# s for which TDOAs must agree on another place than wheels; s for which the tag then counts as
# possibly there
RIVAL_TIME, RIVAL_HELD = (1.0, 0.5)


@compiled
def remember(ekf: Record, tdoa: Record) -> None:
    """Append a TDOA to the window."""
    if ekf.kept == 2 * WINDOW:
        for i in range(WINDOW):
            ekf.window[i] = ekf.window[WINDOW + i]
        ekf.kept = WINDOW
    ekf.window[ekf.kept] = tdoa
    velocity.carry(ekf.velocity, tdoa.t, ekf.window[ekf.kept].pose)
    ekf.kept += 1


@compiled
def is_repeat(ekf: Record, tdoa: Record) -> bool:
    """Return whether the window already holds a TDOA with this stamp, anchors and value.

    Then a driver or network has sent it twice.
    """
    for k in range(ekf.kept - 1, -1, -1):
        other = ekf.window[k]
        if other.t != tdoa.t:
            return False
        if other.a == tdoa.a and other.b == tdoa.b and other.d == tdoa.d:
            return True
    return False


@compiled
def _search(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    t: float,
    window: np.ndarray,
    count: int,
) -> tuple[Places, float]:
    """Search for the tag in the surroundings of the anchors of a window (n,) of TDOA.

    Return `count` Places, and the share of TDOAs that agree with the first one.
    """
    places, known = room_for(count), _known_height(ekf, parameters, t)
    _find_surroundings(ekf, window, anchors, parameters)
    return places, locate(window, anchors, ekf.workspace, parameters, known, places)


@compiled
def _start_at(
    ekf: Record, parameters: Record, t: float, places: Places, resting: bool, history: np.ndarray
) -> None:
    """Start the filter at Places, with the configured yaw; a tag may have turned before a restart."""
    yaw, yaw_std = parameters.initial_yaw, parameters.initial_yaw_std
    if ekf.last_agreement > -np.inf:
        yaw_std, ekf.attitude_reset = YAW_SEARCH_STD, True
    _begin(ekf, parameters, t, places, yaw, yaw_std, parameters.use_imu)
    ekf.resting, ekf.rest_since = resting, t
    ekf.horizon.state = STARTED
    add_reset(ekf, t, history)


@compiled
def start(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    t: float,
    timed_out: bool,
    history: np.ndarray,
) -> None:
    """Start the filter if the window determines a single position.

    There are three starts. A tag at rest on the ground starts at the most probable place there. A
    tag at rest elsewhere starts without velocity. A moving tag starts with the velocity that
    its TDOAs give, at one or two places. If the ground is likely, and TDOAs are too noisy to
    show rest, the tag waits for the timeout. Then it starts on the ground.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    timed_out : bool
        Whether the start has been awaited for `start_timeout`. Then it is accepted even if the TDOAs
        contradict each other. Their residuals widen the covariance.
    history : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    window = recent(ekf, parameters.start_window)
    if len(window) < MINIMUM:
        return
    ekf.next_search = t + CHECK_PERIOD
    known = _known_height(ekf, parameters, t)
    places, share = _search(ekf, anchors, parameters, t, window, N_PLACES)
    stationary_position.sort_places(places, ekf, parameters)
    x, covariance, cost = places.x, places.covariance, places.cost
    pairs = ekf.pairs[: ground.find_pairs(window, ekf.pairs)]
    rest_x, rest_covariance = x[0].copy(), covariance[0].copy()
    # before the covariance includes other explanations
    spread_out = np.trace(rest_covariance[:3, :3]) > APART**2
    ground_log_odds = stationary_position.weigh_explanations(
        ekf, pairs, anchors, parameters, known, rest_x, rest_covariance
    )
    motion = ground.judge_motion(pairs, anchors, rest_x, ekf.still_covariance)
    still = motion == ground.STILL
    likely = motion != ground.MOVES and ground_log_odds > stationary_position.LIKELY
    on_ground = ground_log_odds > (0.0 if still else stationary_position.DECISIVE)
    on_ground |= likely and timed_out
    accepted = (
        still
        if on_ground or likely
        else share >= AGREE and workspace.admits(ekf.workspace, x[0], covariance[0])
    )
    if not (accepted or timed_out):
        return
    if still or on_ground or not (accepted or cost[1] < np.inf):
        x[0], covariance[0] = rest_x, rest_covariance
    if on_ground:
        cost[1] = np.inf
    elif spread_out:
        split(places)
        stationary_position.sort_places(places, ekf, parameters)
    for k in range(N_PLACES if still else 0):
        stationary_position.set_at_rest(x[k], covariance[k], ekf.still_covariance)
    _start_at(ekf, parameters, t, places, still and parameters.zero_velocity, history)


@compiled
def start_slowly(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, history: np.ndarray
) -> None:
    """Start the filter if few TDOAs come, from the last SLOW_TDOAS or SLOW_STAMPS.

    With this many TDOAs the filter starts in any case. With fewer, but at least MINIMUM, it starts
    only if they determine a single position. A tag with a quiet IMU may stand on the ground.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    history : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    window, stamps = _last(ekf, t)
    enough = len(window) >= SLOW_TDOAS or (stamps >= SLOW_STAMPS and len(window) > 2 * stamps)
    if not (enough or len(window) >= MINIMUM):
        return
    span, gap = t - window[0].t, 0.0
    for i in range(1, len(window)):
        gap = max(gap, window[i].t - window[i - 1].t)
    if span < parameters.start_window or gap > LONGEST_GAP * span:
        return
    places, share = _search(ekf, anchors, parameters, t, window, N_PLACES)
    stationary_position.sort_places(places, ekf, parameters)
    admitted = workspace.admits(ekf.workspace, places.x[0], places.covariance[0])
    if not (enough or (share >= AGREE and admitted)):
        return
    x, covariance = places.x[0].copy(), places.covariance[0].copy()
    sensed = parameters.use_imu and t - ekf.imu.t < parameters.imu_timeout
    stands = parameters.zero_velocity and sensed and inertial.is_quiet(ekf.imu)
    if stands:
        pairs = ekf.pairs[: ground.find_pairs(window, ekf.pairs)]
        known = _known_height(ekf, parameters, t)
        log_odds = stationary_position.weigh_explanations(
            ekf, pairs, anchors, parameters, known, x, covariance
        )
        stands = log_odds > stationary_position.DECISIVE
    if stands:
        stationary_position.set_at_rest(x, covariance, np.zeros((3, 3)))
        places.x[0], places.covariance[0], places.cost[1] = x, covariance, np.inf
    elif np.trace(places.covariance[0, :3, :3]) > APART**2:
        split(places)
        stationary_position.sort_places(places, ekf, parameters)
    _start_at(ekf, parameters, t, places, stands, history)


@compiled
def is_unsure(ekf: Record) -> bool:
    """Return whether the position of the best hypothesis is unknown.

    Its 3D standard deviation then exceeds UNKNOWN.
    """
    P = ekf.hypotheses[ekf.best].P
    return P[0, 0] + P[1, 1] + P[2, 2] > UNKNOWN**2


@compiled
def hold_for_search(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    t: float,
    silent: bool,
    history: np.ndarray,
) -> bool:
    """Hold a TDOA back for a search, because the position is unknown after a silence.

    Return whether the TDOA is held back: it then updates nothing. With the last required TDOA, the
    function searches and recovers the filter. A single TDOA would be linearized far from
    the tag, and the covariance would shrink about a wrong position. If few TDOAs come, they are
    not held back.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    silent : bool
        Whether this TDOA ends the silence.
    history : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    first = ekf.kept - 1 - MINIMUM
    if silent and first >= 0 and ekf.window[first].t > ekf.last_tdoa - RECOVERY_WINDOW:
        ekf.search_waits_until = t + RECOVERY_WINDOW
    if t >= ekf.search_waits_until:
        return False
    if len(recent(ekf, min(parameters.start_window, RECOVERY_WINDOW))) >= MINIMUM:
        ekf.search_waits_until = -np.inf
        recover(ekf, anchors, parameters, t, True, history)
    return True


@compiled
def relocate(
    ekf: Record, anchors: np.ndarray, parameters: Record, t: float, history: np.ndarray
) -> None:
    """Move a tag with few TDOAs and an unknown position to the place that its last TDOAs determine.

    The place must be better than the filter. Far from the linearization point, these TDOAs together
    determine a place that single updates do not reach.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    history : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    if (
        not (parameters.recover and is_unsure(ekf))
        or len(recent(ekf, parameters.start_window)) >= MINIMUM
    ):
        return
    best = ekf.hypotheses[ekf.best]
    places, share = _search(ekf, anchors, parameters, t, _last(ekf, t)[0], N_PLACES)
    x, covariance, cost = places.x, places.covariance, places.cost
    variance = np.trace(covariance[0, :3, :3])
    if cost[1] < np.inf:
        variance += np.sum((x[1, :3] - x[0, :3]) ** 2)
    if (
        share < AGREE
        or variance > BETTER * np.trace(best.P[:3, :3])
        or not workspace.admits(ekf.workspace, x[0], covariance[0])
    ):
        return
    hypotheses.set_states(ekf, x[0], covariance[0])
    ekf.horizon.state = STARTED
    add_reset(ekf, t, history)


@compiled
def last_few(ekf: Record) -> np.ndarray:
    """Return the TDOAs of a start with few TDOAs that ends with the newest one, (n,) TDOA."""
    return _last(ekf, ekf.window[ekf.kept - 1].t)[0]


@compiled
def _last(ekf: Record, t: float) -> tuple[np.ndarray, int]:
    """Return the last SLOW_TDOAS, or more until they have SLOW_STAMPS, and their number of stamps.

    None is older than LOST_TIME, except a single one. There are none before the first TDOA.
    """
    first, stamps = ekf.kept - 1, 1
    while first > 0 and ekf.kept - first < WINDOW and ekf.window[first - 1].t > t - LOST_TIME:
        new = ekf.window[first - 1].t != ekf.window[first].t
        if ekf.kept - first >= SLOW_TDOAS and stamps >= SLOW_STAMPS and new:
            break
        first -= 1
        stamps += new
    return ekf.window[first : ekf.kept], stamps


@compiled
def _find_surroundings(
    ekf: Record, window: np.ndarray, anchors: np.ndarray, parameters: Record
) -> None:
    """Update the workspace of a tag that hears the anchors of a window (n,) of TDOA."""
    workspace.listen(ekf, window, anchors, parameters.radio_reach, parameters.tag_side)
    workspace.surround(ekf, parameters.workspace_margin, ekf.workspace)


@compiled
def update_workspace(ekf: Record, anchors: np.ndarray, parameters: Record, t: float) -> None:
    """Update workspace and number of heard anchors of a running tag, up to stamp t (s).

    The workspace thus follows the tag through a hall.
    """
    ekf.next_workspace = t + noise.MEMORY
    _find_surroundings(ekf, recent(ekf, noise.MEMORY), anchors, parameters)
    ekf.heard = len(workspace.rows_heard(_last(ekf, t)[0]))


@compiled
def set_pose(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    t: float,
    pose: Record,
    history: np.ndarray,
) -> None:
    """Set the filter to a given pose, and start it if it does not run.

    Coordinates that are not given stay the same. Before the start, they may be anywhere in the
    workspace. Tilt, velocity and biases stay the same too, because gravity and TDOAs determine them
    better than the user.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    pose : POSE
        Given pose; NaN marks values that are not given.
    history : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    x, covariance = np.zeros(6), np.zeros((6, 6))
    if ekf.running:
        best = ekf.hypotheses[ekf.best]
        x[:] = best.x[:6]
        covariance[:, :] = best.P[:6, :6]
    else:
        workspace.surround(ekf, parameters.workspace_margin, ekf.workspace)
        anywhere(ekf.workspace, x, covariance)
    for k in range(3):
        if math.isnan(pose.p[k]):
            continue
        x[k] = pose.p[k]
        covariance[k, :] = 0.0
        covariance[:, k] = 0.0
        for j in range(3):
            if not math.isnan(pose.p[j]):
                covariance[k, j] = covariance[j, k] = pose.covariance[k, j]
    has_yaw = not math.isnan(pose.yaw)
    if not ekf.running:
        yaw, yaw_std = parameters.initial_yaw, parameters.initial_yaw_std
        if has_yaw:
            yaw, yaw_std = pose.yaw, pose.yaw_std
        places = Places(x.reshape(1, 6), covariance.reshape(1, 6, 6), np.zeros(1))
        _begin(ekf, parameters, t, places, yaw, yaw_std, parameters.use_imu)
    else:
        for h in range(HYPOTHESES):
            hypothesis = ekf.hypotheses[h]
            hypotheses.set_state(hypothesis, x, covariance)
            if has_yaw:
                turn_about_vertical(hypothesis.x, pose.yaw - yaw_of(hypothesis.x))
                yaw_check.forget(ekf.yaw_test, True)
                hypotheses.set_yaw_variance(hypothesis, pose.yaw_std**2)
                if h != ekf.best:
                    hypothesis.log_weight = -np.inf
    ekf.consistency, ekf.late_as_known = 1.0, False
    ekf.horizon.state = OFF
    add_reset(ekf, t, history)


@compiled
def _begin(
    ekf: Record,
    parameters: Record,
    t: float,
    places: Places,
    yaw: float,
    yaw_std: float,
    steered: bool,
) -> None:
    """Start level hypotheses at all places, with all possible yaws.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    places : Places
        Positions and velocities.
    yaw, yaw_std : float
        Yaw of the body and its standard deviation, rad.
    steered : bool
        Whether a sensor measures motion in the body frame, so the yaws can be distinguished.
    """
    x, covariance, cost = places.x, places.covariance, places.cost
    if ekf.first_best < 0 and ekf.last_agreement > -np.inf:
        ekf.first_best = ekf.best
    accel, tilt_std = _mean_accel(ekf.imu, parameters), TILT_STD
    if ekf.running and parameters.use_imu:
        accel[:], tilt_std = ekf.imu_fault_detector.up, RESET_TILT_STD
    unknown = steered and yaw_std > hypotheses.YAW_STD
    for h in range(HYPOTHESES):
        hypothesis, offset = ekf.hypotheses[h], hypotheses.yaw_offset(h)
        nearest = min(offset, 2.0 * math.pi - offset)
        place = h // N_YAWS
        hypothesis.log_weight = -np.inf
        if place < len(x) and (unknown or offset == 0.0):
            hypothesis.log_weight = -0.5 * (nearest / yaw_std) ** 2 - cost[place]
        if not hypotheses.alive(hypothesis):
            continue
        level(accel, yaw + offset, hypothesis.x)
        hypothesis.x[10:] = 0.0
        P = hypothesis.P
        P[:] = 0.0
        hypotheses.set_state(hypothesis, x[place], covariance[place])
        P[6, 6] = P[7, 7] = tilt_std**2
        P[8, 8] = min(yaw_std, hypotheses.YAW_STD if steered else ANY_YAW) ** 2
        for k in range(3):
            P[9 + k, 9 + k] = parameters.initial_accel_bias_std**2
            P[12 + k, 12 + k] = parameters.initial_gyro_bias_std**2
    ekf.best = 0
    yaw_check.forget(ekf.yaw_test, not unknown)
    noise.begin(ekf.information, ekf.hypotheses[0].P)
    ekf.t = ekf.last_tdoa = ekf.last_agreement = t
    ekf.consistency = 1.0
    ekf.running = True


@compiled
def recover(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    t: float,
    lost: bool,
    history: np.ndarray,
) -> None:
    """Move the filter to another position if the TDOAs of the window agree on it.

    The window must agree on the position clearly better than on the position of the filter.
    Attitude and biases stay the same, unless an IMU has led to the wrong place. A tag with a sound
    inertial sensor, or with wheels, does not jump. So its recovery is limited to the distance that
    it can have moved since the filter agreed with TDOAs.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    lost : bool
        Whether the tag may be anywhere. Then no limit applies, and several places are followed.
    history : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    window = _window_of_recovery(ekf, parameters)
    if len(window) < MINIMUM:
        return
    ekf.next_search = t + CHECK_PERIOD
    count = N_PLACES if lost else 1
    places, share = _search(ekf, anchors, parameters, t, window, count)
    x, covariance, cost = places.x, places.covariance, places.cost
    explained = np.mean(inliers(window, anchors, ekf.hypotheses[ekf.best].x[:6]))
    near = lost and workspace.distance_outside(ekf.workspace, x[0]) <= workspace.STD
    admitted = near or workspace.admits(ekf.workspace, x[0], covariance[0])
    if share < AGREE_RECOVERY or not admitted:
        return
    if lost and cost[count - 1] < np.inf:
        _reopen(ekf, cost)
    elif share < CLEARLY_MORE + explained:
        return
    wheels = velocity.agrees(ekf.velocity, t, velocity.SLIP)
    # an IMU shows how far the tag can be only if the yaw is known
    felt = (
        parameters.use_imu
        and not ekf.imu_faulty
        and t - ekf.imu.t < parameters.imu_timeout
        and hypotheses.alike(ekf)
    )
    if not lost and wheels and _outweighs(ekf, anchors, window, x[0], t):
        return
    offset = (x[0, :6] - ekf.hypotheses[ekf.best].x[:6]) ** 2
    away, faster = math.sqrt(np.sum(offset[:3])), math.sqrt(np.sum(offset[3:]))
    if not lost and (felt or wheels) and away > reach(ekf, t):
        contradicted = RUNS_AWAY if faster > OTHER_MOTION else IMU_CONTRADICTED
        if felt and t - ekf.last_agreement > contradicted:
            _leave_imu_out(ekf, t, away)
        return
    for h in range(HYPOTHESES):
        hypothesis, place = ekf.hypotheses[h], min(h // N_YAWS, count - 1)
        if cost[place] == np.inf:
            place = 0
        hypotheses.set_state(hypothesis, x[place], covariance[place])
        if not parameters.use_imu:
            # wheels have led to a wrong place: a wrong yaw is a probable cause
            hypotheses.set_yaw_variance(hypothesis, ANY_YAW**2)
    ekf.rival_since, ekf.horizon.state = -np.inf, OFF
    if lost:  # the information from before the silence belongs to another place
        noise.begin(ekf.information, ekf.hypotheses[ekf.best].P)
    else:
        felt = felt or (ekf.sensed and t - ekf.relocated < AGAIN)
        ekf.relocated = ekf.recovered = t
        if felt:  # what led to a wrong place has spoiled velocity, attitude and biases, too
            open_yaw(ekf, parameters, history)
    ekf.consistency, ekf.late_as_known = 1.0, False
    ekf.rest_since = t
    ekf.recoveries += 1
    add_reset(ekf, t, history)


@compiled
def _window_of_recovery(ekf: Record, parameters: Record) -> np.ndarray:
    """Return the shortest window with TDOAs enough for a recovery, (n,) TDOA."""
    window = recent(ekf, SHORT_WINDOW)
    if len(window) < ENOUGH:
        window = recent(ekf, min(parameters.start_window, RECOVERY_WINDOW))
    return window if len(window) >= MINIMUM else recent(ekf, LONG_WINDOW)


@compiled
def _leave_imu_out(ekf: Record, t: float, away: float) -> None:
    """Leave the IMU out from stamp t (s), because TDOAs agree on a place that is `away` (m) from it.

    Without an IMU that is right, the yaw is unknown.
    """
    imu_fault_detector.leave_out(ekf.imu_fault_detector, t, away)
    for h in range(HYPOTHESES):
        hypotheses.set_yaw_variance(ekf.hypotheses[h], ANY_YAW**2)


@compiled
def reach(ekf: Record, t: float) -> float:
    """Return how far the tag can be from the filter, m, at stamp t (s), since TDOAs agreed last."""
    since = t - ekf.last_agreement
    return REACH + REACH_SPEED * since + REACH_ACCELERATION * since**2


@compiled
def distrust(ekf: Record, parameters: Record, history: np.ndarray) -> None:
    """Open what a fault of the streams has spoiled: position, velocity, attitude and biases."""
    ekf.distrusted = False
    widen(ekf, history)
    if parameters.use_imu:
        reset_attitude(ekf, parameters, YAW_SEARCH_STD, history)
    for h in range(HYPOTHESES if not parameters.use_imu else 0):
        hypotheses.set_yaw_variance(ekf.hypotheses[h], ANY_YAW**2)


@compiled
def _outweighs(
    ekf: Record, anchors: np.ndarray, window: np.ndarray, rival: np.ndarray, t: float
) -> bool:
    """Return whether the motion by wheels outweighs a window of TDOAs that agree on a rival place.

    Wheels outweigh the TDOAs until the TDOAs have agreed on the place for RIVAL_TIME. Time in which
    a few late anchors explain the TDOAs does not count. Until then the tag may be at either place.
    rival is (3,), m, world frame; t is a stamp in s.
    """
    if t > ekf.rival_until or _are_late(window, anchors, ekf.hypotheses[ekf.best].x[:6]):
        ekf.rival_since = t
    ekf.rival_until = t + RIVAL_HELD
    ekf.rival[:] = rival[:3]
    return t - ekf.rival_since < RIVAL_TIME


@compiled
def _are_late(window: np.ndarray, anchors: np.ndarray, x: np.ndarray) -> bool:
    """Return whether TDOAs agree with a state, except for the TDOAs of LATE_ANCHORS anchors.

    x is position (m) and velocity (m/s), (6,), at the end of the window (n,) of TDOA.
    """
    agree, rows = inliers(window, anchors, x), workspace.rows_heard(window)
    fewest, others = AMONG_OTHERS
    if len(rows) < LATE_ANCHORS + others:
        return False
    for i in range(len(rows)):
        for j in range(i):
            count = agreeing = 0
            for k in range(len(window)):
                a, b = window[k].a, window[k].b
                if a != rows[i] and a != rows[j] and b != rows[i] and b != rows[j]:
                    count += 1
                    agreeing += agree[k]
            if count >= fewest and agreeing >= AGREE * count:
                return True
    return False


@compiled
def _reopen(ekf: Record, cost: np.ndarray) -> None:
    """Copy the yaws of the best hypothesis to both places.

    The probabilities of the places are exp(-cost), (N_PLACES,).
    """
    of_best = ekf.best // N_YAWS
    for yaw in range(N_YAWS):
        one = ekf.hypotheses[of_best * N_YAWS + yaw]
        other = ekf.hypotheses[(1 - of_best) * N_YAWS + yaw]
        other.x[:], other.P[:], other.log_weight = one.x, one.P, one.log_weight - cost[1 - of_best]
        one.log_weight -= cost[of_best]


@compiled
def widen(ekf: Record, history: np.ndarray) -> None:
    """Widen the covariance of position and velocity after an integration of wrong samples.

    Only TDOAs can show how large the error is.
    """
    noise.widen(ekf, WRONG_POSITION**2, SPEED**2)
    ekf.horizon.state = OFF
    add_reset(ekf, ekf.t, history)


@compiled
def reset_attitude(ekf: Record, parameters: Record, yaw_std: float, history: np.ndarray) -> None:
    """Reset attitude and biases to a start: level, with the present yaw and yaw_std (rad).

    Position and velocity stay the same.
    """
    best = ekf.hypotheses[ekf.best]
    x, covariance = best.x[:6].copy().reshape(1, 6), best.P[:6, :6].copy().reshape(1, 6, 6)
    place = Places(x, covariance, np.zeros(1))
    _begin(ekf, parameters, ekf.t, place, yaw_of(best.x), yaw_std, True)
    ekf.attitude_reset = True
    add_reset(ekf, ekf.t, history)


@compiled
def open_yaw(ekf: Record, parameters: Record, history: np.ndarray) -> None:
    """Follow four yaws again after the yaw was found wrong.

    The integrated motion was wrong too, so the covariance of position and velocity is widened. A
    yaw that is found wrong twice shows that the IMU is wrong.
    """
    if ekf.t - ekf.yaw_test.opened < TWICE:
        _leave_imu_out(ekf, ekf.t, 0.0)
    ekf.yaw_test.count += 1
    ekf.yaw_test.opened = ekf.t
    widen(ekf, history)
    reset_attitude(ekf, parameters, YAW_SEARCH_STD, history)


@compiled
def turn_yaw(ekf: Record, angle: float, history: np.ndarray) -> None:
    """Turn the yaw by an angle, rad, because TDOAs and the path of wheels show that it is wrong.

    Tilt and biases stay.
    """
    best = ekf.hypotheses[ekf.best]
    turn_about_vertical(best.x, angle)
    for h in range(HYPOTHESES):
        if h != ekf.best:
            ekf.hypotheses[h].log_weight = -np.inf
    hypotheses.set_yaw_variance(best, hypotheses.YAW_STD**2)
    yaw_check.forget(ekf.yaw_test, False)
    ekf.yaw_test.count += 1
    ekf.attitude_reset = True
    widen(ekf, history)


@compiled
def yaw_stays_unknown(ekf: Record, parameters: Record) -> bool:
    """Return whether a tag without an IMU has an unknown yaw, and too few TDOAs to find it.

    A velocity in the body frame then leads to a wrong place.
    """
    best = ekf.hypotheses[ekf.best]
    known = hypotheses.followed(ekf) == 1 and best.P[8, 8] <= hypotheses.YAW_STD**2
    few = len(recent(ekf, YAW_SECONDS)) < FEWEST_OF_YAW
    return not (parameters.use_imu or known) and few


@compiled
def open_unknown_yaw(ekf: Record, parameters: Record, history: np.ndarray) -> None:
    """Follow four yaws before a velocity updates a tag without an IMU whose yaw is unknown.

    From this velocity on, motion can determine the yaw.
    """
    unknown = ekf.hypotheses[ekf.best].P[8, 8] > hypotheses.YAW_STD**2
    if unknown and hypotheses.followed(ekf) == 1:
        reset_attitude(ekf, parameters, YAW_SEARCH_STD, history)


@compiled
def level_first(ekf: Record, parameters: Record, history: np.ndarray) -> None:
    """Reset the attitude when inertial samples come for the first time.

    If a single hypothesis is left, the standard deviation of its yaw stays the same. Otherwise the
    yaw becomes unknown.
    """
    yaw_std = YAW_SEARCH_STD
    if hypotheses.followed(ekf) == 1:
        yaw_std = math.sqrt(ekf.hypotheses[ekf.best].P[8, 8])
    first_best = ekf.first_best
    reset_attitude(ekf, parameters, yaw_std, history)
    ekf.first_best = first_best  # no sample has distinguished the yaws before


@compiled
def _known_height(ekf: Record, parameters: Record, t: float) -> KnownHeight:
    """Return the height of the tag at stamp t (s) by another source than TDOAs.

    Before the filter runs, the accelerometer alone gives the tilt.
    """
    if parameters.fixed_height_std > 0.0:
        return KnownHeight(parameters.fixed_height, parameters.fixed_height_std)
    if ekf.running:
        q = ekf.hypotheses[ekf.best].x[6:10]
        up = 1.0 - 2.0 * (q[0] ** 2 + q[1] ** 2)
    else:
        accel = _mean_accel(ekf.imu, parameters)
        up = accel[2] / max(math.sqrt(np.sum(accel**2)), 1e-9)
    z = height.at_start(ekf, parameters, up, t)
    return KnownHeight(z, max(parameters.height_std, SMALLEST_STD))


@compiled
def recent(ekf: Record, seconds: float) -> np.ndarray:
    """Return the TDOAs of the `seconds` before the newest one, with it: (n,) TDOA.

    At most WINDOW are returned; none before the first TDOA.
    """
    first = ekf.kept - 1
    since = ekf.window[ekf.kept - 1].t - seconds
    while first > 0 and ekf.kept - first < WINDOW and ekf.window[first - 1].t > since:
        first -= 1
    return ekf.window[first : ekf.kept]


@compiled
def _mean_accel(imu: Record, parameters: Record) -> np.ndarray:
    """Return the mean specific force (3,), m/s^2, body frame.

    Each axis is weighted between the measurement and hovering.
    """
    inertial.weigh(imu, False, parameters)
    hovering = np.array([0.0, 0.0, GRAVITY])
    return hovering + imu.accel_weight * (imu.mean_accel - hovering)
