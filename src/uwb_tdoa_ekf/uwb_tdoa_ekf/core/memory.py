# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""All record types of the filter: measurements, its state between two events, results.

The types are rows of numpy's structured arrays. A copy of a FilterState is a copy of the filter.
Compiled code reads and writes `ekf.imu.slow_accel[k]` in place, and a function takes an entire
record as a single pointer. Python sees the same bytes (`FilterState.record`).
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.sensors import SENSORS, Stream
from uwb_tdoa_bias.effects.base import SensorFunction
from uwb_tdoa_bias.effects.samples import N_STATES

from ..anchor_table import AnchorTable
from . import noise
from .auxiliary import OFFSET_STATES
from .ground import MOST_PAIRS, PAIR
from .inertial import rows_of
from .state import ERROR_STATES, GRAVITY, NOMINAL_STATES, TRANSITION
from .update import INNOVATION

# Verdict of a measurement.
USED, REJECTED, LATE, INVALID, STARTUP, COMPENSATED, REPEATED = range(7)


N_YAWS, N_PLACES = (4, 2)  # numbers of yaws and places that a start follows in parallel
HYPOTHESES = N_YAWS * N_PLACES
Floor = tuple[np.ndarray, np.ndarray, np.ndarray]  # as in EffectSet.on_floor
WINDOW = 512  # TDOAs kept for a start
YAW_ERRORS = 19  # that the test of the yaw compares

# Limits of what can be a measurement; nothing is tuned.
MAX_RATE, MAX_ACCEL = 100.0, 1000.0  # rad/s and m/s^2, beyond the range of any inertial sensor
# largest slope of a bias (m per m or m/s), and largest state (m or m/s) of its linearization
STEEPEST, FARTHEST = 1e3, 1e6
LARGEST_ERROR = 1.0  # m by which |d_ab| may exceed the distance between anchors a and b


def _record(*columns: tuple[Any, ...]) -> np.dtype:
    return np.dtype(list(columns), align=True)


# Measurements, with rows of anchors, not ids. All are in the order of their stamps. Sample: s,
# rad/s, m/s^2 (specific force), body frame.
IMU_SAMPLE = _record(("t", float), ("gyro", float, 3), ("accel", float, 3))
TDOA = _record(
    ("t", float),  # s, stamp
    ("a", int),
    ("b", int),  # rows of the anchors
    ("d", float),  # m, |p - b| - |p - a|, after correction
    ("variance", float),  # m^2, beyond tdoa_std
    # of the subtracted bias over position and velocity, m per m and m per m/s
    ("slope", float, N_STATES),
    ("state", float, N_STATES),  # linearization point of the bias, m and m/s
    ("pose", float, 3),  # on the path of wheels, m and rad, see velocity.py; the filter sets it
)
# Measurement of a sensor, see sensors.py.
SENSOR_ROW = _record(
    ("t", float), ("kind", int), ("value", float, 4), ("std", float, 4), ("anchor", int)
)

# Estimate of the state, for a yaw and place that the tag may have started with.
HYPOTHESIS = _record(
    ("log_weight", float),  # log probability relative to the best; -inf: pruned
    ("x", float, NOMINAL_STATES),  # nominal state, see state.py
    ("P", float, (ERROR_STATES, ERROR_STATES)),  # symmetric to the bit
    ("offset", float, OFFSET_STATES),  # auxiliary states, m and m/s, see auxiliary.py
    ("offset_cross", float, (OFFSET_STATES, ERROR_STATES)),  # covariance with the error state
    # their own covariance; 0: the state does not exist
    ("offset_P", float, (OFFSET_STATES, OFFSET_STATES)),
)

# Statistics of the inertial sensor, body frame.
IMU_STATE = _record(
    ("t", float),  # s, stamp of the last sample
    ("period", float),  # s, between samples, mean of the recent ones; 0: unknown
    ("gyro", float, 3),  # rad/s
    ("accel", float, 3),  # m/s^2; both are the input of the prediction until the next sample
    ("slow_accel", float, 3),  # m/s^2, after a low pass
    ("vibration", float, 3),  # m^2/s^4, power above the low pass
    ("mean_accel", float, 3),  # m/s^2, after a slower low pass
    # 0 to 1: recent power of the mean beyond hovering, relative to the vibration
    ("rectified", float, 3),
    ("gyro_power", float, 3),  # rad^2/s^2
    ("gyro_limit", float, 3),  # rad/s, largest size so far
    ("gyro_psd", float, 3),  # (rad/s)^2/Hz, of rates beyond the range
    ("accel_weight", float, 3),  # 0 to 1, of the measurement against hovering, see inertial.weigh
    ("accel_psd", float, 3),  # (m/s^2)^2/Hz, of the remaining noise
)

# State of the IMU fault detector, see imu_fault_detector.py.
IMU_FAULT_DETECTOR = _record(
    ("up", float, 3),  # m/s^2, specific force, rotated by the gyroscope
    ("excess_turn", float),  # rad, recent turn beyond the limit
    ("supported", float),  # s, stamp of the last sample whose force can carry the tag
    ("upright", float),  # s, stamp of the last sample in which the tag did not lie on its side
    ("contradicted", float),  # s, stamp of the last impossible sample
    ("reason", int),  # of the fault
    ("size", float),  # impossible value, in its own unit
)

# Pose given from outside, world frame. NaN: not given.
POSE = _record(
    ("t", float),  # s, stamp
    ("p", float, 3),  # m, position of the body
    ("covariance", float, (3, 3)),  # m^2, of p
    ("yaw", float),  # rad, of the body
    ("yaw_std", float),  # rad, standard deviation of the yaw
)

# State of an anchor.
ANCHOR = _record(
    ("position", float, 3),  # m, world frame
    ("excess_variance", float),  # m^2, of its TDOAs beyond tdoa_std, see noise.py
    ("learned", float),  # s, stamp of the last update of this variance
    ("heard", float),  # s, stamp of the last TDOA that was used
    ("innovation", float),  # m, last innovation, as a lateness of this anchor
    ("delay", float),  # m, estimated after a change in flight
    ("delay_variance", float),  # m^2, of the delay
    # probability that it is late because tag and anchor are near the ground, see ground.py; 0: it
    # cannot be
    ("late", float),
    ("predicted", float),  # s, stamp to which this probability was predicted
    ("floor_delay", float),  # m, known delay at a tag on the ground; NaN: unknown
    ("floor_std", float),  # m, standard deviation of this delay
)

# State of the downward range finder, see height.py.
HEIGHT = _record(
    ("range", float),  # m, last range received
    ("heard", float),  # s, stamp of the last range
    ("changed", float),  # s, stamp of the last range that differed from the one before
    ("used", float),  # s, stamp of the last range that was used
    ("level", float),  # m, height of the ground below, world frame
    ("agreed", float),  # s for which the range finder has agreed with the filter
    # number of consecutive ranges that disagree with the filter but agree with each other
    ("disagreeing", int),
    ("disagreement", float),  # m, their mean innovation
    ("disagrees_since", float),  # s, stamp of the first
    # m, mean weighted innovation of z by recent TDOAs, see height.update_pull; its information
    # follows
    ("pull", float),
    ("pull_information", float),  # no unit
    ("compared", float),  # s, stamp of the last TDOA in this mean
    ("pulls_since", float),  # s, stamp since which TDOAs disagree with z
    ("ignored_until", float),  # s, stamp until which no range is used
    ("ignore_time", float),  # s, duration of the last such interval
)

# State of the barometer, see pressure.py.
BAROMETER = _record(
    ("heard", float),  # s, stamp of the last altitude
    ("agreed", float),  # s, stamp of the last altitude that was used
    # recent mean of the normalized innovation squared, relative to the reported variance
    ("nis", float),
)

# State of the velocity sensor, see velocity.py.
VELOCITY = _record(
    ("heard", float),  # s, stamp of the last velocity
    ("changed", float),  # s, stamp of the last velocity that differed from the one before
    ("value", float, 4),  # m/s and rad/s, last velocity and yaw rate, body frame
    ("nis", float),  # recent mean of the normalized innovation squared, of the worst component
    ("refused", bool),  # the sensor disagrees with all others
    ("agreed", float),  # s, stamp of the last velocity of wheels that was used
    ("yaw_rate", float),  # rad/s, of wheels
    ("yaw_rate_variance", float),  # rad^2/s^2, of this yaw rate
    ("speed_variance", float),  # m^2/s^2, of the velocity of wheels
    # m and rad, pose on the path of wheels; s, stamps of its begin and of this pose; m/s and rad/s,
    # velocity and rate since, all in the horizontal plane
    ("pose", float, 3),
    ("path_since", float),
    ("path_until", float),
    ("path_velocity", float, 3),
    ("contradicted", bool),  # TDOAs contradict the path
    # rad, heading of the body minus that of the path when TDOAs last confirmed it; s, stamp of that
    ("heading", float),
    ("confirmed", float),
    ("next_look", float),  # s, stamp of the next comparison
)

# State of the yaw test, see yaw_check.py.
YAW_TEST = _record(
    # responses of the error state to cos(psi) - 1 and sin(psi), for a yaw error psi
    ("response", float, (2, ERROR_STATES)),
    # right side of the least squares of innovations since the last test by both responses
    ("vector", float, 2),
    ("information", float, (2, 2)),  # upper triangle of its matrix
    ("alone", bool),  # a single hypothesis is left
    ("ratios", float, YAW_ERRORS),  # log likelihood ratio of each yaw error to none
    # s of motion in which velocities must agree until they confirm a given yaw; not above 0: confirmed
    ("unconfirmed", float),
    ("next_look", float),  # s, stamp of the next test
    ("count", int),  # number of times that the yaw was opened again
    ("opened", float),  # s, stamp of the last time
)

# Moving horizon estimate, see horizon.py: whether it runs, or the filter has just started; number of
# its models, and most TDOAs in its window.
OFF, STARTED, RUNNING = range(3)
MODELS, ROOM = (9, 48)
LINEARIZATION = _record(("p", float, 3), ("weight", float))  # m, world frame; robust weight
MODEL = _record(
    # state before the window, [position, velocity], m and m/s, with its stamp in s, and at its end
    ("t", float),
    ("x", float, 6),
    ("P", float, (6, 6)),
    ("end", float, 6),
    ("end_P", float, (6, 6)),
    ("std", float),  # m, noise of a TDOA
    ("at", LINEARIZATION, ROOM),
)
# scalar update: Jacobian, gain, innovation in m and its variance in m^2; 0: there was none
UPDATE = _record(
    ("jacobian", float, 6), ("gain", float, 6), ("innovation", float), ("variance", float)
)
STEP = _record(
    # share of the velocity that is left after the prediction, and the time, s, over which it counts
    ("kept", float),
    ("way", float),
    ("x", float, 6),  # state and covariance before the update with the TDOA
    ("P", float, (6, 6)),
    ("bounds", UPDATE, 3),  # by the workspace, before it
    ("tdoa", UPDATE),
    ("unweighted", float),  # m^2, variance of the innovation without the robust weight
)
HORIZON = _record(
    ("state", int),
    ("count", int),
    ("models", MODEL, MODELS),
    ("steps", STEP, ROOM),  # steps: scratch
)

# State of the filter, except its anchors.
EKF = _record(
    ("t", float),  # s, stamp of the hypotheses
    ("running", bool),  # the filter has started
    ("best", int),  # index of the most probable hypothesis
    ("hypotheses", HYPOTHESIS, HYPOTHESES),
    ("imu", IMU_STATE),
    ("height", HEIGHT),
    ("barometer", BAROMETER),
    ("velocity", VELOCITY),
    ("ranged", SENSOR_ROW, 1),  # last distance to an anchor
    # m, offset of all distances when its variance was smallest; m^2, this variance; inf: not
    # estimated yet
    ("range_offset", float, 2),
    ("next_floor", float),  # s, stamp of the next floor constraint
    ("sensed", bool),  # inertial samples drive the prediction
    # m, another place that recent TDOAs agree on, but the motion by other sensors does not lead to
    ("rival", float, 3),
    ("rival_since", float),  # s, stamp since which they agree
    ("rival_until", float),  # s, stamp until which the tag may be there
    ("imu_fault_detector", IMU_FAULT_DETECTOR),  # of the inertial samples
    ("imu_faulty", bool),  # inertial samples are not used, because they are implausible
    ("yaw_test", YAW_TEST),  # see yaw_check.py
    # the attitude was reset while the filter ran: the yaws that follow have no common history
    ("attitude_reset", bool),
    # s, stamp until which the first inertial samples of a running filter are averaged; -inf:
    # samples are used
    ("attitude_averaged_until", float),
    ("shaken", float),  # s, stamp of the last inertial sample of a tag that was not quiet
    ("quiet", bool),  # the inertial sensor neither vibrates nor turns
    ("resting", bool),  # the tag is at rest, see stationarity.py
    # m, x and y of the place on the ground where the lateness of anchors is known; NaN: anywhere
    ("floor_place", float, 2),
    ("late_as_known", bool),  # anchors are late as known at the last place of rest
    ("rest_since", float),  # s, stamp of the beginning of the last rest
    ("next_look", float),  # s, stamp of the next check of rest
    ("doubts", int),  # consecutive checks at rest in which the TDOAs have changed
    # consecutive checks before a rest in which neither TDOAs nor inertial samples showed a motion
    ("stills", int),
    ("shaking", float),  # m^2/s^4, power of the vibration while not at rest, averaged over seconds
    ("lift", float, 3),  # m/s, recent change of velocity by inertial samples at rest, world frame
    ("last_agreement", float),  # s, stamp at which TDOAs agreed with the filter last
    ("extent", float, (2, 3)),  # m, lower and upper bounds of all anchors, world frame
    ("within", float, (2, 3)),  # m, bounds of the radio reach of the anchors heard lately
    # m, bounds of the place where the tag is expected, see workspace.py
    ("workspace", float, (2, 3)),
    # side of the tag relative to anchors in a plane, see workspace.configured_side
    ("side", float, 3),
    # 1.0 for axes along which the heard anchors share a coordinate, if the side of the tag is not
    # configured
    ("flat", float, 3),
    ("line", float, 3),  # direction of heard anchors along a line; 0: they are not
    ("middle", float, 3),  # m, center of the anchors heard lately
    ("next_workspace", float),  # s, stamp of the next update of the workspace
    # 1/m^2, of the position, by a single TDOA of each anchor heard lately, see noise.py
    ("information", float, (3, 3)),
    ("tdoa_rate", float),  # 1/s, of TDOAs and ranges, over the last second
    ("heard", float),  # number of anchors in the last TDOAs
    # variance of TDOAs over the stated one; recent means of the squared innovation and of its
    # product with the last one of the same anchor, over the stated variance; see noise.py
    ("noise_ratio", float),
    ("squared", float),
    ("persistent", float),
    ("motion_ratio", float),  # power of the random acceleration over that of motion_noise
    ("velocity_change", float, 3),  # m/s, sum of recent corrections of the velocity
    ("change_variance", float),  # m^2/s^2, of this sum if innovations are independent
    # s, stamp until which the tag may be anywhere, because its position was uncertain before
    ("position_unknown_until", float),
    ("search_waits_until", float),  # s, stamp until which TDOAs wait for a search
    ("consistency", float),  # share of recent TDOAs that agree with the best hypothesis
    ("distrusted", bool),  # a fault of the streams has spoiled the state: the next update opens it
    # best hypothesis when the yaws were opened anew for the first time; -1: they were not
    ("first_best", int),
    ("recoveries", int),  # number of recoveries
    ("relocated", float),  # s, stamp of the last recovery from a contradiction
    ("recovered", float),  # s, the same, or the last stamp at which its yaw was not found yet
    ("first_tdoa", float),  # s, stamp of the first TDOA since the filter stopped
    ("last_tdoa", float),  # s, stamp of the last TDOA or range
    ("next_search", float),  # s, stamp of the next search
    ("next_odometry", float),  # s, stamp of the next odometry
    ("next_rest", float),  # s, stamp of the next zero-velocity update
    ("next_merge", float),  # s, stamp of the next merge of hypotheses
    ("horizon", HORIZON),
    ("kept", int),  # number of TDOAs in the window
    ("window", TDOA, 2 * WINDOW),  # recent TDOAs, oldest first
    ("recorded", int),  # number of records written to the history, see history.py
    # transition of the best hypothesis since the last record
    ("since_record", float, (ERROR_STATES, ERROR_STATES)),
    # Scratch: nothing below is used after an event.
    ("transition", TRANSITION),
    ("innovation", INNOVATION),
    ("paired", TDOA, 1),
    ("pairs", PAIR, MOST_PAIRS),
    ("still_covariance", float, (3, 3)),
)
EKF = np.dtype((np.record, EKF))  # Python reads its fields as attributes

# Results: odometry, and a residual for each measurement.
ODOMETRY = _record(
    ("t", float),  # s, stamp
    ("x", float, NOMINAL_STATES),  # nominal state, see state.py
    ("covariance", float, (9, 9)),  # of [p, v, attitude]
    # m^2, share of the position covariance that persisting errors cause, see noise.py
    ("consider_covariance", float, (3, 3)),
    ("rate", float, 3),  # rad/s, angular rate in the body frame; NaN: not measured
    ("rate_variance", float, 3),  # rad^2/s^2, of the rate
)
# Innovation and its variance in the unit of the measurement, weight 0 to 1, and verdict.
RESIDUAL = _record(
    ("innovation", float), ("variance", float), ("weight", float), ("verdict", np.uint8)
)


@compiled
def fill_residual(residual: Record, innovation: Record, weight: float) -> None:
    """Fill in the RESIDUAL of an INNOVATION that was used with a weight, or rejected with weight 0."""
    residual.innovation = innovation.value
    residual.variance = innovation.prior_variance + innovation.noise_variance
    residual.weight = weight
    residual.verdict = USED if weight > 0.0 else REJECTED


class FilterState(NamedTuple):
    """State of a filter.

    ekf : (1,) EKF. anchors : (N,) ANCHOR. functions : (k,) SENSOR_FUNCTION, known errors of the
    inertial sensor.
    """

    ekf: np.ndarray
    anchors: np.ndarray
    functions: np.ndarray

    @property
    def record(self) -> Record:
        """Return the fields of EKF as attributes: a view."""
        return self.ekf[0]

    def copy(self) -> FilterState:
        """Return a copy of the filter."""
        return FilterState(*(array.copy() for array in self))


class Measurements(NamedTuple):
    """Input of a call of the filter.

    imu : (n,) IMU_SAMPLE. tdoa : (k,) TDOA. sensors : (m,) SENSOR_ROW.
    """

    imu: np.ndarray
    tdoa: np.ndarray
    sensors: np.ndarray = np.empty(0, SENSOR_ROW)


class Output(NamedTuple):
    """Room for the results of a call of the filter.

    odometry : at least (n + k + m,) ODOMETRY. residuals : (k,) RESIDUAL, of TDOAs. history :
    RECORD, with room for engine.most_records, or empty for no recording. sensors : (m,) RESIDUAL.
    """

    odometry: np.ndarray
    residuals: np.ndarray
    history: np.ndarray
    sensors: np.ndarray = np.empty(0, RESIDUAL)


# Stamps of an EKF without measurements that are -inf.
NEVER = (
    "shaken",
    "t",
    "first_tdoa",
    "last_tdoa",
    "next_search",
    "next_odometry",
    "next_rest",
    "next_merge",
    "next_look",
    "next_workspace",
    "next_floor",
    "relocated",
    "recovered",
    "last_agreement",
    "position_unknown_until",
    "search_waits_until",
    "rival_since",
    "rival_until",
    "attitude_averaged_until",
)


def new_state(
    positions: np.ndarray, functions: Sequence[SensorFunction] = (), floor: Floor | None = None
) -> FilterState:
    """Return the FilterState of a filter without measurements.

    Parameters
    ----------
    positions : (N, 3) array
        Positions of the anchors, m, world frame.
    functions : sequence of SensorFunction
        Known errors of the inertial sensor.
    floor : tuple, optional
        Known lateness of anchors at the ground, as in `EffectSet.on_floor`.
    """
    state = FilterState(np.zeros(1, EKF), np.zeros(len(positions), ANCHOR), rows_of(functions))
    ekf, anchors = state.record, state.anchors
    for record, stamps in (
        (ekf, NEVER),
        (anchors, ("learned", "predicted", "heard")),
        (ekf.imu, ("t",)),
        (ekf.imu_fault_detector, ("contradicted",)),
        (ekf.height, ("heard", "changed", "used", "compared", "pulls_since", "ignored_until")),
        (ekf.barometer, ("heard", "agreed")),
        (ekf.velocity, ("heard", "changed", "agreed", "path_until", "confirmed", "next_look")),
        (ekf.ranged, ("t",)),
        (ekf.yaw_test, ("next_look", "opened")),
    ):
        for stamp in stamps:
            record[stamp] = -np.inf
    anchors["position"] = positions
    ekf.extent[:] = np.min(positions, axis=0), np.max(positions, axis=0)
    ekf.within[:] = [[-np.inf] * 3, [np.inf] * 3]
    delays, stds, place = floor or (np.nan, 0.0, np.nan)
    anchors["floor_delay"], anchors["floor_std"], ekf.floor_place[:] = delays, stds, place
    for name in ("accel", "slow_accel", "mean_accel"):
        ekf.imu[name][2] = GRAVITY
    ekf.hypotheses["log_weight"][1:] = -np.inf
    ekf.hypotheses["x"][:, 9] = 1.0
    ekf.hypotheses["P"][:] = np.eye(ERROR_STATES)
    ekf.since_record[:] = np.eye(ERROR_STATES)
    ekf.consistency, ekf.range_offset[1] = 1.0, np.inf
    ekf.noise_ratio = ekf.motion_ratio = ekf.squared = 1.0
    ekf.persistent, ekf.first_best = noise.SHARE, -1
    return state


def structured(kind: np.dtype, *columns: Any) -> np.ndarray:
    """Return an (n,) array of a record type, from an array for each field in order.

    Fields at the end without an array are 0.
    """
    out = np.zeros(len(columns[0]), kind)
    for name, column in zip(kind.names or (), columns):
        out[name] = column
    return out


def joined(kind: np.dtype, parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the concatenation of several arrays of the same record type.

    np.concatenate would determine the common type again for each array.
    """
    if len(parts) == 1:
        return parts[0]
    out, first = np.empty(sum(map(len, parts)), kind), 0
    for part in parts:
        out[first : first + len(part)] = part
        first += len(part)
    return out


def imu_rows(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inertial samples as rows of IMU_SAMPLE, and which samples are usable.

    Parameters
    ----------
    t : (n,) array
        Stamps, s.
    gyro : (n, 3) array
        Angular rate, rad/s, body frame.
    accel : (n, 3) array
        Specific force, m/s^2, body frame.

    Returns
    -------
    tuple
        (n,) IMU_SAMPLE, and (n,) bool.
    """
    rows = structured(IMU_SAMPLE, t, gyro, accel)
    return rows, _usable_imu(rows)


@compiled
def usable_tdoas(rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which TDOAs can be measurements.

    These are refused: an unknown anchor (row -1), a pair of equal anchors, a value or stamp that is
    not finite, a value longer than the baseline plus LARGEST_ERROR, an invalid variance, and an
    implausible slope of the bias or state at which it holds.

    Parameters
    ----------
    rows : (n,) TDOA
        TDOAs.
    positions : (N, 3) array
        Positions of the anchors, m, world frame.
    """
    out = np.empty(len(rows), np.bool_)
    for i in range(len(rows)):
        tdoa = rows[i]
        a, b, d = tdoa.a, tdoa.b, tdoa.d
        usable = a >= 0 and b >= 0 and a != b and math.isfinite(tdoa.t) and math.isfinite(d)
        if usable:
            squared_baseline = 0.0
            for k in range(3):
                squared_baseline += (positions[a, k] - positions[b, k]) ** 2
            longest = math.sqrt(squared_baseline) + LARGEST_ERROR
            usable = abs(d) <= longest and 0.0 <= tdoa.variance < math.inf
        for k in range(N_STATES):  # NaN compares false
            usable = usable and abs(tdoa.slope[k]) < STEEPEST and abs(tdoa.state[k]) < FARTHEST
        out[i] = usable
    return out


def sensor_rows(
    name: str, stream: Stream, anchors: Anchors | AnchorTable
) -> tuple[np.ndarray, np.ndarray]:
    """Return the measurements of a sensor as rows of SENSOR_ROW, and which are usable.

    Parameters
    ----------
    name : str
        Name of the sensor in SENSORS.
    stream : Stream
        Measurements of the sensor.
    anchors : Anchors or AnchorTable
        Gives the rows of anchor ids.

    Returns
    -------
    tuple
        (n,) SENSOR_ROW, and (n,) bool.
    """
    columns, usable = SENSORS[name].rows(stream)
    rows = np.zeros(len(stream), SENSOR_ROW)
    rows["t"], rows["kind"] = stream.t, list(SENSORS).index(name)
    if "anchor" in columns:
        columns["anchor"] = anchors.index(columns["anchor"])
        usable &= columns["anchor"] >= 0
    for field, values in columns.items():
        target = rows[field]
        target[(slice(None), *map(slice, values.shape[1:]))] = values
    return rows, usable & np.isfinite(stream.t)


@compiled
def _usable_imu(rows: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which of (n,) IMU_SAMPLE are finite and within the range of any sensor."""
    out = np.empty(len(rows), np.bool_)
    for i in range(len(rows)):
        sample = rows[i]
        out[i] = math.isfinite(sample.t)
        for k in range(3):  # NaN compares false
            out[i] = out[i] and abs(sample.gyro[k]) < MAX_RATE and abs(sample.accel[k]) < MAX_ACCEL
    return out
