# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Count the values of an inertial stream over windows of 1 s and check the windows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.vibration import VIBRATION_CORNER, low_pass

from ..core.imu_fault_detector import AXIS, UPRIGHT
from ..core.state import GRAVITY
from .finding import ERROR, WARNING, Finding
from .stamp_rules import (
    LAST,
    StampWindow,
    complete,
    count_stamp,
    median,
    new_stamps,
    restart_stamps,
    stamp_window,
)

ABSURD = 1e9  # no sensor returns this, in any unit
# m/s^2, limits of the median length of the mean specific force; healthy 9.7 - 10.5
FORCE_RANGE = 7.0, 14.0
FORCE_UNITS = {
    "g": (GRAVITY, 0.7, 1.5),
    "mg": (1e-3 * GRAVITY, 700.0, 1500.0),
    "mm/s^2": (1e-3, 7e3, 14e3),
}
# standard deviation over mean of the specific force above which it has no gravity; healthy 0.41 at
# most
WEIGHTLESS = 0.65
# length of the mean specific force over the mean of its lengths; healthy 0.96 at least
STEADY = 0.8
# On 29 measured and simulated flights without gravity, the deviation is 0.74 at least or the
# steadiness 0.64 at most.
TURN_EXCESS = 0.35
# limits of a tag at rest: relative deviation of the specific force, and change of its direction in
# rad
REST_SHAKES, REST_TURNS = (0.02, 0.02)
# m/s^2 rms of the part faster than 50 ms; healthy 0.6; 1.4 at least where the accelerometer
# rectifies
SHAKING = 1.0
REPEATS, DEAD = 0.2, 0.95  # shares of samples that equal the one before; healthy 0
# samples at one end in a window, and distance of that end from the mean, m/s^2 and rad/s
CLIPPED, FAR_FORCE, FAR_RATE = 8, 8.0, 2.0
AXES = (
    "gyroscope x",
    "gyroscope y",
    "gyroscope z",
    "accelerometer x",
    "accelerometer y",
    "accelerometer z",
)

# places in the counters of one channel; the first two are kept between windows
VALUE, SLOW, SUM, SQUARES, FAST, SAME, LOW, LOW_HITS, HIGH, HIGH_HITS = range(10)
# places in the counters of all six channels together
TAKEN, REPEATED, INVALID = range(3)


class ImuCounters(NamedTuple):
    """Store the counters of the current window.

    Attributes
    ----------
    stamps : (20,) array
        Counters of stamp_rules.
    channels : (6, 10) array
        Counters of gyroscope x y z and accelerometer x y z.
    whole : (3,) array
        Counters of all channels together.
    """

    stamps: np.ndarray
    channels: np.ndarray
    whole: np.ndarray


class ImuWindow(NamedTuple):
    """Store the statistics of one window of inertial samples.

    Rates are in rad/s and the specific force in m/s^2 if the driver is correct. Arrays of 6 are
    gyroscope x y z, then accelerometer x y z.

    Attributes
    ----------
    stamps : StampWindow
        Statistics of the stamps.
    mean, deviation : (6,) array
        Mean and standard deviation.
    vibration : (6,) array
        RMS of the part faster than VIBRATION_CORNER.
    still : (6,) array
        Share of samples equal to the one before, per channel.
    repeated : float
        Share of samples in which all six channels equal the one before.
    clipped : (6,) array
        Number of samples at the farther end of the range of the channel.
    limit : (6,) array
        Value at that end.
    invalid : float
        Share of samples that are not finite.
    """

    stamps: StampWindow
    mean: np.ndarray
    deviation: np.ndarray
    vibration: np.ndarray
    still: np.ndarray
    repeated: float
    clipped: np.ndarray
    limit: np.ndarray
    invalid: float


def new_imu() -> ImuCounters:
    """Return the ImuCounters of a stream without messages."""
    counters = ImuCounters(new_stamps(), np.zeros((6, 10)), np.zeros(3))
    counters.channels[:, :2] = np.nan
    restart_imu(counters)
    return counters


@compiled
def restart_imu(counters: ImuCounters) -> None:
    """Reset the counters for a new window."""
    restart_stamps(counters.stamps)
    counters.channels[:, SUM:] = 0.0
    counters.channels[:, LOW], counters.channels[:, HIGH] = np.inf, -np.inf
    counters.whole[:] = 0.0


@compiled
def count_imu(
    counters: ImuCounters, t: float, arrival: float, gyro: np.ndarray, force: np.ndarray
) -> bool:
    """Count one sample and return whether the window is complete.

    Parameters
    ----------
    counters : ImuCounters
        Changed in place.
    t, arrival : float
        Stamp and arrival time, in s; NaN if unknown.
    gyro, force : (3,) array
        Angular velocity and specific force as in the message.
    """
    s, whole = counters.stamps, counters.whole
    dt = t - s[LAST]
    count_stamp(s, t, arrival)
    sample = (gyro[0], gyro[1], gyro[2], force[0], force[1], force[2])
    for k in range(6):
        if not abs(sample[k]) < ABSURD:
            whole[INVALID] += 1.0
            return complete(s)
    whole[TAKEN] += 1.0
    same = 0
    for k in range(6):
        c, value = counters.channels[k], sample[k]
        if math.isnan(c[SLOW]):
            c[SLOW] = value
        c[SLOW] = low_pass(c[SLOW], value, max(dt, 0.0), VIBRATION_CORNER)
        c[SUM] += value
        c[SQUARES] += value * value
        c[FAST] += (value - c[SLOW]) ** 2
        if value == c[VALUE]:
            c[SAME] += 1.0
            same += 1
        c[VALUE] = value
        if value < c[LOW]:
            c[LOW], c[LOW_HITS] = value, 1.0
        elif value == c[LOW]:
            c[LOW_HITS] += 1.0
        if value > c[HIGH]:
            c[HIGH], c[HIGH_HITS] = value, 1.0
        elif value == c[HIGH]:
            c[HIGH_HITS] += 1.0
    if same == 6:
        whole[REPEATED] += 1.0
    return complete(s)


@compiled
def feed_imu(
    counters: ImuCounters,
    t: np.ndarray,
    arrival: np.ndarray,
    gyro: np.ndarray,
    force: np.ndarray,
    first: int,
) -> tuple[int, bool]:
    """Count rows of arrays from `first` on until a window is complete.

    Returns
    -------
    row : int
        Row after the last counted one.
    complete : bool
        Whether the window is complete.
    """
    for i in range(first, len(t)):
        if count_imu(counters, t[i], arrival[i], gyro[i], force[i]):
            return i + 1, True
    return len(t), False


def imu_window(counters: ImuCounters) -> ImuWindow:
    """Return the ImuWindow of the samples since the window began."""
    c, whole = counters.channels, counters.whole
    n = max(whole[TAKEN], 1.0)
    mean = c[:, SUM] / n
    at_low = mean - c[:, LOW] > c[:, HIGH] - mean
    return ImuWindow(
        stamps=stamp_window(counters.stamps),
        mean=mean,
        deviation=np.sqrt(np.maximum(c[:, SQUARES] / n - mean**2, 0.0)),
        vibration=np.sqrt(c[:, FAST] / n),
        still=c[:, SAME] / n,
        repeated=float(whole[REPEATED] / n),
        clipped=np.where(at_low, c[:, LOW_HITS], c[:, HIGH_HITS]),
        limit=np.where(at_low, c[:, LOW], c[:, HIGH]),
        invalid=float(whole[INVALID] / max(whole[INVALID] + whole[TAKEN], 1.0)),
    )


def force_of(windows: list[ImuWindow]) -> np.ndarray:
    """Return the median over windows of the mean specific force, (3,) m/s^2."""
    return np.median([window.mean[3:] for window in windows], axis=0)


def weight(windows: list[ImuWindow]) -> float:
    """Return the median length of the mean specific force, in m/s^2.

    It equals gravity for any motion within a room, because the mean acceleration is small.
    """
    return median(float(np.linalg.norm(window.mean[3:])) for window in windows)


def steadiness(windows: list[ImuWindow]) -> float:
    """Return the length of the mean specific force divided by the mean of its lengths.

    The value is 1 if the specific force always has the same direction.
    """
    forces = np.array([window.mean[3:] for window in windows])
    return float(
        np.linalg.norm(forces.mean(axis=0)) / max(np.linalg.norm(forces, axis=1).mean(), 1e-9)
    )


def silent(windows: list[ImuWindow]) -> Finding | None:
    """Return a Finding if all samples are equal, because then the sensor is not read."""
    share = median(window.repeated for window in windows)
    if share < DEAD:
        return None
    remedy = "ros2 topic echo imu/data  # the sensor is not read: check its driver"
    evidence = (
        f"{100.0 * share:.0f} % of the samples equal the one before, specific force "
        f"{weight(windows):.2f} m/s^2"
    )
    return Finding(
        "imu_silent", ERROR, "the IMU is silent: its samples do not change", evidence, remedy, share
    )


def repeated(windows: list[ImuWindow]) -> Finding | None:
    share = median(window.repeated for window in windows)
    if not REPEATS < share < DEAD:
        return None
    rate = 1.0 / max(median(window.stamps.step for window in windows), 1e-9)
    measured = rate * (1.0 - share)
    evidence = (
        f"{100.0 * share:.0f} % equal the one before: {rate:.0f} Hz are published, {measured:.0f} "
        "Hz measured"
    )
    remedy = "publish a sample when there is a new one, not by a timer"
    return Finding(
        "imu_repeated",
        WARNING,
        "inertial samples are published more than once",
        evidence,
        remedy,
        share,
    )


def dead_axis(windows: list[ImuWindow]) -> Finding | None:
    still = np.median([window.still for window in windows], axis=0)
    axes = [name for name, share in zip(AXES, still) if share > DEAD]
    if not axes or len(axes) == 6:
        return None
    evidence = f"{100.0 * still.max():.0f} % of its samples equal the one before"
    remedy = (
        "ros2 topic echo imu/data  # compare with the data sheet's registers: an axis is not read "
        "or not copied"
    )
    return Finding(
        "imu_axis_dead",
        ERROR,
        f"{', '.join(axes)} does not change",
        evidence,
        remedy,
        float(len(axes)),
    )


def invalid(windows: list[ImuWindow]) -> Finding | None:
    share = float(np.mean([window.invalid for window in windows]))
    if share < 1e-3:
        return None
    remedy = "do not publish samples that are not finite"
    return Finding(
        "imu_invalid",
        WARNING,
        "inertial samples are not finite",
        f"{100.0 * share:.1f} %",
        remedy,
        share,
    )


def no_gravity(windows: list[ImuWindow]) -> Finding | None:
    """Return a Finding if the driver has subtracted gravity from the acceleration.

    The mean specific force is then small, and the motion outweighs it.
    """
    length = weight(windows)
    motion = median(float(np.linalg.norm(window.deviation[3:])) for window in windows)
    if (
        silent(windows)
        or length > FORCE_RANGE[0]
        or (motion < WEIGHTLESS * length and steadiness(windows) > STEADY)
    ):
        return None
    cause = "gravity was taken out of the acceleration; specific force, with gravity, is needed"
    evidence = (
        f"the specific force is {length:.2g} on average, and deviates by {motion:.2g}; it should "
        "be 9.81 m/s^2"
    )
    line = (
        "/imu/data_raw:=/imu/data  # publish what the accelerometer reads, not linear acceleration"
    )
    return Finding("imu_no_gravity", ERROR, cause, evidence, line, length)


def force_unit(windows: list[ImuWindow]) -> Finding | None:
    """Return a Finding if the mean specific force is not 9.81 m/s^2 long."""
    length = weight(windows)
    if FORCE_RANGE[0] <= length <= FORCE_RANGE[1] or silent(windows) or no_gravity(windows):
        return None
    evidence = f"the specific force is {length:.3g} on average, and should be 9.81 m/s^2"
    for unit, (scale, low, high) in FORCE_UNITS.items():
        if low <= length <= high:
            line = (
                f"for axis in 'xyz': setattr(a, axis, {scale:g} * getattr(a, axis))  # a = "
                "message.linear_acceleration"
            )
            return Finding(
                "imu_force_unit",
                ERROR,
                f"the accelerometer is in {unit}, not in m/s^2",
                evidence,
                line,
                scale,
            )
    line = (
        f"scale linear_acceleration by {GRAVITY / length:.4g}, after a look at the sensor's range "
        "setting"
    )
    return Finding(
        "imu_force_unit",
        ERROR,
        "the accelerometer is not in m/s^2",
        evidence,
        line,
        GRAVITY / length,
    )


def rate_unit(windows: list[ImuWindow]) -> Finding | None:
    """Return a Finding if gravity does not rotate as the gyroscope does.

    A rotation about a horizontal axis rotates gravity in the body frame. A gyroscope that
    contradicts this is not in rad/s.
    """
    excess = turn_excess(windows)
    if not excess > TURN_EXCESS:
        return None
    evidence = f"{excess:.2f} rad/s of turning that gravity does not follow"
    if resting(windows):
        cause = (
            "the gyroscope turns at rest: its bias is large, or it is not in rad/s; a tag at rest "
            "does not determine which"
        )
        remedy = (
            "calibrate the gyroscope at rest, look at its unit in the data sheet, and check a "
            "recording in motion"
        )
        return Finding("imu_rate_offset", WARNING, cause, evidence, remedy, excess)
    line = (
        "for axis in 'xyz': setattr(w, axis, math.radians(getattr(w, axis)))  # w = "
        "message.angular_velocity"
    )
    return Finding(
        "imu_rate_unit",
        ERROR,
        "the gyroscope is in degrees/s, not in rad/s",
        evidence,
        line,
        excess,
    )


def resting(windows: list[ImuWindow]) -> bool:
    """Return whether the specific force neither changes nor rotates.

    At rest, the data determine only the bias of a gyroscope.
    """
    shakes = median(float(np.linalg.norm(window.deviation[3:])) for window in windows)
    ups = np.array(
        [window.mean[3:] / max(np.linalg.norm(window.mean[3:]), 1e-9) for window in windows]
    )
    return shakes < REST_SHAKES * weight(windows) and bool(
        np.linalg.norm(ups - np.median(ups, axis=0), axis=1).max() < REST_TURNS
    )


def turn_excess(windows: list[ImuWindow]) -> float:
    """Return the rotation rate that the specific force does not follow, in rad/s.

    For each pair of successive windows, it is the rate about horizontal axes minus the rotation
    rate of the specific force. The result is the median over pairs, or NaN without pairs.
    """
    values = []
    for one, two in zip(windows, windows[1:]):
        time = 0.5 * (two.stamps.end - one.stamps.begin)
        up, then = (w.mean[3:] / max(np.linalg.norm(w.mean[3:]), 1e-9) for w in (one, two))
        rate = 0.5 * (one.mean[:3] + two.mean[:3])
        across = np.linalg.norm(rate - up * (rate @ up))
        if time > 0.0:
            values.append(across - np.arccos(np.clip(up @ then, -1.0, 1.0)) / time)
    return median(values)


def upright(windows: list[ImuWindow]) -> Finding | None:
    """Return a Finding if the mean specific force does not point along +z.

    At rest, and on average in flight, the accelerometer of an upright tag reads +9.81 m/s^2 on z.
    Sound recordings are tilted by 22 degrees at most, with vibration.
    """
    force = force_of(windows)
    length = np.linalg.norm(force)
    # a short mean also means that the tag tumbles
    if length < 0.5 * weight(windows) or silent(windows) or no_gravity(windows):
        return None
    up = force / length
    if up[2] >= UPRIGHT:
        return None
    evidence = (
        f"mean specific force ({force[0]:+.2f}, {force[1]:+.2f}, {force[2]:+.2f}); upright it is "
        "(0, 0, +9.81)"
    )
    k = int(np.argmax(np.abs(up)))
    if abs(up[k]) < AXIS:
        tilt = float(np.rad2deg(np.arccos(np.clip(up[2], -1.0, 1.0))))
        remedy = "turn the samples into base_link (x forward, y left, z up) in the driver"
        return Finding(
            "imu_tilted",
            WARNING,
            f"the IMU is tilted by {tilt:.0f} degrees",
            evidence,
            remedy,
            tilt,
        )
    axis = ("-" if up[k] < 0.0 else "+") + "xyz"[k]
    line = (
        f"x, y, z = {TURNS[axis]}  # of both sensors, in the driver: {axis} is up in what it reads"
    )
    cause = f"the IMU is turned: {axis} points up, where base_link has +z"
    return Finding("imu_turned", ERROR, cause, evidence, line, float(k))


TURNS = {"-z": "x, -y, -z", "+x": "-z, y, x", "-x": "z, y, -x", "+y": "x, -z, y", "-y": "x, z, -y"}


def shaking(windows: list[ImuWindow]) -> Finding | None:
    """Return a Finding if vibration makes the accelerometer rectify, which shifts its mean."""
    rms = np.median([window.vibration[3:] for window in windows], axis=0)
    k = int(np.argmax(rms))
    if rms[k] < SHAKING:
        return None
    mean = ", ".join(f"{v:+.1f}" for v in force_of(windows))
    evidence = f"{rms[k]:.1f} m/s^2 rms on {'xyz'[k]}, mean specific force ({mean})"
    cause = "the accelerometer shakes, and what it reads on average is wrong then"
    remedy = (
        "put the board on foam, balance the propellers; the filter believes the axis less "
        "(vibration_gain)"
    )
    return Finding("imu_shaking", WARNING, cause, evidence, remedy, float(rms[k]))


def clipped(windows: list[ImuWindow]) -> Finding | None:
    """Return a Finding if many samples are at one far end of the range."""
    far = np.array([FAR_RATE] * 3 + [FAR_FORCE] * 3)
    hits = np.array(
        [np.where(abs(w.limit - w.mean) > far, w.clipped * (1.0 - w.still), 0.0) for w in windows]
    )
    hits[hits < CLIPPED] = 0.0
    k = int(np.argmax(hits.sum(axis=0)))
    if not hits[:, k].any():
        return None
    limit = windows[int(np.argmax(hits[:, k]))].limit[k]
    evidence = f"{int(hits[:, k].sum())} samples of {limit:.2f}"
    remedy = "set the sensor to a larger range"
    return Finding("imu_clipped", WARNING, f"{AXES[k]} is clipped", evidence, remedy, float(limit))


RULES = (
    silent,
    repeated,
    dead_axis,
    invalid,
    no_gravity,
    force_unit,
    rate_unit,
    upright,
    shaking,
    clipped,
)
