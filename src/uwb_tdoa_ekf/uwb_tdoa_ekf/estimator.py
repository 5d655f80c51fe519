"""The filter for live streams: messages in any order in, odometry that depends on their stamps alone out."""

from bisect import bisect_right, insort
from dataclasses import dataclass
import math

import numpy as np

from .config import FilterConfig
from .engine import INVALID, LATE, REJECTED, STARTUP, USED, run
from .memory import RECOVERIES, RUNNING, new_memory
from .tape import new_tape
from .validity import MAX_FORCE, MAX_RATE, usable

VERDICTS = {USED: "used", REJECTED: "rejected", LATE: "late", INVALID: "invalid", STARTUP: "startup"}
TIME_JUMP = 1.0  # s; a stream that falls back by more has started anew


@dataclass(frozen=True)
class Residuals:
    """What became of each TDOA. t (n,) s; a, b (n,) anchor ids; innovation (n,) m and variance (n,) m^2, NaN unless used
    or rejected by the filter; weight (n,) 0 to 1; verdict (n,) a key of VERDICTS."""

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    innovation: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    verdict: np.ndarray


@dataclass(frozen=True)
class Odometry:
    """Estimates. t (n,) s; p (n, 3) m; v (n, 3) m/s, world; q (n, 4) x y z w, body to world; accel_bias (n, 3) m/s^2 and
    gyro_bias (n, 3) rad/s, body; covariance (n, 9, 9) of [p, v, attitude], the attitude's in the body frame, rad."""

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    accel_bias: np.ndarray
    gyro_bias: np.ndarray
    covariance: np.ndarray

    @classmethod
    def from_rows(cls, rows, covariance):
        """From what engine.run writes: rows (n, 17) of stamp and state, covariance (n, 9, 9)."""
        parts = (rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7:11], rows[:, 11:14], rows[:, 14:17])
        return cls(*parts, covariance)

    def __len__(self):
        return len(self.t)


class Estimator:
    """Time-ordered buffer, filter and accounts.

    Messages wait until every stream has passed them and are used in stamp order. A stream that is silent is waited for
    for `lag` seconds of stamps; TDOAs wait `reorder` more for late siblings. What is older than what was used is late.
    """

    def __init__(self, anchors, config=None, reorder=0.003, lag=0.25):
        """anchors : Anchors; config : FilterConfig; reorder, lag : s."""
        self.anchors = anchors
        self.config = config or FilterConfig()
        self.reorder, self.lag = reorder, lag
        self._rows = {int(i): row for row, i in enumerate(anchors.ids)}
        self._tuning = self.config.tuning()
        self.counts = dict.fromkeys([*VERDICTS.values(), "imu_used", "imu_late", "imu_invalid", "restarts"], 0)
        self._restart()

    def _restart(self):
        self._memory = new_memory(len(self.anchors))
        self._imu, self._tdoa, self._refused = [], [], []
        self._newest_imu = self._newest_tdoa = self._done = -math.inf

    @property
    def running(self):
        """True once a start position was found."""
        return bool(self._memory.clock[RUNNING])

    @property
    def recoveries(self):
        """How often the filter found that it had lost the tag, and found it again."""
        return int(self._memory.clock[RECOVERIES])

    @property
    def waiting(self):
        """Messages received and neither used nor refused yet: (imu, tdoa)."""
        return len(self._imu), len(self._tdoa)

    def add_imu(self, t, gyro, force):
        """Take one inertial sample: t s; gyro (3,) rad/s; force (3,) m/s^2, specific force; body frame."""
        sample = (t, *gyro, *force)
        if not (math.isfinite(t) and max(map(abs, gyro)) < MAX_RATE and max(map(abs, force)) < MAX_FORCE) or any(
            map(math.isnan, sample)
        ):
            self.counts["imu_invalid"] += 1
            return
        if t < self._newest_imu - TIME_JUMP:
            self._start_anew()
        if t < self._done:
            self.counts["imu_late"] += 1
            return
        _insert(self._imu, sample)
        self._newest_imu = max(self._newest_imu, t)

    def add_tdoa(self, t, a, b, d, bias_std=0.0):
        """Take one corrected TDOA: t s; a, b anchor ids; d m; bias_std m."""
        i, k = self._rows.get(a, -1), self._rows.get(b, -1)
        if not (math.isfinite(t) and usable(i, k, d, bias_std, self.anchors.positions)):
            self._refused.append((t, a, b, INVALID))
            return
        if t < self._newest_tdoa - TIME_JUMP:
            self._start_anew()
        if t < self._done:
            self._refused.append((t, a, b, LATE))
            return
        _insert(self._tdoa, (t, i, k, d, bias_std))
        self._newest_tdoa = max(self._newest_tdoa, t)

    def advance(self):
        """Use every message that nothing earlier can precede any more. Returns (Odometry, Residuals), possibly empty."""
        newest = max(self._newest_imu, self._newest_tdoa)
        both = self._newest_tdoa - self.reorder
        if self.config.use_imu:
            both = min(both, self._newest_imu - self.reorder)
        return self._use(max(both, newest - self.lag))

    def finish(self):
        """Use everything that still waits. Returns (Odometry, Residuals)."""
        return self._use(math.inf)

    def _start_anew(self):
        refused = self._refused + [(t, *self.anchors.ids[[i, k]].tolist(), LATE) for t, i, k, _, _ in self._tdoa]
        self.counts["imu_late"] += len(self._imu)
        self.counts["restarts"] += 1
        self._restart()
        self._refused = refused

    def _use(self, until):
        n, k = (bisect_right(stream, (until, math.inf)) for stream in (self._imu, self._tdoa))
        if not (n or k or self._refused):
            return _NOTHING
        imu = np.array(self._imu[:n]).reshape(n, 7)
        tdoa = np.array(self._tdoa[:k]).reshape(k, 5)
        a, b = tdoa[:, 1].astype(np.int64), tdoa[:, 2].astype(np.int64)
        del self._imu[:n], self._tdoa[:k]
        fed = imu if self.config.use_imu else imu[:0]
        fed_t, gyro, force = (np.ascontiguousarray(part) for part in (fed[:, 0], fed[:, 1:4], fed[:, 4:7]))
        t, d, std = (np.ascontiguousarray(tdoa[:, column]) for column in (0, 3, 4))
        rows, covariance, used = np.empty((n + k, 17)), np.empty((n + k, 9, 9)), np.empty((k, 4))
        count = run(
            self._memory, self._tuning, self.anchors.positions, fed_t, gyro, force,
            t, a, b, d, std, rows, covariance, used, _NO_TAPE,
        )  # fmt: skip
        for stream in (imu, tdoa):
            if len(stream):
                self._done = max(self._done, stream[-1, 0])
        self.counts["imu_used"] += n
        residuals = self._residuals(tdoa[:, 0], self.anchors.ids[a], self.anchors.ids[b], used)
        return Odometry.from_rows(rows[:count], covariance[:count]), residuals

    def _residuals(self, t, a, b, used):
        refused = np.array(self._refused, dtype=float).reshape(-1, 4)
        self._refused = []
        none = np.full(len(refused), np.nan)
        verdict = np.concatenate([used[:, 3], refused[:, 3]]).astype(np.uint8)
        for value, number in zip(*np.unique(verdict, return_counts=True)):
            self.counts[VERDICTS[int(value)]] += int(number)
        return Residuals(
            np.concatenate([t, refused[:, 0]]),
            np.concatenate([a, refused[:, 1].astype(np.int64)]),
            np.concatenate([b, refused[:, 2].astype(np.int64)]),
            np.concatenate([used[:, 0], none]),
            np.concatenate([used[:, 1], none]),
            np.concatenate([used[:, 2], 0.0 * refused[:, 3]]),
            verdict,
        )


_NO_TAPE = new_tape()
_NOTHING = (
    Odometry.from_rows(np.empty((0, 17)), np.empty((0, 9, 9))),
    Residuals(*(np.empty(0) for _ in range(7))),
)


def _insert(stream, item):
    if stream and item < stream[-1]:
        insort(stream, item)
    else:
        stream.append(item)
