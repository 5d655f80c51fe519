# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test whether the inertial sensor fits the rotations and accelerations of the ground truth.

A rule takes a TrueMotion and yields Findings. Both sensors are compared over short cells, after
removal of constant biases and slow changes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation, Slerp

from uwb_tdoa_bias.common.arrays import Stamped
from uwb_tdoa_bias.common.flight import Flight, Imu, Truth
from uwb_tdoa_bias.common.geometry import tdoa as predicted_tdoa
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding

from .imu_rules import ARRANGEMENTS, SCALES, is_smooth, scale_of, signed_axis
from .pair_rules import BLOCK, LONGEST, Delays, delays, drift_or_jump
from .recording import Recording

CELL, HALF = 0.05, 0.1  # s between cells, and half the time over which a cell is averaged
BEYOND = round(LONGEST / CELL)  # further cells at both ends, to try delays
FEWEST = 200  # cells in the air
# m; and the largest ratio of the residuals with another unit and with metres (healthy: above 4)
LENGTHS, FITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "feet": 0.3048, "inches": 0.0254}, 0.5
LIMIT = 4.0  # robust standard deviations at which a difference is clipped
GRAVITY = 9.81  # m/s^2
# Largest power after a change of axes, over the power before, that counts as a mistake. In healthy
# flights it is at least 1.22 (gyroscope) and 0.92 (accelerometer).
AXES = {"gyro": 0.8, "accel": 0.75}
# A wrong attitude of the truth is blamed if it leaves at most this times the power of the gyroscope
# that the best change of its axes leaves.
ATTITUDE = 1.2
LEAST_TURN = np.radians(10.0)  # of a mounting; that of measured flights is 5 degrees at most
# Share of the power that a low pass leaves (healthy 0.87 at least), and for a sensor that is smooth.
FILTERED, FILTERED_SMOOTH = 0.8, 0.97
SLOWNESS = 0.05, 0.1, 0.2, 0.4, 0.8  # s, time constants of the low pass
SENSORS = {"gyro": "gyroscope", "accel": "accelerometer"}
# Wrong attitudes x, y, z, w: {words: places, signs}
ATTITUDES = {
    "of a frame that is mirrored along x": ([0, 1, 2, 3], (1, -1, -1, 1)),
    "of a frame that is mirrored along y": ([0, 1, 2, 3], (-1, 1, -1, 1)),
    "of a frame that is mirrored along z": ([0, 1, 2, 3], (-1, -1, 1, 1)),
    "from the world to the body": ([0, 1, 2, 3], (-1, -1, -1, 1)),
    "written with w first": ([1, 2, 3, 0], (1, 1, 1, 1)),
}


class TrueMotion(Stamped):
    """Inertial samples and the motion of the ground truth over the same cells.

    Attributes
    ----------
    t : (n,) array
        Cells in the air, or all of a rover, s.
    measured : dict
        {"gyro", "accel": (n, 3)}, means over the cells, rad/s and m/s^2, body.
    true : dict
        The same from the ground truth, with BEYOND further cells at both ends.
    block : (n,) array of int
        Number of the block of BLOCK seconds.
    smooth : dict
        {sensor: whether it changes too evenly for a sensor that vibrates}.
    """

    def __init__(self, imu: Imu, truth: Truth) -> None:
        """Average the samples over cells. The ground truth needs attitudes."""
        known = np.isfinite(truth.q).all(axis=1)
        self._t, first = np.unique(truth.t[known], return_index=True)
        self._p, self._q = truth.p[known][first], truth.q[known][first]
        above = self._p[:, 2] > 0.3
        flown = self._t[above] if above.any() else self._t  # a rover
        margin = LONGEST + 0.5
        start = max(flown[0], imu.t[0], self._t[0]) + margin
        end = min(flown[-1], imu.t[-1], self._t[-1]) - margin
        # After a pause of days only the time before it is used.
        cells = min(max(int((end - start) / CELL), 0), len(imu))
        self.t = start + CELL * np.arange(cells)
        self.block = (CELL * np.arange(len(self.t)) / BLOCK).astype(int)
        if len(self) < FEWEST:
            return
        self.measured = {
            "gyro": _mean(imu.t, imu.gyro, self.t),
            "accel": _triangle(imu.t, imu.accel, self.t),
        }
        self.true = self.with_attitude(None)
        self.smooth = {"gyro": is_smooth(imu.t, imu.gyro), "accel": is_smooth(imu.t, imu.accel)}
        self._scale = {}
        for sensor in SENSORS:
            left = _slowly_left(self.measured[sensor] - self.at(self.true[sensor]), self.block)
            self._scale[sensor] = 1.4826 * np.median(np.abs(left), axis=0) + 1e-9

    def with_attitude(self, name: str | None) -> dict[str, np.ndarray]:
        """Return {"gyro", "accel": (n + 2 BEYOND, 3)}, the true readings for one of ATTITUDES.

        None is the attitude as written. The cells extend LONGEST beyond both ends of t.
        """
        order, signs = ATTITUDES[name] if name else ([0, 1, 2, 3], (1, 1, 1, 1))
        attitude = Slerp(self._t, Rotation.from_quat(self._q[:, order] * signs))  # body to world
        t = self.t[0] + CELL * np.arange(-BEYOND, len(self.t) + BEYOND)
        gyro = (attitude(t - HALF).inv() * attitude(t + HALF)).as_rotvec() / (2.0 * HALF)
        before, here, after = (_at(self._t, self._p, t + shift) for shift in (-HALF, 0.0, HALF))
        acceleration = (after - 2.0 * here + before) / HALF**2  # world
        force = attitude(t).inv().apply(acceleration + (0.0, 0.0, GRAVITY))
        return {"gyro": gyro, "accel": force}

    def at(self, true: np.ndarray, late: int = 0) -> np.ndarray:
        """Return the rows (n, 3) of `true` that are so many cells earlier."""
        return true[BEYOND - late : len(true) - BEYOND - late]

    def power(self, sensor: str, true: np.ndarray, change: np.ndarray | None = None) -> float:
        """Return the mean clipped square of measured minus true values.

        The unit is the robust standard deviation of the uncorrected difference.

        Parameters
        ----------
        sensor : str
            "gyro" or "accel".
        true : (n + 2 BEYOND, 3) array
            True readings.
        change : (3, 3) array or None
            Matrix that is applied to the measured values.
        """
        measured = self.measured[sensor] if change is None else self.measured[sensor] @ change.T
        left = _slowly_left(measured - self.at(true), self.block) / self._scale[sensor]
        return float(np.mean(np.clip(left, -LIMIT, LIMIT) ** 2))

    def delays(self) -> Delays:
        """Return the Delays of both sensors, one series for each axis."""
        series, t = np.repeat(np.arange(6), len(self.t)), np.tile(self.t, 6)

        def error(late: float) -> np.ndarray:
            parts = (self.measured[s] - self.at(self.true[s], round(late / CELL)) for s in SENSORS)
            return np.concatenate([part.T.reshape(-1) for part in parts])

        return delays(series, t, error)


def _slowly_left(values: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return values (n, 3) without their means over blocks."""
    count = np.maximum(np.bincount(block), 1)
    return values - np.stack(
        [(np.bincount(block, column) / count)[block] for column in values.T], axis=1
    )


def _at(t: np.ndarray, values: np.ndarray, when: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(when, t, column) for column in values.T], axis=1)


def _mean(t: np.ndarray, values: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Return means (n, 3) over HALF to both sides."""
    total = cumulative_trapezoid(values, t, axis=0, initial=0.0)
    return (_at(t, total, when + HALF) - _at(t, total, when - HALF)) / (2.0 * HALF)


def _triangle(t: np.ndarray, values: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Return means (n, 3) with a triangular weight, HALF to both sides.

    A second difference of positions has the same weight.
    """
    total = values - values.mean(axis=0)
    for _ in range(2):
        total = cumulative_trapezoid(total, t, axis=0, initial=0.0)
    second = _at(t, total, when + HALF) - 2.0 * _at(t, total, when) + _at(t, total, when - HALF)
    return second / HALF**2 + values.mean(axis=0)


def truth_unit(recording: Flight | Recording) -> Iterator[Finding]:
    """Yield a finding if the TDOAs fit to the ground truth in another unit of length only."""
    truth, tdoa, anchors = recording.truth, recording.tdoa, recording.anchors
    if truth is None or len(truth) < 2:
        return
    rows = np.stack([anchors.index(tdoa.a), anchors.index(tdoa.b)])
    inside = (tdoa.t > truth.t[0]) & (tdoa.t < truth.t[-1]) & (rows >= 0).all(axis=0)
    if inside.sum() < FEWEST:
        return
    a, b = anchors.positions[rows[:, inside]]
    p = np.stack([np.interp(tdoa.t[inside], truth.t, column) for column in truth.p.T], axis=1)

    def residual(path: np.ndarray) -> float:
        return float(np.median(np.abs(predicted_tdoa(path, a, b) - tdoa.d[inside])))

    left = {unit: residual(factor * p) for unit, factor in LENGTHS.items()}
    unit = min(left, key=left.__getitem__)
    # a path in another frame shrinks to a point, which may fit better than it does
    still = residual(np.tile(LENGTHS[unit] * p.mean(axis=0), (len(p), 1)))
    if left[unit] < FITS * min(left["m"], still):
        yield Finding(
            "truth_unit",
            ERROR,
            cause=f"the ground truth is in {unit}, and is read as metres",
            evidence=f"TDOAs are {left[unit]:.2f} m off it then, {left['m']:.2f} m as it is (median)",
            remedy=f"divide its positions by {1.0 / LENGTHS[unit]:g}"
            + (f", or give the unit ({unit})" if len(unit) == 2 else ""),
            value=LENGTHS[unit],
        )


def judge_imu(recording: Flight | Recording, stamps: bool = True) -> list[Finding]:
    """Return findings on an IMU against the recorded attitude; none without one.

    stamps : whether to judge its filter and its stamps, too
    """
    imu, truth = recording.imu, recording.truth
    if imu is None or truth is None or np.isfinite(truth.q).all(axis=1).sum() < 2:
        return []
    motion = TrueMotion(imu, truth)
    if len(motion) < FEWEST:
        return []
    found = list(wrong_axes(motion))
    return found or ([*low_passes(motion), *wrong_stamps(motion)] if stamps else [])


def wrong_axes(motion: TrueMotion) -> Iterator[Finding]:
    """Yield a Finding for each sensor with wrong axes or units, or one for both, or the ground truth.

    A wrong attitude of the ground truth looks like wrong axes of both sensors. Then it is the only
    Finding. So is a turn of the IMU by another angle than those of the arrangements of axes. `motion`
    must have at least FEWEST cells.
    """
    base = {sensor: motion.power(sensor, motion.true[sensor]) for sensor in SENSORS}
    best = {sensor: _best_arrangement(motion, sensor) for sensor in SENSORS}
    wrong = [sensor for sensor in SENSORS if _explains(motion, sensor, base[sensor], *best[sensor])]
    attitude, powers = min(
        ((name, _with_attitude(motion, name)) for name in ATTITUDES), key=lambda x: x[1]["gyro"]
    )
    if (
        powers["gyro"] < AXES["gyro"] * base["gyro"]
        and powers["accel"] < base["accel"]
        and powers["gyro"] < ATTITUDE * best["gyro"][0]
    ):
        evidence = (
            f"{100 * (1 - powers['gyro'] / base['gyro']):.0f} % less mean square difference of the "
            "turns then, "
        )
        evidence += f"{100 * (1 - powers['accel'] / base['accel']):.0f} % less of the accelerations"
        yield Finding(
            "truth_attitude",
            ERROR,
            cause=f"the attitude of the ground truth is {attitude}",
            evidence=evidence,
            remedy="write body to world, right-handed, x y z w",
            value=powers["gyro"],
        )
        return
    turn = Rotation.align_vectors(motion.at(motion.true["gyro"]), motion.measured["gyro"])[0]
    left = motion.power("gyro", motion.true["gyro"], turn.as_matrix())
    explained = left < AXES["gyro"] * min(base["gyro"], best["gyro"][0])
    if explained and turn.magnitude() > LEAST_TURN:
        yield Finding(
            "imu_mounting",
            ERROR,
            cause=(
                f"the IMU is turned by {np.degrees(turn.magnitude()):.0f} degrees about "
                f"{signed_axis(-turn.as_rotvec())}, or the body of the ground truth against it"
            ),
            evidence=(
                f"{100 * (1 - left / base['gyro']):.0f} % less mean square difference of its rates "
                "to the ground truth, turned back"
            ),
            remedy="mount it straight, or write in /tf_static how it is mounted; or turn the body "
            "in the motion capture system",
            value=float(turn.magnitude()),
        )
        return
    for sensor in wrong:
        remaining, correction = best[sensor]
        evidence = (
            f"{100 * (1 - remaining / base[sensor]):.0f} % less mean square difference to the "
            "ground "
            "truth"
        )
        yield _of_axes(sensor, correction, evidence, remaining)


def _explains(
    motion: TrueMotion, sensor: str, base: float, power: float, change: np.ndarray
) -> bool:
    """Return whether a change of the axes explains much of the remaining power.

    A change that makes values small must explain more than values of zero do.
    """
    if scale_of(change) < 0.9:
        base = min(base, motion.power(sensor, motion.true[sensor], np.zeros((3, 3))))
    return power < AXES[sensor] * base


def _best_arrangement(motion: TrueMotion, sensor: str) -> tuple[float, np.ndarray]:
    """Return (remaining power, (3, 3) matrix) of the best correction of a sensor."""
    changes = ARRANGEMENTS[1:]
    if sensor == "gyro":
        scales = [scale for unit in SCALES for scale in (unit, 1.0 / unit)]
        changes = [*changes, *(scale * np.eye(3) for scale in scales)]
    true = motion.true[sensor]
    trials = ((motion.power(sensor, true, change), change) for change in changes)
    return min(trials, key=lambda trial: trial[0])


def _with_attitude(motion: TrueMotion, name: str) -> dict[str, float]:
    true = motion.with_attitude(name)
    return {sensor: motion.power(sensor, true[sensor]) for sensor in SENSORS}


def _of_axes(sensor: str, change: np.ndarray, evidence: str, power: float) -> Finding:
    scale = scale_of(change)
    if abs(scale - 1.0) > 0.1:
        return Finding(
            "imu_rate_unit",
            ERROR,
            cause=(
                f"the gyroscope is in another unit than rad/s: it reads {1.0 / scale:.3g} times "
                "the "
                "turns of the ground truth"
            ),
            evidence=evidence,
            remedy=f"angular_velocity *= {scale:.6g}",
            value=scale,
        )
    words = [
        f"{axis} is {found}"
        for axis, found in zip("xyz", map(signed_axis, change))
        if found != axis
    ]
    return Finding(
        f"{sensor}_axes",
        ERROR,
        cause=(
            f"axes of the {SENSORS[sensor]} are exchanged or mirrored: {', '.join(words)} of what "
            "it "
            "reads"
        ),
        evidence=evidence,
        remedy="put the driver right: x forward, y left, z up",
        value=power,
    )


def low_passes(motion: TrueMotion) -> Iterator[Finding]:
    """Yield low passes of first order in a sensor: its output is late and too small.

    The noisy truth fits better behind any low pass. A low pass that runs backwards shows by how much.
    """
    for sensor in SENSORS:
        true, limit = motion.true[sensor], FILTERED_SMOOTH if motion.smooth[sensor] else FILTERED
        powers = [
            (
                motion.power(sensor, _slowed(true, tau)),
                motion.power(sensor, _slowed(true[::-1], tau)[::-1]),
                tau,
            )
            for tau in SLOWNESS
        ]
        power, backwards, slowness = min(powers)
        backwards = min(backwards, motion.power(sensor, true))
        if power < limit * backwards:
            less = (
                f"{100 * (1 - power / backwards):.0f} % less mean square difference to the ground "
                "truth"
            )
            yield Finding(
                "imu_filtered",
                ERROR,
                cause=(
                    f"the {SENSORS[sensor]} is filtered: what it reads is {slowness:g} s late and "
                    "too "
                    "small"
                ),
                evidence=f"{less} behind a low pass of {slowness:g} s",
                remedy="set the low pass of the sensor to 20 Hz or more",
                value=slowness,
            )


def _slowed(values: np.ndarray, tau: float) -> np.ndarray:
    """Return values behind a low pass of first order with time constant tau, s."""
    from scipy.signal import lfilter  # takes a second to import

    share = 1.0 - np.exp(-CELL / tau)
    return lfilter([share], [1.0, share - 1.0], values - values[0], axis=0) + values[0]


def wrong_stamps(motion: TrueMotion) -> Iterator[Finding]:
    """Yield stamps that drift or jump."""
    yield from drift_or_jump("imu", "inertial samples", motion.delays())
