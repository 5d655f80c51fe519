"""Everything one filter remembers between two events, by name. A copy of its arrays is a copy of
the filter.

The types are rows of numpy's structured arrays: compiled code reads and writes
`ekf.imu.slow_accel[k]` where it lies in memory, a function takes a whole record as one pointer, and
Python sees the same bytes (`FilterState.record`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import Record
from uwb_tdoa_bias.effects.samples import N_STATES

from .auxiliary import OFFSET_STATES
from .ground import MOST_PAIRS, PAIR
from .sensor_functions import rows_of
from .state import ERROR_STATES, GRAVITY, NOMINAL_STATES, TRANSITION
from .update import INNOVATION

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects.base import SensorFunction


USED, REJECTED, LATE, INVALID, STARTUP, COMPENSATED, REPEATED = range(7)


# directions and places that a start follows at once while it is not known which is right
N_YAWS, N_PLACES = (4, 2)
HYPOTHESES = N_YAWS * N_PLACES
Floor = tuple[np.ndarray, np.ndarray, np.ndarray]  # as of EffectSet.on_floor
WINDOW = 512  # TDOAs kept for a start


def _record(*columns: tuple[Any, ...]) -> np.dtype:
    return np.dtype(list(columns), align=True)


# What is measured. Rows of an anchor, not ids; both in the order of their stamps.
# s, rad/s, m/s^2 (specific force); body
IMU_SAMPLE = _record(("t", float), ("gyro", float, 3), ("accel", float, 3))
TDOA = _record(
    ("t", float),
    ("a", int),
    ("b", int),
    ("d", float),
    ("variance", float),  # s, rows, m (corrected), m^2 (beyond tdoa_std)
    ("slope", float, N_STATES),
    # of the bias taken out, with position and velocity, about a state; m, m/s
    ("state", float, N_STATES),
)
# see aids.py
AID = _record(("t", float), ("kind", int), ("value", float, 4), ("std", float, 4), ("anchor", int))

# One estimate of the state, for one direction that the tag may have started in.
HYPOTHESIS = _record(
    ("log_weight", float),  # log probability relative to the best; -inf: pruned
    ("x", float, NOMINAL_STATES),  # see state.py
    ("P", float, (ERROR_STATES, ERROR_STATES)),  # symmetric to the bit
    ("offset", float, OFFSET_STATES),  # m and m/s, auxiliary states, see auxiliary.py;
    ("offset_cross", float, (OFFSET_STATES, ERROR_STATES)),  # covariance with the error state, and
    ("offset_P", float, (OFFSET_STATES, OFFSET_STATES)),  # their own; 0: there is none
)

# What is known of the inertial sensor.
IMU_STATE = _record(
    ("t", float),  # s, stamp of the last sample
    ("gyro", float, 3),  # rad/s and
    ("accel", float, 3),  # m/s^2, held until the next sample: input of the prediction
    ("slow_accel", float, 3),  # m/s^2, low pass
    ("vibration", float, 3),  # m^2/s^4, power of what is faster
    ("mean_accel", float, 3),  # m/s^2, over a longer time
    # 0 to 1: power of what of it does not hover, lately, beside that of the vibration
    ("rectified", float, 3),
    ("gyro_power", float, 3),  # rad^2/s^2
    ("accel_weight", float, 3),  # of the measurement against hovering, 0 to 1, by inertial.weigh
    ("accel_psd", float, 3),  # (m/s^2)^2/Hz, of the noise that this leaves
)

# Whether an inertial sensor can be right, see imu_fault_detector.py.
IMU_FAULT_DETECTOR = _record(
    ("up", float, 3),  # m/s^2, specific force as the gyroscope has turned it
    ("spun", float),  # rad, turned lately beyond what a tag may
    ("weighed", float),  # s, stamps: of the last sample in which it bore the tag,
    ("upright", float),  # in which the tag did not lie on its side,
    ("contradicted", float),  # and at which something was impossible;
    ("reason", int),  # what,
    ("size", float),  # and how large
)

# A pose that is given from outside. NaN for what is not.
POSE = _record(
    ("t", float),  # s
    ("p", float, 3),  # m, of the body in the world,
    ("covariance", float, (3, 3)),  # m^2, and its covariance
    ("yaw", float),  # rad,
    ("yaw_std", float),  # rad, and its standard deviation
)

# What is known of an anchor.
ANCHOR = _record(
    ("position", float, 3),  # m
    ("excess_variance", float),  # m^2, of what is received of it beyond tdoa_std, see noise.py
    ("learned", float),  # s, stamp of the last change
    ("heard", float),  # s, stamp of the last TDOA that was used
    ("delay", float),  # m, that it is found to have since it changed in flight,
    ("delay_variance", float),  # and its variance, m^2;
    # probability that it is late because tag and anchor are near the ground, see ground.py, 0: it
    # cannot be,
    ("late", float),
    ("predicted", float),  # s, stamp to which that was predicted;
    ("floor_delay", float),  # m, by which it was late at a tag on the ground, NaN: nobody knows,
    ("floor_std", float),  # m, and its standard deviation
)

HEIGHT = _record(
    ("range", float),  # m, the last that was received,
    ("heard", float),  # s, its stamp,
    ("changed", float),  # that of the last one that differed from the one before,
    ("used", float),  # and of the last one that was used
    ("level", float),  # m, of the ground below
    ("agreed", float),  # s for which the range finder has agreed with the filter
    ("disagreeing", int),  # ranges in a row that do not, but with each other,
    ("disagreement", float),  # m, their mean innovation,
    ("disagrees_since", float),  # s, and the stamp of the first
    ("pull", float),  # m and 1, what the TDOAs of late say of z, see height.update_pull,
    ("pull_information", float),
    ("compared", float),  # s, stamps: of the last of them,
    ("pulls_since", float),  # and since when they disagree
    ("ignored_until", float),  # s, stamp until which no range is used, and
    ("ignore_time", float),  # s, for how long
)

BAROMETER = _record(
    ("heard", float),  # s, stamps: of the last altitude,
    ("agreed", float),  # and of the last one that was used
    ("nis", float),  # mean normalised innovation squared of late, on the scale that is reported
)

VELOCITY = _record(
    ("heard", float),  # s, stamps: of the last one,
    ("changed", float),  # and of the last one that differed from the one before;
    ("value", float, 4),  # m/s and rad/s, the last one
    ("nis", float),  # mean normalised innovation squared of late, of the worst component
    ("refused", bool),  # it disagrees with everything else
    ("agreed", float),  # s, stamp of the last one of wheels that was used,
    ("yaw_rate", float),  # rad/s, its yaw rate,
    ("yaw_rate_variance", float),  # rad^2/s^2, the variance of that,
    ("speed_variance", float),  # and m^2/s^2, that of its velocity
)

YAW_TEST = _record(
    # of the error state to cos(psi) - 1 and sin(psi), for a yaw that is wrong by psi
    ("response", float, (2, ERROR_STATES)),
    ("vector", float, 2),  # of the least squares of late innovations by these two,
    ("information", float, (2, 2)),  # and the upper triangle of its matrix
    ("turned", float),  # rad, by which updates have turned the yaw of late,
    ("variance", float),  # rad^2, and the largest variance that it had
    ("alone", bool),  # one hypothesis is followed
    ("evidence", float),  # at the last look,
    ("t", float),  # s, stamps: of the last look,
    ("next_look", float),  # and before which not to look again
    ("count", int),  # how often the yaw was opened again
)

EKF = _record(
    ("t", float),  # s, stamp of the hypotheses
    ("running", bool),
    ("best", int),  # the most probable hypothesis
    ("hypotheses", HYPOTHESIS, HYPOTHESES),
    ("imu", IMU_STATE),
    ("height", HEIGHT),
    ("barometer", BAROMETER),
    ("velocity", VELOCITY),
    ("ranged", AID, 1),  # the last distance to an anchor
    # m, of all distances, when it was known best, and its variance, m^2; inf: it was not looked for
    ("range_offset", float, 2),
    ("next_floor", float),  # s, stamp before which not to hold the tag on its floor again
    ("sensed", bool),  # inertial samples drive the prediction
    # m, another place that late TDOAs agree on, and the motion that sensors feel does not lead to;
    ("rival", float, 3),
    ("rival_since", float),  # s, stamps: since when they do,
    ("rival_until", float),  # and until when the tag may be there
    ("imu_fault_detector", IMU_FAULT_DETECTOR),  # of the inertial samples,
    ("imu_faulty", bool),  # which are not used, because they cannot be right
    ("yaw_test", YAW_TEST),  # see yaw_test.py
    # s, stamp until which they are averaged, where the filter ran before there were any; -inf: they
    # are used
    ("attitude_averaged_until", float),
    ("quiet", bool),  # the inertial sensor neither shakes nor turns
    ("resting", bool),  # the tag does not move, see stationarity.py,
    # m, x and y of where anchors are known to be late on the ground, NaN: anywhere,
    ("floor_place", float, 2),
    ("late_as_known", bool),  # and they are, where the tag came to rest last
    ("rest_since", float),  # s, stamps: since when,
    ("next_look", float),  # and before which not to look again,
    # looks in a row in which its TDOAs have changed, and in which it was not known to rest
    ("doubts", int),
    ("stills", int),  # but neither TDOAs nor inertial samples showed that it moves,
    # m^2/s^4, power of the vibration of a tag that is not at rest, over some seconds
    ("shaking", float),
    ("lift", float, 3),  # m/s, that the inertial sensor has felt lately at rest, in the world
    # s, stamp at which the inertial sensor was sound and TDOAs agreed with the filter last
    ("last_agreement", float),
    ("extent", float, (2, 3)),  # m, lower and upper bounds: of all anchors,
    ("within", float, (2, 3)),  # of the reach of those that were heard lately,
    ("workspace", float, (2, 3)),  # and of where the tag is expected, see workspace.py
    ("side", float, 3),  # on which the tag is of anchors in a plane, see workspace.configured_side
    # 1.0 for axes along which these are at one coordinate, while it is not known on which side of
    # that the tag is
    ("flat", float, 3),
    ("middle", float, 3),  # m, of the anchors heard lately
    ("next_bounds", float),  # s, stamp before which not to look anew who is heard
    # 1/m^2, of the place, that one arrival from each anchor heard lately gives, see noise.py
    ("information", float, (3, 3)),
    # s, stamp until which the tag may be anywhere, as its place was hardly known before
    ("position_unknown_until", float),
    ("search_waits_until", float),  # s, stamp until which its TDOAs wait for a search
    ("consistency", float),  # share of the latest TDOAs that agree with the best hypothesis
    ("recoveries", int),
    # s, stamps: of the first TDOA since the filter stopped, and the last one
    ("first_tdoa", float),
    ("last_tdoa", float),
    ("next_search", float),  # s, stamps before which not to do again: look for the tag,
    ("next_odometry", float),
    ("next_rest", float),  # say that a quiet tag stands still,
    ("next_merge", float),  # compare hypotheses
    ("kept", int),  # TDOAs in the window
    ("window", TDOA, 2 * WINDOW),  # recent TDOAs, oldest first
    ("recorded", int),  # records written to the history, see history.py
    # transition of the best hypothesis since the last record
    ("since_record", float, (ERROR_STATES, ERROR_STATES)),
    # Scratch: nothing below outlives an event.
    ("transition", TRANSITION),
    ("innovation", INNOVATION),
    ("paired", TDOA, 1),
    ("pairs", PAIR, MOST_PAIRS),
    ("still_covariance", float, (3, 3)),
)
EKF = np.dtype((np.record, EKF))  # whose fields Python reads as attributes

# What comes out.
ODOMETRY = _record(
    ("t", float),
    ("x", float, NOMINAL_STATES),
    ("covariance", float, (9, 9)),  # of [p, v, attitude]
    # what of it errors that persist make, see noise.py
    ("consider_covariance", float, (3, 3)),
)
RESIDUAL = _record(
    ("innovation", float), ("variance", float), ("weight", float), ("verdict", np.uint8)
)


class FilterState(NamedTuple):
    """State of one filter. ekf : (1,) of EKF; anchors : (N,) of ANCHOR; functions : (k,) of
    SENSOR_FUNCTION, errors of the inertial sensor that are known.
    """

    ekf: np.ndarray
    anchors: np.ndarray
    functions: np.ndarray

    @property
    def record(self) -> Record:
        """The fields of EKF as attributes: a view."""
        return self.ekf[0]

    def copy(self) -> FilterState:
        """Another filter that remembers the same."""
        return FilterState(*(array.copy() for array in self))


class Measurements(NamedTuple):
    """What a filter is fed with at once. imu : (n,) of IMU_SAMPLE; tdoa : (k,) of TDOA; aids : (m,)
    of AID.
    """

    imu: np.ndarray
    tdoa: np.ndarray
    aids: np.ndarray = np.empty(0, AID)


class Output(NamedTuple):
    """Room for what it makes of that. odometry : at least (n + k + m,) of ODOMETRY; residuals :
    (k,) of RESIDUAL;
    history : of history.RECORD, with room for engine.most_records, or empty for no recording; aids
        : (m,) of RESIDUAL.
    """

    odometry: np.ndarray
    residuals: np.ndarray
    history: np.ndarray
    aids: np.ndarray = np.empty(0, RESIDUAL)


def new_state(
    positions: np.ndarray, functions: Sequence[SensorFunction] = (), floor: Floor | None = None
) -> FilterState:
    """FilterState of a filter that has seen nothing; positions : (N, 3) m, of the anchors;
    functions : SensorFunctions; floor : as of `EffectSet.on_floor`.
    """
    state = FilterState(np.zeros(1, EKF), np.zeros(len(positions), ANCHOR), rows_of(functions))
    state.anchors["position"] = positions
    state.record.extent[:] = np.min(positions, axis=0), np.max(positions, axis=0)
    state.record.within[:] = [[-np.inf] * 3, [np.inf] * 3]
    for stamp in ("learned", "predicted", "heard"):
        state.anchors[stamp] = -np.inf
    ekf = state.record
    state.anchors["floor_delay"], state.anchors["floor_std"], ekf["floor_place"][:] = floor or (
        np.nan,
        0.0,
        np.nan,
    )
    for stamp in (
        "t",
        "first_tdoa",
        "last_tdoa",
        "next_search",
        "next_odometry",
        "next_rest",
        "next_merge",
        "next_look",
        "next_bounds",
        "last_agreement",
        "position_unknown_until",
        "search_waits_until",
        "rival_since",
        "rival_until",
    ):
        ekf[stamp] = -np.inf
    ekf.imu.t = ekf.imu_fault_detector.contradicted = -np.inf
    for stamp in ("heard", "changed", "used", "compared", "pulls_since", "ignored_until"):
        ekf.height[stamp] = -np.inf
    for stamp in ("heard", "changed", "agreed"):
        ekf.velocity[stamp] = -np.inf
    ekf.barometer.heard = ekf.barometer.agreed = ekf.ranged["t"][0] = ekf.next_floor = -np.inf
    for name in ("accel", "slow_accel", "mean_accel"):
        ekf.imu[name][2] = GRAVITY
    ekf.hypotheses["log_weight"][1:] = -np.inf
    ekf.hypotheses["x"][:, 9] = 1.0
    ekf.hypotheses["P"][:] = np.eye(ERROR_STATES)
    ekf.since_record[:] = np.eye(ERROR_STATES)
    ekf.consistency, ekf.range_offset[1] = 1.0, np.inf
    ekf.attitude_averaged_until = ekf.yaw_test.t = ekf.yaw_test.next_look = -np.inf
    return state


def structured(kind: np.dtype, *columns: Any) -> np.ndarray:
    """(n,) array of a type of this module; columns : one array for each of its fields, in their
    order; of the last ones that are not given, 0.
    """
    out = np.zeros(len(columns[0]), kind)
    for name, column in zip(kind.names or (), columns):
        out[name] = column
    return out


def joined(kind: np.dtype, parts: Sequence[np.ndarray]) -> np.ndarray:
    """(n,) array of a type of this module, of several one after the other; numpy finds out anew for
    each what the type of all is.
    """
    if len(parts) == 1:
        return parts[0]
    out, first = np.empty(sum(map(len, parts)), kind), 0
    for part in parts:
        out[first : first + len(part)] = part
        first += len(part)
    return out
