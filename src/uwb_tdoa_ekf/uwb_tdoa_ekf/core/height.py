# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Range finder that looks down along the body's -z, over ground that may have steps.

The height of the body above z = 0 of the world is the ground level plus (range + height_arm) *
cos(tilt). The ground is level except for steps (boxes, edges). A step shows as a sudden, lasting
and consistent disagreement. Then either the ground below has changed, or the filter is wrong. If
the filter has agreed with the range finder until then, the ground has changed. Otherwise the filter
changes its height. If the TDOAs disagree with the result for long, the range finder is ignored for
a while, longer each time.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.robust_loss import GEMAN_MCCLURE, weight

from . import yaw_check
from .history import add_reset, add_update
from .hypotheses import add_log_likelihood, alive
from .inertial import UPRIGHT
from .memory import N_YAWS, USED, fill_residual
from .state import rotation
from .update import kalman_robust, project
from .workspace import STD

# Set on the six flights of 0425/TDOA2, see docs/notebook/auxiliary_sensors.md.
# s over which the error of a range persists: the ground is uneven, the sensor has an offset
CORRELATION_TIME = 0.5
# s of ranges, altitudes and TDOAs that count: after so long without agreement, the ground level below,
# or the offset of a barometer, is unknown; after so long in agreement, a disagreement is a step of the
# ground
MEMORY = 1.0
STUCK_TIME = 0.5  # s; a working sensor of a tag in motion never repeats a value for this long
GATE = 4.0  # standard deviations beyond which a range disagrees
ALIKE = 0.15  # m within which disagreeing ranges agree with each other
STEP_TIME, STEP_COUNT = 0.25, 7  # s and number of consistent ranges that show a step
HIGHEST_STEP = 1.5  # m, of the ground
PULL_SCALE = 3.0  # m, scale of the loss that weighs the innovations of TDOAs
FEWEST = 16.0  # least number of TDOAs that an average covers
PULL_LIMIT = 0.45  # m by which TDOAs disagree
EXPLAINED = 0.5  # of tdoa_std, root mean square that errors of all TDOAs may have in common
# s of disagreement after which the range finder is ignored, for as long the first time, and at most
IGNORE_TIME, LONGEST_IGNORED = (3.0, 60.0)


@compiled
def observe(
    ekf: Record, parameters: Record, sensor: Record, residual: Record, records: np.ndarray
) -> None:
    """Update a running filter with a range, at the stamp of the range.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    sensor : SENSOR_ROW
        Measurement; its first value is the range, m, infinite without a target.
    residual : RESIDUAL
        Filled by this function.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    height = ekf.height
    # before `record` sets `heard`
    share = min(max(sensor.t - height.heard, 0.0) / (2.0 * CORRELATION_TIME), 1.0)
    record(ekf, sensor)
    innovation, distance = ekf.innovation, sensor.value[0] + parameters.height_arm
    up = compare(
        ekf.hypotheses[ekf.best],
        height.level,
        distance,
        parameters,
        ekf.transition.rotation,
        innovation,
    )
    fill_residual(residual, innovation, 0.0)
    z = _plausible_z(ekf, parameters, up)
    if math.isnan(z):
        return
    # A range that stays the same is of a stuck sensor, except at rest. Without an IMU, rest is unknown.
    if (
        not ekf.quiet and sensor.t - height.changed > STUCK_TIME
    ) or sensor.t < height.ignored_until:
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
    base_innovation = z - ekf.hypotheses[ekf.best].x[2]
    limit = GATE * math.sqrt(residual.variance)
    if abs(innovation.value) > limit or _is_alike(height, innovation.value):
        if not _settle(ekf, parameters, sensor.t, base_innovation, limit, records):
            return
    since = sensor.t - height.used
    if since < MEMORY:
        height.agreed += since
    height.used, height.disagreeing = sensor.t, max(0, height.disagreeing - 1)
    inflation = max(1.0, 2.0 * CORRELATION_TIME / max(min(since, MEMORY), 1e-3))
    for h in range(len(ekf.hypotheses)):
        hypothesis = ekf.hypotheses[h]
        if not alive(hypothesis):
            continue
        compare(hypothesis, height.level, distance, parameters, ekf.transition.rotation, innovation)
        w = kalman_robust(hypothesis, innovation, inflation, GATE)
        add_update(ekf, h, sensor.t, records)
        if h == ekf.best:
            residual.weight, residual.verdict = w, USED
            if ekf.yaw_test.alone:
                yaw_check.observe(ekf, inflation, False)


@compiled
def record(ekf: Record, sensor: Record) -> None:
    """Store a range, whether or not it is used."""
    height = ekf.height
    if sensor.value[0] != height.range:
        height.changed = sensor.t
    height.range, height.heard = sensor.value[0], sensor.t


@compiled
def compare(
    hypothesis: Record,
    level: float,
    distance: float,
    parameters: Record,
    R: np.ndarray,
    innovation: Record,
) -> float:
    """Fill in the innovation of a distance to the ground and return cos(tilt).

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Hypothesis, predicted to the stamp of the measurement.
    level : float
        Height of the ground, m, world frame.
    distance : float
        Distance from the body to the ground along the body's -z, m.
    parameters : PARAMETERS
        Tuning of the filter.
    R : (3, 3) array
        Rotation from body to world. Filled.
    innovation : INNOVATION
        Filled by this function.
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
    """Update the weights of hypotheses at several places with a distance to the ground.

    The ground counts as free of steps. distance is in m. The likelihood counts with a power `share`
    (0 to 1), because errors of successive distances are correlated. Return whether there are
    several places; then ekf.innovation was overwritten.
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
            add_log_likelihood(hypothesis, innovation, 1.0, share)
    return several


@compiled
def _is_alike(height: Record, value: float) -> bool:
    """Return whether an innovation (m) agrees with the disagreeing ranges before it."""
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
    """Handle a disagreeing range: change the ground level or the filter if the disagreement lasts.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    base_innovation : float
        Innovation of the height if there is no step below, m.
    limit : float
        Gate of the innovation, m.
    records : (n,) RECORD
        History for the smoother; empty for no recording.

    Returns
    -------
    bool
        Whether the ground level or the filter was changed.
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
    trusted = height.agreed >= MEMORY or height.ignore_time > 0.0
    if trusted and abs(value) < HIGHEST_STEP:
        height.level -= height.disagreement
        return True
    if trusted:  # no step is so high, and the filter was right: the range finder is wrong
        _ignore(height, t)
        return False
    height.level, height.agreed = parameters.ground_height, 0.0
    _widen(ekf, base_innovation, t, records)
    return True


@compiled
def _widen(ekf: Record, error: float, t: float, records: np.ndarray) -> None:
    """Widen the covariance of a height that is wrong by about `error` (m) at stamp t (s)."""
    for hypothesis in ekf.hypotheses:
        hypothesis.P[2, 2] += error**2
        hypothesis.P[5, 5] += 1.0
    add_reset(ekf, t, records)


@compiled
def update_pull(height: Record, parameters: Record, innovation: Record, t: float) -> None:
    """Update the mean height error that TDOAs show, while a range finder or fixed height holds z.

    If they disagree for IGNORE_TIME, the range finder is ignored.

    Parameters
    ----------
    height : HEIGHT
        State of the range finder, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    innovation : INNOVATION
        TDOA of the best hypothesis.
    t : float
        Stamp, s.
    """
    ranged = t - height.used < MEMORY and t >= height.ignored_until
    if not (ranged or parameters.fixed_height_std > 0.0):
        height.pulls_since = t
        return
    if height.compared == -np.inf and not ranged:
        height.pulls_since = t
    step = min(1.0 / FEWEST, max(0.0, t - height.compared) / MEMORY)
    height.compared = t
    row = innovation.row[2]
    w = weight(GEMAN_MCCLURE, innovation.value, PULL_SCALE)
    w *= innovation.noise_variance / (innovation.noise_variance + innovation.prior_variance)
    height.pull += step * (w * row * innovation.value - height.pull)
    height.pull_information += step * (w * row * row - height.pull_information)
    if abs(height.pull) < PULL_LIMIT * height.pull_information:
        height.pulls_since = t
    elif ranged and t - height.pulls_since > IGNORE_TIME:
        _ignore(height, t)


@compiled
def _ignore(height: Record, t: float) -> None:
    """Ignore what holds the height from stamp t (s) on, twice as long as the last time."""
    height.ignore_time = min(max(IGNORE_TIME, 2.0 * height.ignore_time), LONGEST_IGNORED)
    height.ignored_until = t + height.ignore_time
    height.agreed = 0.0


@compiled
def contradiction(height: Record, parameters: Record, t: float) -> float:
    """Return by how much TDOAs place the tag above its fixed height, in m.

    The result is 0 without a fixed height, or if errors of TDOAs alone can explain the difference.
    The difference must last for MEMORY: low among the anchors, noise alone causes short ones. It must
    change TDOAs by more than EXPLAINED, because delays alone look like such a height where TDOAs hardly
    depend on it.

    Parameters
    ----------
    height : HEIGHT
        State of the range finder, with the averages of `update_pull`.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    """
    moment = t - height.pulls_since < MEMORY
    if (
        parameters.fixed_height_std == 0.0
        or moment
        or abs(height.pull) <= PULL_LIMIT * height.pull_information
        or height.pull**2 <= EXPLAINED**2 * parameters.tdoa_std**2 * height.pull_information
    ):
        return 0.0
    return height.pull / height.pull_information


@compiled
def holds(ekf: Record, parameters: Record, t: float, records: np.ndarray) -> bool:
    """Return whether the fixed height holds the tag at stamp t (s).

    After TDOAs have contradicted it, it does not for a while, longer each time, nor until the tag is
    there again, and does not rise or sink. A planar vehicle is always held.
    """
    height, best, std = ekf.height, ekf.hypotheses[ekf.best], parameters.fixed_height_std
    if std == 0.0 or parameters.planar:
        return std > 0.0
    if t < height.ignored_until:
        return False
    wrong, apart = contradiction(height, parameters, t), best.x[2] - parameters.fixed_height
    if wrong != 0.0:
        _ignore(height, t)
        _widen(ekf, wrong, t, records)
        return False
    if height.ignored_until > -np.inf:
        returned = apart**2 < best.P[2, 2] + std**2 and best.x[5] ** 2 < best.P[5, 5]
        height.ignored_until = -np.inf if returned else t + MEMORY
    return height.ignored_until == -np.inf


@compiled
def at_start(ekf: Record, parameters: Record, up: float, t: float) -> float:
    """Return z of the body by the last range, in m; NaN if there is no usable range.

    Parameters
    ----------
    ekf : EKF
        State of the filter.
    parameters : PARAMETERS
        Tuning of the filter.
    up : float
        cos(tilt).
    t : float
        Stamp, s.
    """
    height = ekf.height
    if t - height.heard > MEMORY or t < height.ignored_until:
        return np.nan
    return _plausible_z(ekf, parameters, up)


@compiled
def _plausible_z(ekf: Record, parameters: Record, up: float) -> float:
    """Return z of the body by the last range, in m; NaN if it is implausible.

    The ground counts as free of steps. up is cos(tilt).
    """
    z = parameters.ground_height + (ekf.height.range + parameters.height_arm) * up
    inside = ekf.workspace[0, 2] - STD < z < ekf.workspace[1, 2] + STD
    return z if inside and up > UPRIGHT else np.nan
