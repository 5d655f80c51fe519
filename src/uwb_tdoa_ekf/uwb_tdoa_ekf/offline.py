"""The whole path on a recording, without ROS: what the two nodes give, in one call."""

from dataclasses import dataclass
import math

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.poses import known_yaw_std

from .aid_rows import rows_of
from .core.config import FilterConfig
from .core.engine import feed
from .core.hypotheses import yaw_offset
from .core.memory import IMU_SAMPLE, ODOMETRY, RESIDUAL, TDOA, Measurements, joined, new_memory, structured
from .core.validity import usable_all, usable_imu, usable_slopes
from .core.verdicts import INVALID
from .estimator import VERDICTS, Odometry, Residuals
from .frames import rotation_std
from .monitoring.monitor import Monitor
from .monitoring.slices import LENGTH

RECORDED_AT_ONCE = 256  # TDOAs that are fed together while a history is recorded: its room is for the worst case


@dataclass(frozen=True)
class Run:
    """Result of one recording. odometry : Odometry; residuals : Residuals, one per TDOA of the flight, in its order;
    bias, bias_std : (n,) m, what was taken from each raw TDOA; recoveries : how often the filter lost and found the
    tag; yaw_offset : rad, from initial_yaw to the start of the yaw hypothesis that was right; aids : {stream: (m,) of
    RESIDUAL, one per measurement}, for those of the SENSORS that the flight has."""

    odometry: Odometry
    residuals: Residuals
    bias: np.ndarray
    bias_std: np.ndarray
    recoveries: int
    yaw_offset: float
    aids: dict

    @property
    def counts(self):
        """TDOAs by verdict."""
        return {name: int(np.sum(self.residuals.verdict == value)) for value, name in VERDICTS.items()}


def run_offline(flight, config=None, corrector=None, records=None):
    """Run a Flight through bias correction and filter.

    flight : Flight; config : FilterConfig; corrector : Corrector, whose poses are forgotten first, or None for no
    correction; records : list to which the history of the run is appended (see engine.feed), or None. Returns a Run. A
    measurement uses only what was stamped before it, as on line.
    """
    config = config or FilterConfig()
    corrector = corrector or Corrector(flight.anchors)
    corrector.reset()
    flight = corrector.effects.correct_streams(flight)
    tdoa, positions = flight.tdoa, flight.anchors.positions
    raw = tdoa.t, flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b), tdoa.d
    imu = _imu_samples(flight.imu if config.use_imu else None)
    imu_t = imu["t"].copy()  # side by side in memory, to be searched
    (aids, places), outcome_of_aids = rows_of(flight, config), []
    memory, tuning = new_memory(positions, corrector.effects.sensor_functions, corrector.weighed.on_floor(flight.anchors)), config.tuning()
    bias, std, outcome, parts, fed, felt = np.zeros(len(tdoa)), np.zeros(len(tdoa)), _not_fed(len(tdoa)), [], 0, 0
    monitor = Monitor(flight.anchors) if config.compensate_changes else None
    at_once = RECORDED_AT_ONCE if records is not None else len(tdoa)
    for batch, until in _batches(*raw, corrector, at_once, LENGTH if monitor else math.inf):
        t, a, b, d = (column[batch] for column in raw)
        correction = corrector.correct(t, a, b, d)
        bias[batch], std[batch] = correction.bias, correction.std
        variance = correction.std**2 + tdoa.variance[batch]
        sane = usable_all(a, b, correction.corrected, variance, positions) & usable_slopes(correction.slope, correction.state)
        corrected = structured(TDOA, t, a, b, correction.corrected, variance, correction.slope, correction.state)[sane]
        last = len(imu) if until is None else int(np.searchsorted(imu_t, until))
        last_aid = len(aids) if until is None else int(np.searchsorted(aids["t"], until))
        measured = Measurements(imu[fed:last], corrected, aids[felt:last_aid])
        odometry, outcome[batch[sane]], of_aids = feed(memory, tuning, measured, records)
        fed, felt = last, last_aid
        outcome_of_aids.append(of_aids)
        parts.append(odometry)
        if monitor:
            became = outcome[batch]
            of_batch = Residuals(t, tdoa.a[batch], tdoa.b[batch], *(became[name] for name in RESIDUAL.names))
            monitor.add(Odometry.from_rows(odometry), of_batch)
            monitor.judge(math.inf if until is None else until)
            memory.anchors["delay"], memory.anchors["delay_variance"] = monitor.delays
        if not corrector.idle and len(odometry):
            corrector.add_pose(*poses_of(Odometry.from_rows(odometry)))
    residuals = Residuals(tdoa.t, tdoa.a, tdoa.b, *(outcome[name] for name in RESIDUAL.names))
    of_aids = np.concatenate([*outcome_of_aids, _not_fed(1)])  # the last one for those that could not be fed
    of_aids = {stream: of_aids[place] for stream, place in places.items()}
    ekf, odometry = memory.record, Odometry.from_rows(joined(ODOMETRY, parts))
    return Run(odometry, residuals, bias, std, int(ekf.recoveries), yaw_offset(int(ekf.best)), of_aids)


def _imu_samples(imu):
    """(n,) of IMU_SAMPLE, those that can be measurements; of an Imu, or None."""
    if imu is None:
        return np.empty(0, IMU_SAMPLE)
    sane = usable_imu(imu.t, imu.gyro, imu.accel)
    return structured(IMU_SAMPLE, imu.t[sane], imu.gyro[sane], imu.accel[sane])


def _not_fed(n):
    outcome = np.zeros(n, RESIDUAL)
    outcome["innovation"] = outcome["variance"] = np.nan
    outcome["verdict"] = INVALID
    return outcome


def _batches(t, a, b, d, corrector, longest, period):
    """What can be corrected and fed together, at most `longest` TDOAs, within one `period`, s, of stamps: [(their places,
    in the order of their stamps, and the stamp of the next one, or None)], at least one.

    Corrections need poses that are `lag` old: measurements less than that apart can be corrected as one batch.
    """
    known = np.flatnonzero((a >= 0) & (b >= 0) & np.isfinite(d) & np.isfinite(t))
    known = known[np.lexsort((d[known], b[known], a[known], t[known]))]  # siblings of one stamp as on line
    stamps, first, batches = t[known], 0, []
    while first < len(known):
        end = len(known) if corrector.idle else int(np.searchsorted(stamps, stamps[first] + corrector.lag))
        if period < math.inf:
            end = min(end, int(np.searchsorted(stamps, (math.floor(stamps[first] / period) + 1.0) * period)))
        end = min(end, first + longest)
        batches.append((known[first:end], stamps[end] if end < len(known) else None))
        first = end
    return batches or [(known, None)]


def poses_of(odometry):
    """What a Corrector takes of an Odometry, as bias_node gets it: (t (n,) s, p (n, 3) m, q (n, 4), v (n, 3) m/s, yaw_std
    (n,) rad)."""
    return odometry.t, odometry.p, odometry.q, odometry.v, known_yaw_std(rotation_std(odometry.q, odometry.covariance))
