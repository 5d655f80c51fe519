"""A tag that does not move: its velocity is zero, and what it hears from one place tells that place
once.

Inertial samples alone cannot tell rest from a steady glide, and they shake while rotors idle on the
ground. TDOAs can, whatever their systematic errors are: at rest they stay what they are.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import ground, hypotheses, stationary_position
from .history import add_update, replace_velocity
from .memory import HYPOTHESES
from .state import GRAVITY, rotation
from .update import update_state

PERIOD = 0.05  # s between zero-velocity updates
# m/s, standard deviation of such an update: of a quiet inertial sensor, and of one that shakes
QUIET_STD, SHAKING_STD = (0.02, 0.15)
SPEED = 0.05  # m/s; a quiet tag that is known to be slower stands, a faster one may glide
LOOK_PERIOD, LOOK_WINDOW = 0.1, 0.4  # s between two looks at the TDOAs, and s of TDOAs in each
# looks in a row with changed TDOAs that end a rest: one look in twenty shows a change by chance
MOST_DOUBTS = 3
# m/s; where the inertial sensor has felt more lift than that, one such look ends the rest
UNFELT = 0.06
# looks in a row without a change that begin the rest of a quiet tag: fewer may be a turning point
LONG = 10
# s after the start, or after its last rest began, within which so many looks are enough
EARLY, LONG_ENOUGH = (1.5, 3)
AGAIN = 0.3  # s between two corrections of a tag that is near the ground, and is not known to stand
# standard deviations of the velocity that inertial samples tell, beyond which the tag moves
GATE = 3.0
# rotors or wheels have stopped when the vibration is below that share of its mean over so many
# seconds
CALM, SHAKING_MEMORY = (0.1, 2.0)
LIFT = 0.25  # m/s upwards that end a rest when the inertial sensor measures them
LIFT_MEMORY = 0.7  # s over which what it feels adds up
AWAY = 1.5  # s after such an end, for which the tag is not taken for one at rest again
SILENT = 0.5  # s without TDOAs after which a tag that shakes is not known to be at rest
# s; TDOAs of a tag at rest have the same errors: those of each such interval repeat what is known
# once more
SAME_ERROR = 0.01


@compiled
def repetition(ekf: Record, t: float) -> float:
    """Factor on the variance of a TDOA stamped t, s: how many times over the TDOAs of this rest
    have measured the same, errors included.
    """
    return 1.0 + (t - ekf.rest_since) / SAME_ERROR if ekf.resting else 1.0


@compiled
def detect_liftoff(ekf: Record, sample: Record, dt: float, records: np.ndarray) -> None:
    """Take an IMU_SAMPLE of a tag that is at rest, dt s after the one before: if it is lifted, it
    moves as fast as that has made it.
    """
    if not ekf.resting:
        ekf.shaking += min(1.0, dt / SHAKING_MEMORY) * (np.sum(ekf.imu.vibration) - ekf.shaking)
        return
    best, R = ekf.hypotheses[ekf.best], ekf.transition.rotation
    rotation(best.x[6], best.x[7], best.x[8], best.x[9], R)
    for k in range(3):
        force = -GRAVITY if k == 2 else 0.0
        for j in range(3):
            force += R[k, j] * (sample.accel[j] - best.x[10 + j])
        ekf.lift[k] += dt * (force - ekf.lift[k] / LIFT_MEMORY)
    if ekf.lift[2] < LIFT:
        return
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        for k in range(3, 6):
            hypothesis.x[k] = ekf.lift[k - 3] if ekf.quiet or k == 5 else 0.0
            hypothesis.P[k, :] = 0.0
            hypothesis.P[:, k] = 0.0
            hypothesis.P[k, k] = LIFT**2
            hypothesis.offset_cross[:, k] = 0.0
    replace_velocity(ekf, records)
    ekf.resting, ekf.next_look = False, sample.t + AWAY


@compiled
def check_stationarity(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    window: np.ndarray,
    t: float,
    records: np.ndarray,
) -> None:
    """Whether the tag is at rest, by a window (n,) of TDOA up to stamp t, s, where that can be; not
    before ekf.next_look.
    """
    ekf.next_look = t + LOOK_PERIOD
    best = ekf.hypotheses[ekf.best]
    calm = ekf.quiet or np.sum(ekf.imu.vibration) < CALM * ekf.shaking
    if not (ekf.resting or calm or stationary_position.is_near_ground(best, parameters)):
        return
    count = ground.find_pairs(window, ekf.pairs)
    motion = ground.judge_motion(ekf.pairs[:count], anchors, best.x, ekf.still_covariance)
    still = motion == ground.STILL
    # too few TDOAs: no evidence, and neither has the inertial sensor any
    unshown = motion == ground.UNKNOWN and ekf.quiet
    if ekf.resting:
        if not unshown:
            ekf.doubts = 0 if still else ekf.doubts + 1
        ekf.resting = ekf.doubts < (MOST_DOUBTS if np.abs(ekf.lift).max() < UNFELT else 1)
    else:
        ekf.lift[:] = 0.0
        ekf.doubts = 0
        if not unshown:
            ekf.stills = ekf.stills + 1 if still and ekf.quiet else 0
        stands = calm and (still or ekf.quiet)
        place, covariance = np.empty(3), np.empty((3, 3))
        lateness = stationary_position.find_landed(
            ekf, ekf.pairs[:count], anchors, parameters, still, place, covariance
        )
        landed = lateness >= 0
        if landed and stands:
            ekf.late_as_known = lateness == ground.KNOWN
            stationary_position.set_position(ekf, place, covariance, t, records)
        elif landed:
            stationary_position.set_hovering_position(ekf, place, still, t, records)
        long = ekf.stills >= (LONG if t - ekf.rest_since > EARLY else LONG_ENOUGH)
        ekf.resting = stands and landed
        if not landed and long and not _moves(best, QUIET_STD):
            ekf.resting, ekf.late_as_known = True, False
        if ekf.resting:
            ekf.rest_since = t
        if landed and not stands:
            ekf.next_look = t + AGAIN


@compiled
def update_zero_velocity(ekf: Record, t: float, records: np.ndarray) -> None:
    """Zero velocity, one axis after the other, for a tag at rest, and for a quiet one that TDOAs
    have shown to be slow.
    """
    if ekf.resting and not ekf.quiet and t - ekf.last_tdoa > SILENT:
        ekf.resting = False
    if not (ekf.resting or ekf.quiet) or t < ekf.next_rest:
        return
    ekf.next_rest = t + PERIOD
    std = QUIET_STD if ekf.quiet else SHAKING_STD
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        x, P = hypothesis.x, hypothesis.P
        if not hypotheses.alive(hypothesis):
            continue
        slow = ekf.resting
        if not slow:
            slow = ekf.quiet
            for state in range(3, 6):
                slow = slow and abs(x[state]) < SPEED and P[state, state] < SPEED**2
        if not slow:
            continue
        for state in range(3, 6):
            update_state(hypothesis, ekf.innovation, state, 0.0, std)
            if h == ekf.best:
                add_update(ekf, t, records)


@compiled
def _moves(hypothesis: Record, std: float) -> bool:
    """Whether inertial samples contradict a velocity of zero, +- std m/s."""
    for state in range(3, 6):
        if hypothesis.x[state] ** 2 > GATE**2 * (hypothesis.P[state, state] + std**2):
            return True
    return False
