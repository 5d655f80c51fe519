"""The whole path on a recording, without ROS: what the two nodes give, in one call."""

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.poses import told_yaw_std

from .core.config import FilterConfig
from .core.engine import INVALID, run
from .estimator import VERDICTS, Odometry, Residuals
from .frames import rotation_std
from .core.hypotheses import quarter
from .core.memory import BEST, RECOVERIES, TAPED, new_memory
from .core.tape import new_tape
from .core.validity import usable_all, usable_imu


@dataclass(frozen=True)
class Run:
    """Result of one recording. odometry : Odometry; residuals : Residuals, one per TDOA of the flight, in its order;
    bias, bias_std : (n,) m, what was taken from each raw TDOA; recoveries : how often the filter lost and found the tag;
    turned : rad, from initial_yaw to the start of the yaw hypothesis that was right; taped : entries on the tape."""

    odometry: Odometry
    residuals: Residuals
    bias: np.ndarray
    bias_std: np.ndarray
    recoveries: int
    turned: float
    taped: int

    @property
    def counts(self):
        """TDOAs by verdict."""
        return {name: int(np.sum(self.residuals.verdict == value)) for value, name in VERDICTS.items()}


def run_offline(flight, config=None, corrector=None, tape=None):
    """Run a Flight through bias correction and filter.

    flight : Flight; config : FilterConfig; corrector : Corrector, whose poses are forgotten first, or None for no
    correction; tape : Tape to record the run on, or None. Returns a Run. A measurement uses only what was stamped before
    it, as on line.
    """
    config = config or FilterConfig()
    corrector = corrector or Corrector(flight.anchors)
    corrector.reset()
    tape = new_tape() if tape is None else tape
    flight = corrector.effects.correct_streams(flight)
    tdoa, imu, positions = flight.tdoa, flight.imu, flight.anchors.positions
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    n, empty = len(tdoa), np.empty((0, 3))
    imu_t, gyro, force = (empty[:, 0].copy(), empty, empty)
    if imu is not None and config.use_imu:
        sane = usable_imu(imu.gyro, imu.accel) & np.isfinite(imu.t)
        imu_t, gyro, force = (np.ascontiguousarray(column[sane], dtype=float) for column in (imu.t, imu.gyro, imu.accel))
    bias, std, corrected, outcome = np.zeros(n), np.zeros(n), tdoa.d.copy(), np.full((n, 4), np.nan)
    outcome[:, 2], outcome[:, 3] = 0.0, INVALID
    known = np.flatnonzero((a >= 0) & (b >= 0) & np.isfinite(tdoa.d) & np.isfinite(tdoa.t))
    known = known[np.lexsort((tdoa.d[known], b[known], a[known], tdoa.t[known]))]  # siblings of one stamp as on line
    memory, tuning = new_memory(len(flight.anchors)), config.tuning()
    rows, covariances = [], []

    # Corrections need poses that are `lag` old: measurements less than that apart can be corrected as one batch.
    starts = [0]
    while not corrector.idle and starts[-1] < len(known):
        starts.append(int(np.searchsorted(tdoa.t[known], tdoa.t[known[starts[-1]]] + corrector.lag)))
    ends = starts[1:] or [len(known)]
    fed = 0
    for first, end in zip(starts, ends):
        batch = known[first:end]
        until = len(imu_t) if end == len(known) else int(np.searchsorted(imu_t, tdoa.t[known[end]]))
        correction = corrector.correct(tdoa.t[batch], a[batch], b[batch], tdoa.d[batch])
        bias[batch], std[batch], corrected[batch] = correction.bias, correction.std, correction.corrected
        batch = batch[usable_all(a[batch], b[batch], corrected[batch], std[batch], positions)]
        capacity = len(batch) + until - fed
        row, covariance, result = np.empty((capacity, 17)), np.empty((capacity, 9, 9)), np.empty((len(batch), 4))
        count = run(
            memory, tuning, positions, imu_t[fed:until], gyro[fed:until], force[fed:until],
            tdoa.t[batch], a[batch], b[batch], corrected[batch], std[batch], row, covariance, result, tape,
        )  # fmt: skip
        fed = until
        outcome[batch] = result
        rows.append(row[:count])
        covariances.append(covariance[:count])
        if not corrector.idle and count:
            q = row[:count, 7:11]
            certain = told_yaw_std(rotation_std(q, covariance[:count]))
            corrector.add_pose(row[:count, 0], row[:count, 1:4], q, certain)
    odometry = Odometry.from_rows(np.concatenate(rows), np.concatenate(covariances))
    residuals = Residuals(
        tdoa.t, tdoa.a, tdoa.b, outcome[:, 0], outcome[:, 1], outcome[:, 2], outcome[:, 3].astype(np.uint8)
    )
    clock = memory.clock
    return Run(
        odometry, residuals, bias, std, int(clock[RECOVERIES]), quarter(int(clock[BEST])), int(clock[TAPED])
    )
