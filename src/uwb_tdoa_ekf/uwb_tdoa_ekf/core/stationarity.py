# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detection of a tag at rest, and zero-velocity updates.

Inertial samples alone cannot distinguish rest from a steady glide, and they vibrate while rotors
idle on the ground. TDOAs can, whatever their systematic errors are: at rest they do not change. All
TDOAs from one place have the same errors, so they count once.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import ground, hypotheses, stationary_position
from .history import add_update, replace_velocity
from .inertial import SHAKING_MEMORY
from .initialization import recent
from .memory import HYPOTHESES
from .state import CHECK_PERIOD, CONSTRAINT_PERIOD, GRAVITY, isolate, rotation
from .stationary_position import SPEED_STD
from .update import GATE, kalman_direct

# m/s, standard deviation of a zero-velocity update: with a quiet IMU, and with a vibrating one
QUIET_STD, SHAKING_STD = (0.02, 0.15)
# s of TDOAs in each check: the shorter window, or, if its TDOAs of a pair are too few, the longer, or
# all since the tag has been quiet, up to the longest
LOOK_WINDOW, LONG_WINDOW, QUIET_WINDOW = (0.4, 1.6, 25.0)
# checks in a row with changed TDOAs that end a rest: a check shows a change by chance in 1 of 20
# cases; checks in a row without a change that begin a rest within EARLY
FEWEST_CHECKS = 3
# m/s; if the IMU has measured a larger change of velocity, a single such check ends the rest
UNFELT = 0.06
# checks in a row without a change that begin the rest of a quiet tag: fewer may be a turning point
LONG = 10
# s after the start, or after the beginning of its last rest, within which FEWEST_CHECKS suffice
EARLY = 1.5
AGAIN = 0.3  # s between two corrections of a tag near the ground that is not known to stand
# rotors or wheels have stopped if the vibration is below this share of its mean over SHAKING_MEMORY
CALM = 0.1
LIFT = 0.25  # m/s upwards; a larger change of velocity, measured by the IMU, ends a rest
LIFT_MEMORY = 0.7  # s over which the measured acceleration is integrated
AWAY = 1.5  # s after such an end in which no new rest begins
SILENT = 0.5  # s without TDOAs after which a vibrating tag is not known to be at rest


@compiled
def detect_liftoff(ekf: Record, sample: Record, dt: float, records: np.ndarray) -> None:
    """Detect that a tag at rest is lifted, and set its velocity to the integrated acceleration.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    sample : IMU_SAMPLE
        The new sample, body frame.
    dt : float
        Time since the last sample, s.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
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
            isolate(hypothesis.P, k, LIFT**2)
            hypothesis.offset_cross[:, k] = 0.0
    replace_velocity(ekf, records)
    ekf.resting, ekf.next_look = False, sample.t + AWAY


@compiled
def check_stationarity(
    ekf: Record,
    anchors: np.ndarray,
    parameters: Record,
    t: float,
    records: np.ndarray,
) -> None:
    """Detect whether the tag is at rest, from its last TDOAs.

    Call not before ekf.next_look. The function sets ekf.resting. A tag that has landed is moved to
    its estimated position on the ground.

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
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    ekf.next_look = t + CHECK_PERIOD
    best = ekf.hypotheses[ekf.best]
    calm = ekf.quiet or np.sum(ekf.imu.vibration) < CALM * ekf.shaking
    if not (ekf.resting or calm or stationary_position.is_near_ground(best, parameters)):
        return
    count, motion = 0, ground.UNKNOWN
    for seconds in (LOOK_WINDOW, LONG_WINDOW, min(t - ekf.shaken, QUIET_WINDOW)):
        if motion == ground.UNKNOWN and (seconds <= LONG_WINDOW or ekf.quiet):
            count = ground.find_pairs(recent(ekf, seconds), ekf.pairs)
            pairs, covariance = ekf.pairs[:count], ekf.still_covariance
            motion = ground.judge_motion(pairs, anchors, best.x[:3], covariance)
    still = motion == ground.STILL
    # too few TDOAs and a quiet IMU give no evidence
    unshown = motion == ground.UNKNOWN and ekf.quiet
    if ekf.resting:
        if not unshown:
            ekf.doubts = 0 if still else ekf.doubts + 1
        ekf.resting = ekf.doubts < (FEWEST_CHECKS if np.abs(ekf.lift).max() < UNFELT else 1)
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
        long = ekf.stills >= (LONG if t - ekf.rest_since > EARLY else FEWEST_CHECKS)
        ekf.resting = stands and landed
        if not landed and long and not _moves(best, QUIET_STD):
            ekf.resting, ekf.late_as_known = True, False
        if ekf.resting:
            ekf.rest_since = t
        if landed and not stands:
            ekf.next_look = t + AGAIN


@compiled
def update_zero_velocity(ekf: Record, t: float, records: np.ndarray) -> None:
    """Apply a zero-velocity update to a tag at rest, and to a quiet tag with a slow velocity.

    The three axes are updated in sequence, at most once per CONSTRAINT_PERIOD.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    t : float
        Stamp, s.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    if ekf.resting and not ekf.quiet and t - ekf.last_tdoa > SILENT:
        ekf.resting = False
    if not (ekf.resting or ekf.quiet) or t < ekf.next_rest:
        return
    ekf.next_rest = t + CONSTRAINT_PERIOD
    std = QUIET_STD if ekf.quiet else SHAKING_STD
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        x, P = hypothesis.x, hypothesis.P
        if not hypotheses.alive(hypothesis):
            continue
        slow = np.abs(x[3:6]).max() < SPEED_STD and np.diag(P)[3:6].max() < SPEED_STD**2
        if not (slow or ekf.resting):
            continue
        for state in range(3, 6):
            kalman_direct(hypothesis, ekf.innovation, state, 0.0, std)
            add_update(ekf, h, t, records)


@compiled
def _moves(hypothesis: Record, std: float) -> bool:
    """Return whether inertial samples contradict a velocity of zero within `std` (m/s)."""
    return (hypothesis.x[3:6] ** 2 > GATE**2 * (np.diag(hypothesis.P)[3:6] + std**2)).any()
