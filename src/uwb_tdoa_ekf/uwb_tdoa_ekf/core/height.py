"""A range finder that looks down along the body's -z, over ground that may have steps.

The height of the body above the world's z = 0 is that of the ground below it plus (range +
height_arm) * cos(tilt). The ground is level but for steps (boxes, edges), which show as a sudden
disagreement that lasts and agrees with itself: then either the ground below has changed, or the
filter is wrong. A filter that has agreed with the range finder until then is right, and the ground
has changed; any other gives way. If the TDOAs in turn disagree with the result for long, the range
finder is not used for a while, and longer each time.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.robust_loss import GEMAN_MCCLURE, weight

from .history import add_reset, add_update
from .hypotheses import LARGEST_NIS, alive
from .memory import N_YAWS, REJECTED, USED
from .state import rotation
from .update import kalman, project

STEEPEST = 0.5  # cos(tilt) below which the beam meets the ground anywhere
# s over which the error of a range stays alike: the ground is uneven, the sensor has an offset
CORRELATION_TIME = 0.5
LONGEST_GAP = 1.0  # s without a range that agrees, after which nobody knows what ground is below
STUCK_TIME = 0.5  # s; a range finder in motion never repeats a value for so long
GATE = 4.0  # standard deviations beyond which a range disagrees
ALIKE = 0.15  # m within which disagreeing ranges agree with each other
STEP_TIME, STEP_COUNT = 0.25, 7  # s for which they must, and how many of them
SETTLED = 1.0  # s of agreement that make the filter the one to be believed
HIGHEST_STEP = 1.5  # m
BEYOND = 1.0  # m beyond the workspace, up or down, where no tag is
PULL_SCALE = 3.0  # m, of the loss that TDOAs are weighed with
# s, m, s: TDOAs averaged over the first disagree for the last
PULL_TIME, PULL_LIMIT, PULL_DELAY = (1.0, 0.45, 3.0)
# s for which a range finder is not used, the first time and at most
IGNORE_TIME, LONGEST_IGNORED = (3.0, 60.0)


@compiled
def observe(
    ekf: Record, parameters: Record, aid: Record, residual: Record, records: np.ndarray
) -> None:
    """Take a range, one of AID, into a running filter at its stamp; fills one of RESIDUAL."""
    height, share = (
        ekf.height,
        min(max(aid.t - ekf.height.heard, 0.0) / (2.0 * CORRELATION_TIME), 1.0),
    )
    record(ekf, aid)
    residual.weight, residual.verdict = 0.0, REJECTED
    innovation, distance = ekf.innovation, aid.value[0] + parameters.height_arm
    up = compare(
        ekf.hypotheses[ekf.best],
        height.level,
        distance,
        parameters,
        ekf.transition.rotation,
        innovation,
    )
    residual.innovation = innovation.value
    residual.variance = innovation.prior_variance + innovation.noise_variance
    z = _plausible_z(ekf, parameters, up)
    if math.isnan(z):
        return
    if (not ekf.quiet and aid.t - height.changed > STUCK_TIME) or aid.t < height.ignored_until:
        height.agreed = 0.0
        return
    if _weigh_places(ekf, parameters, distance, share):
        compare(
            ekf.hypotheses[ekf.best],
            height.level,
            distance,
            parameters,
            ekf.transition.rotation,
            innovation,
        )
    if aid.t - height.used > LONGEST_GAP:
        height.agreed = 0.0
    base_innovation = z - ekf.hypotheses[ekf.best].x[2]
    limit = GATE * math.sqrt(residual.variance)
    if abs(innovation.value) > limit or _is_alike(height, innovation.value):
        if not _settle(ekf, parameters, aid.t, base_innovation, limit, records):
            return
    since = aid.t - height.used
    height.agreed += min(since, LONGEST_GAP) if since < LONGEST_GAP else 0.0
    height.used, height.disagreeing = aid.t, max(0, height.disagreeing - 1)
    for h in range(len(ekf.hypotheses)):
        hypothesis = ekf.hypotheses[h]
        if not alive(hypothesis):
            continue
        compare(hypothesis, height.level, distance, parameters, ekf.transition.rotation, innovation)
        total = innovation.prior_variance + innovation.noise_variance
        w = weight(GEMAN_MCCLURE, innovation.value / math.sqrt(total), GATE)
        inflation = max(1.0, 2.0 * CORRELATION_TIME / max(min(since, LONGEST_GAP), 1e-3))
        innovation.total_variance = (
            innovation.prior_variance + innovation.noise_variance * inflation / w
        )
        kalman(hypothesis, innovation)
        if h == ekf.best:
            residual.weight, residual.verdict = w, USED
            add_update(ekf, aid.t, records)


@compiled
def record(ekf: Record, aid: Record) -> None:
    """Remember a range, whatever becomes of it."""
    height = ekf.height
    if aid.value[0] != height.range:
        height.changed = aid.t
    height.range, height.heard = aid.value[0], aid.t


@compiled
def compare(
    hypothesis: Record,
    level: float,
    distance: float,
    parameters: Record,
    R: np.ndarray,
    innovation: Record,
) -> float:
    """Fill in what a distance (m, along the body's -z to ground at `level`) says to a HYPOTHESIS,
    and R (3, 3), body to world. Returns cos(tilt).
    """
    x = hypothesis.x
    rotation(x[6], x[7], x[8], x[9], R)
    innovation.entries = 3
    innovation.states[0], innovation.row[0] = 2, 1.0
    innovation.states[1], innovation.row[1] = 6, distance * R[2, 1]
    innovation.states[2], innovation.row[2] = 7, -distance * R[2, 0]
    innovation.value = level + distance * R[2, 2] - x[2]
    innovation.noise_variance = parameters.height_std**2
    project(hypothesis.P, innovation)
    return R[2, 2]


@compiled
def _weigh_places(ekf: Record, parameters: Record, distance: float, share: float) -> bool:
    """Weigh hypotheses at several places, where there are any, by a distance (m) to the ground
    without steps. It counts as a share (0 to 1) of a distance with an error of its own. Returns
    whether there are several places; then ekf.innovation is another.
    """
    several = False
    for h in range(len(ekf.hypotheses)):
        several = several or (h // N_YAWS != ekf.best // N_YAWS and alive(ekf.hypotheses[h]))
    for h in range(len(ekf.hypotheses) if several else 0):
        hypothesis, innovation = ekf.hypotheses[h], ekf.innovation
        if alive(hypothesis):
            compare(
                hypothesis,
                parameters.ground_height,
                distance,
                parameters,
                ekf.transition.rotation,
                innovation,
            )
            variance = innovation.prior_variance + innovation.noise_variance
            hypothesis.log_weight -= (
                0.5
                * share
                * (min(innovation.value**2 / variance, LARGEST_NIS) + math.log(variance))
            )
    return several


@compiled
def _is_alike(height: Record, value: float) -> bool:
    """Whether an innovation (m) is that of the ranges before it that disagreed."""
    return height.disagreeing > 0 and abs(value - height.disagreement) < ALIKE


@compiled
def _settle(
    ekf: Record,
    parameters: Record,
    t: float,
    base_innovation: float,
    limit: float,
    records: np.ndarray,
) -> bool:
    """A range disagrees: after a while that it does so alike, the ground or the filter changes.

    Returns whether.
    """
    height, value = ekf.height, ekf.innovation.value
    if not _is_alike(height, value):
        height.disagreeing -= 1
        if height.disagreeing <= 0:
            height.disagreeing, height.disagreement, height.disagrees_since = 1, value, t
        return False
    height.disagreeing += 1
    height.disagreement += (value - height.disagreement) / height.disagreeing
    if t - height.disagrees_since < STEP_TIME or height.disagreeing < STEP_COUNT:
        return False
    height.disagreeing = 0
    if height.level != parameters.ground_height and abs(base_innovation) < min(limit, 2.0 * ALIKE):
        height.level = parameters.ground_height
        return True
    doubted = height.ignore_time > 0.0
    if (height.agreed >= SETTLED or doubted) and abs(value) < HIGHEST_STEP:
        height.level -= height.disagreement
        return True
    if doubted:
        return False
    height.level, height.agreed = parameters.ground_height, 0.0
    for h in range(len(ekf.hypotheses)):
        hypothesis = ekf.hypotheses[h]
        if alive(hypothesis):
            hypothesis.P[2, 2] += base_innovation**2
            hypothesis.P[5, 5] += 1.0
    add_reset(ekf, t, records)
    return True


@compiled
def update_pull(height: Record, parameters: Record, innovation: Record, t: float) -> None:
    """What one TDOA (INNOVATION of the best hypothesis) says of z beyond the filter, while a range
    finder or a fixed height holds that.
    """
    ranged = t - height.used < LONGEST_GAP and t >= height.ignored_until
    if not (ranged or parameters.fixed_height_std > 0.0):
        height.pulls_since = t
        return
    if height.compared == -np.inf and not ranged:
        height.pulls_since = t
    step = min(1.0, max(0.0, t - height.compared) / PULL_TIME)
    height.compared = t
    row = innovation.row[2]
    w = weight(GEMAN_MCCLURE, innovation.value, PULL_SCALE)
    height.pull += step * (w * row * innovation.value - height.pull)
    height.pull_information += step * (w * row * row - height.pull_information)
    if abs(height.pull) < PULL_LIMIT * height.pull_information:
        height.pulls_since = t
    elif ranged and t - height.pulls_since > PULL_DELAY:
        height.ignore_time = min(max(IGNORE_TIME, 2.0 * height.ignore_time), LONGEST_IGNORED)
        height.ignored_until = t + height.ignore_time
        height.agreed = 0.0


@compiled
def contradiction(height: Record, parameters: Record, t: float) -> float:
    """By how much, m, TDOAs say that the tag is above its fixed height at stamp t, s; 0 if it has
    none, or if TDOAs alone could be off by that. Low among anchors, noise alone makes them say so
    for a moment.
    """
    moment = t - height.pulls_since < PULL_TIME
    if (
        parameters.fixed_height_std == 0.0
        or moment
        or abs(height.pull) <= PULL_LIMIT * height.pull_information
    ):
        return 0.0
    return height.pull / height.pull_information


@compiled
def at_start(ekf: Record, parameters: Record, up: float, t: float) -> float:
    """z of the body, m, that the last range tells with cos(tilt) `up` at stamp t (s); NaN if it
    tells nothing.
    """
    height = ekf.height
    if t - height.heard > LONGEST_GAP or t < height.ignored_until:
        return np.nan
    return _plausible_z(ekf, parameters, up)


@compiled
def _plausible_z(ekf: Record, parameters: Record, up: float) -> float:
    """z of the body, m, above the ground without steps, by the last range; NaN if that cannot be."""
    z = parameters.ground_height + (ekf.height.range + parameters.height_arm) * up
    inside = ekf.workspace[0, 2] - BEYOND < z < ekf.workspace[1, 2] + BEYOND
    return z if inside and up > STEEPEST else np.nan
