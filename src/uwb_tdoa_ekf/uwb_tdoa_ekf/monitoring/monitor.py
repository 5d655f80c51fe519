"""Watches the residuals in flight: has an anchor, or an axis of the IMU, changed since the flight began?

The innovations of all pairs are explained, over the last seconds, by one delay for each anchor: d_ab is off by
delay_b - delay_a (recursive least squares with exponential forgetting). What the delays are in the first seconds of
motion is taken as their calibration; how much they wander then, and how wide the innovations are, says what is no
change.
"""

from collections import deque
import math

import numpy as np

from ..core.verdicts import REJECTED, USED

FORGETTING_TIME = 3.0  # s of innovations that one estimate rests on
MOVING = 0.3  # m/s; on the floor, residuals are not those of the air
SETTLE, CALIBRATE = 3.0, 15.0  # s in motion: the first are ignored, those up to the second count as calibration
ESTIMATE_PERIOD = 0.2  # s
KEPT = 30.0  # s of estimates that are kept
PERSISTENCE = 1.5  # s for which a change must last
SMALLEST_CHANGE = 0.15  # m; a change of a delay is larger than this,
DELAY_STDS = 6.0  # this many standard deviations of the delay during calibration, and
INNOVATION_STDS = 2.0  # this many of the innovations then
CLIP = 1.5  # m; a larger innovation counts as this
RIDGE = 2.0  # m^-2, pulls delays that nothing tells to zero
BIAS_LIMITS = {"gyroscope": 0.03, "accelerometer": 0.6}  # rad/s and m/s^2, by which an estimated bias must have moved
MAD_TO_STD, MEAN_MAGNITUDE_TO_STD = 1.4826, 1.25  # of normal noise


class Monitor:
    """Feed it residuals and odometry in stamp order; ask for `alarms`."""

    def __init__(self, anchors):
        """anchors : Anchors."""
        self._ids = anchors.ids.tolist()
        self._rows = {anchor: row for row, anchor in enumerate(self._ids)}
        n = len(self._ids)
        self._information, self._vector = np.zeros((n, n)), np.zeros(n)
        self._t = None  # s, stamp of the last TDOA
        self._estimates = deque(maxlen=int(KEPT / ESTIMATE_PERIOD))  # (stamp, delays (N,) m) after calibration
        self._forget()

    def _forget(self):
        self._information[:], self._vector[:] = 0.0, 0.0
        self._moving_since = self._next_estimate = None  # s, stamps
        self._innovation_std = 0.0  # m, during calibration
        self._calibration = []  # delays (N,) m
        self._bias = self._bias_now = None  # (6,): gyroscope, accelerometer; as calibrated, and the latest
        self._bias_calibration = []
        self._estimates.clear()

    def add(self, residuals):
        """Take Residuals; only those that reached the filter count."""
        columns = (residuals.t, residuals.a, residuals.b, residuals.innovation, residuals.verdict)
        for t, a, b, innovation, verdict in zip(*(column.tolist() for column in columns)):
            if verdict in (USED, REJECTED) and math.isfinite(innovation):
                self._add_innovation(t, self._rows[int(a)], self._rows[int(b)], min(max(innovation, -CLIP), CLIP))

    def add_odometry(self, odometry):
        """Take Odometry, for the biases of the IMU."""
        if not len(odometry) or self._t is None:
            return
        if self._moving_since is None:
            if np.linalg.norm(odometry.v[-1]) > MOVING:
                self._moving_since, self._next_estimate = self._t, self._t + SETTLE
            return
        bias = np.concatenate([odometry.gyro_bias[-1], odometry.accel_bias[-1]])
        if odometry.t[-1] < self._moving_since + CALIBRATE:
            self._bias_calibration.append(bias)
        elif self._bias is None and self._bias_calibration:
            self._bias = np.mean(self._bias_calibration[len(self._bias_calibration) // 2 :], axis=0)
        self._bias_now = bias

    def _add_innovation(self, t, a, b, innovation):
        if self._t is None or not 0.0 <= t - self._t < 10.0 * FORGETTING_TIME:
            self._forget()
            dt = 0.0
        else:
            dt = t - self._t
            keep = math.exp(-dt / FORGETTING_TIME)
            self._information *= keep
            self._vector *= keep
        self._t = t
        self._information[a, a] += 1.0
        self._information[b, b] += 1.0
        self._information[a, b] -= 1.0
        self._information[b, a] -= 1.0
        self._vector[a] -= innovation
        self._vector[b] += innovation
        if self._moving_since is None:
            return
        calibrating = t < self._moving_since + CALIBRATE
        if calibrating:
            std = MEAN_MAGNITUDE_TO_STD * abs(innovation)
            self._innovation_std += min(1.0, dt / FORGETTING_TIME) * (std - self._innovation_std)
        if t >= self._next_estimate:
            self._next_estimate = t + ESTIMATE_PERIOD
            delays = np.linalg.solve(self._information + RIDGE * np.eye(len(self._vector)), self._vector)
            if calibrating:
                self._calibration.append(delays)
            elif self._calibration:
                self._estimates.append((t, delays))

    @property
    def alarms(self):
        """Sentences on what has changed; empty while nothing has."""
        return self._anchor_alarms() + self._axis_alarms()

    def _anchor_alarms(self):
        recent = [delays for t, delays in self._estimates if t > self._t - PERSISTENCE]
        if len(recent) < PERSISTENCE / ESTIMATE_PERIOD - 1:
            return []
        calibrated = np.median(self._calibration, axis=0)
        std = MAD_TO_STD * np.median(np.abs(np.array(self._calibration) - calibrated), axis=0)
        change = np.array(recent) - calibrated
        smallest = max(SMALLEST_CHANGE, INNOVATION_STDS * self._innovation_std)
        limit = np.maximum(smallest, DELAY_STDS * np.maximum(std, np.median(std)))
        certain = (change > limit).all(axis=0) | (change < -limit).all(axis=0)
        if not certain.any():
            return []
        n = len(limit)  # what one anchor does, the least-norm solution spreads over all: it keeps (n - 1) / n
        size = np.median(change, axis=0) * n / (n - 1)
        row = int(np.argmax(np.where(certain, np.abs(size), 0.0)))  # the others only make room for it
        return [self._sentence(row, float(size[row]), calibrated[row])]

    def _sentence(self, row, size, calibrated):
        t = np.array([t for t, _ in self._estimates])
        n = len(self._ids)
        course = (np.array([delays[row] for _, delays in self._estimates]) - calibrated) * n / (n - 1)
        since = t > t[-1] - 0.7 * KEPT
        slope, rest = np.polyfit(t[since] - t[-1], course[since], 1)
        ramp = np.std(course[since] - slope * (t[since] - t[-1]) - rest) < 0.5 * np.std(course[since])
        if ramp and since.sum() > 5.0 / ESTIMATE_PERIOD:
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
