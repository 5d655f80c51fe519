"""Watches the residuals in flight: has an anchor, or an axis of the IMU, changed since the flight began?

The innovations of all pairs are explained, over the last seconds, by one delay for each anchor: d_ab is off by
late_b - late_a (recursive least squares with exponential forgetting). What the delays are in the first seconds of
motion is taken as their calibration; how much they wander then, and how wide the innovations are, says what is no
change.
"""

from collections import deque
import math

import numpy as np

from ..core.engine import REJECTED, USED

MEMORY = 3.0  # s of innovations that one estimate rests on
MOVING = 0.3  # m/s; on the floor, residuals are not those of the air
SETTLE, LEARN = 3.0, 15.0  # s in motion: the first are ignored, those up to the second count as calibration
STEP = 0.2  # s between two estimates
HISTORY = 30.0  # s of estimates that are kept
LIMIT, SIGMAS, SPREADS = (
    0.15,
    6.0,
    2.0,
)  # m, deviations of the calibration, spreads of the innovations: a change is larger
LAST = 1.5  # s for which it must do so
CLIP = 1.5  # m; a larger innovation counts as this
RIDGE = 2.0  # m^-2, pulls delays that nothing tells to zero
BIAS_LIMITS = {"gyroscope": 0.03, "accelerometer": 0.6}  # rad/s and m/s^2, by which an estimated bias must have moved


class Monitor:
    """Feed it residuals and odometry in stamp order; ask for `alarms`."""

    def __init__(self, anchors):
        """anchors : Anchors."""
        self._ids = anchors.ids.tolist()
        self._rows = {anchor: row for row, anchor in enumerate(self._ids)}
        n = len(self._ids)
        self._information, self._vector = np.zeros((n, n)), np.zeros(n)
        self._t = self._first = self._next = None  # stamps: the last TDOA, the beginning of motion, the next estimate
        self._spread = 0.0
        self._learned, self._history = [], deque(maxlen=int(HISTORY / STEP))
        self._bias, self._bias_now, self._bias_sum = None, None, []

    def add(self, residuals):
        """Take Residuals; only those that reached the filter count."""
        columns = (residuals.t, residuals.a, residuals.b, residuals.innovation, residuals.variance, residuals.verdict)
        for t, a, b, innovation, variance, verdict in zip(*(column.tolist() for column in columns)):
            if verdict in (USED, REJECTED) and math.isfinite(innovation):
                self._take(t, self._rows[int(a)], self._rows[int(b)], innovation, variance)

    def add_odometry(self, odometry):
        """Take Odometry, for the biases of the IMU."""
        if not len(odometry) or self._t is None:
            return
        if self._first is None:
            if np.linalg.norm(odometry.v[-1]) > MOVING:
                self._first, self._next = self._t, self._t + SETTLE
            return
        now = np.concatenate([odometry.gyro_bias[-1], odometry.accel_bias[-1]])
        if odometry.t[-1] < self._first + LEARN:
            self._bias_sum.append(now)
        elif self._bias is None and self._bias_sum:
            self._bias = np.mean(self._bias_sum[len(self._bias_sum) // 2 :], axis=0)
        self._bias_now = now

    def _take(self, t, a, b, innovation, variance):
        if self._t is None or not 0.0 <= t - self._t < 10.0 * MEMORY:
            self._first = None
            self._information[:], self._vector[:] = 0.0, 0.0
            self._learned, self._bias, self._bias_sum = [], None, []
            self._history.clear()
        else:
            keep = math.exp((self._t - t) / MEMORY)
            self._information *= keep
            self._vector *= keep
        dt = 0.0 if self._t is None else t - self._t
        self._t = t
        innovation = min(max(innovation, -CLIP), CLIP)
        self._information[a, a] += 1.0
        self._information[b, b] += 1.0
        self._information[a, b] -= 1.0
        self._information[b, a] -= 1.0
        self._vector[a] -= innovation
        self._vector[b] += innovation
        if self._first is None:
            return
        if t < self._first + LEARN:  # 1.25 times the mean magnitude: the deviation of normal noise
            self._spread += min(1.0, max(dt, 0.0) / MEMORY) * (1.25 * abs(innovation) - self._spread)
        if t >= self._next:
            self._next = t + STEP
            late = np.linalg.solve(self._information + RIDGE * np.eye(len(self._vector)), self._vector)
            if t < self._first + LEARN:
                self._learned.append(late)
            elif self._learned:
                self._history.append((t, late))

    @property
    def alarms(self):
        """Sentences on what has changed; empty while nothing has."""
        return self._anchor_alarms() + self._axis_alarms()

    def _anchor_alarms(self):
        recent = [late for t, late in self._history if t > self._t - LAST]
        if len(recent) < LAST / STEP - 1:
            return []
        normal = np.median(self._learned, axis=0)
        noise = 1.4826 * np.median(np.abs(np.array(self._learned) - normal), axis=0)
        moved = np.array(recent) - normal
        limit = np.maximum(max(LIMIT, SPREADS * self._spread), SIGMAS * np.maximum(noise, np.median(noise)))
        certain = (moved > limit).all(axis=0) | (moved < -limit).all(axis=0)
        if not certain.any():
            return []
        n = len(limit)  # what one anchor does, the least-norm solution spreads over all: it keeps (n - 1) / n
        size = np.median(moved, axis=0) * n / (n - 1)
        row = int(np.argmax(np.where(certain, np.abs(size), 0.0)))  # the others only make room for it
        return [self._sentence(row, float(size[row]), normal[row])]

    def _sentence(self, row, size, normal):
        t = np.array([t for t, _ in self._history])
        n = len(self._ids)
        course = (np.array([late[row] for _, late in self._history]) - normal) * n / (n - 1)
        since = t > t[-1] - 0.7 * HISTORY
        slope, rest = np.polyfit(t[since] - t[-1], course[since], 1)
        ramp = np.std(course[since] - slope * (t[since] - t[-1]) - rest) < 0.5 * np.std(course[since])
        if ramp and since.sum() > 5.0 / STEP:
            what = f"its clock drifts ({slope:+.3f} m/s)"
        elif size > 0.0:
            what = "it is blocked (NLOS) or was moved"
        else:
            what = "it was moved"
        return f"anchor {self._ids[row]}: {size:+.2f} m since the start of the flight: {what}"

    def _axis_alarms(self):
        if self._bias is None or self._bias_now is None:
            return []
        change, out = self._bias_now - self._bias, []
        for k, (name, limit) in enumerate(BIAS_LIMITS.items()):
            for axis, value in zip("xyz", change[3 * k : 3 * k + 3].tolist()):
                if abs(value) > limit:
                    unit = "rad/s" if name == "gyroscope" else "m/s^2"
                    out.append(f"{name} {axis}: bias moved by {value:+.3f} {unit} since the start of the flight")
        return out
