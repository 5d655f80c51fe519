"""The whole path on a recording, without ROS: what the two nodes give, in one call."""

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.corrector import Corrector

from .config import FilterConfig
from .engine import INVALID, RECOVERIES, new_memory, run
from .estimator import VERDICTS, Odometry, Residuals
from .validity import usable_all, usable_imu


@dataclass(frozen=True)
class Run:
    """Result of one recording. odometry : Odometry; residuals : Residuals, one per TDOA of the flight, in its order;
    bias, bias_std : (n,) m, what was taken from each raw TDOA; recoveries : how often the filter lost and found the tag."""

    odometry: Odometry
    residuals: Residuals
    bias: np.ndarray
    bias_std: np.ndarray
    recoveries: int

    @property
    def counts(self):
        """TDOAs by verdict."""
        return {name: int(np.sum(self.residuals.verdict == value)) for value, name in VERDICTS.items()}


def run_offline(flight, config=None, corrector=None):
    """Run a Flight through bias correction and filter.

    flight : Flight; config : FilterConfig; corrector : Corrector that has seen no pose, or None for no correction.
    Returns a Run. A measurement uses only what was stamped before it, as on line.
    """
    config = config or FilterConfig()
    corrector = corrector or Corrector(flight.anchors)
    tdoa, imu, positions = flight.tdoa, flight.imu, flight.anchors.positions
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    n, empty = len(tdoa), np.empty((0, 3))
    imu_t, gyro, force = (empty[:, 0].copy(), empty, empty)
    if imu is not None and config.use_imu:
        sane = usable_imu(imu.gyro, imu.accel) & np.isfinite(imu.t)
        imu_t, gyro, force = (np.ascontiguousarray(column[sane], dtype=float) for column in (imu.t, imu.gyro, imu.accel))
    bias, std, corrected, outcome = np.zeros(n), np.zeros(n), tdoa.d.copy(), np.full((n, 4), np.nan)
    outcome[:, 2], outcome[:, 3] = 0.0, INVALID
    valid = np.flatnonzero(usable_all(a, b, tdoa.d, std, positions) & np.isfinite(tdoa.t))
    valid = valid[np.lexsort((tdoa.d[valid], b[valid], a[valid], tdoa.t[valid]))]  # siblings of one stamp as on line
    memory, tuning = new_memory(), config.tuning()
    rows, covariances = [], []

    # Corrections need poses that are `lag` old: measurements less than that apart can be corrected as one batch.
    starts = [0]
    while not corrector.idle and starts[-1] < len(valid):
        starts.append(int(np.searchsorted(tdoa.t[valid], tdoa.t[valid[starts[-1]]] + corrector.lag)))
    ends = starts[1:] or [len(valid)]
    fed = 0
    for first, end in zip(starts, ends):
        batch = valid[first:end]
        until = len(imu_t) if end == len(valid) else int(np.searchsorted(imu_t, tdoa.t[valid[end]]))
        correction = corrector.correct(tdoa.t[batch], a[batch], b[batch], tdoa.d[batch])
        bias[batch], std[batch], corrected[batch] = correction.bias, correction.std, correction.corrected
        capacity = len(batch) + until - fed
        row, covariance, result = np.empty((capacity, 17)), np.empty((capacity, 9, 9)), np.empty((len(batch), 4))
        count = run(
            memory, tuning, positions, imu_t[fed:until], gyro[fed:until], force[fed:until],
            tdoa.t[batch], a[batch], b[batch], corrected[batch], std[batch], row, covariance, result,
        )  # fmt: skip
        fed = until
        outcome[batch] = result
        rows.append(row[:count])
        covariances.append(covariance[:count])
        if not corrector.idle:
            for t, p, q in zip(row[:count, 0], row[:count, 1:4], row[:count, 7:11]):
                corrector.add_pose(t, p, q)
    odometry = Odometry.from_rows(np.concatenate(rows), np.concatenate(covariances))
    residuals = Residuals(
        tdoa.t, tdoa.a, tdoa.b, outcome[:, 0], outcome[:, 1], outcome[:, 2], outcome[:, 3].astype(np.uint8)
    )
    return Run(odometry, residuals, bias, std, int(memory.clock[RECOVERIES]))
