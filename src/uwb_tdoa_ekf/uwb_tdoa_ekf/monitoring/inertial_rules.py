# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check the values of an inertial stream.

A rule takes windows and yields Findings.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uwb_tdoa_bias.common.arrays import rotations

from ..core.imu_fault_detector import AXIS, FASTEST, UPRIGHT
from ..core.state import GRAVITY
from .finding import ERROR, WARNING, Finding, Limit
from .stamp_rules import median
from .windows import ImuWindow

# m/s^2, limits of the median length of the mean specific force; healthy 9.7 - 10.5
FORCE_RANGE = 7.0, 14.0
FORCE_UNITS = {
    "g": (GRAVITY, 0.7, 1.5),
    "mg": (1e-3 * GRAVITY, 700.0, 1500.0),
    "mm/s^2": (1e-3, 7e3, 14e3),
}
# standard deviation over root mean square of the specific force above which it has no gravity; healthy
# 0.38 at most
WEIGHTLESS = 0.55
# length of the mean specific force over the mean of its lengths; healthy 0.96 at least
STEADY = 0.8
# In 31 measured and simulated recordings without gravity, the deviation exceeds WEIGHTLESS, or the
# steadiness is 0.73 at most.
TURN_EXCESS = 0.35
# Windows over which rates are integrated, because the bias of a gyroscope turns the result, and
# least `steadiness` in the world: 0.97 in tilted turns; 0.87 at most with rates in degrees/s.
SPAN, AS_GRAVITY = 20, 0.9
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


def force_of(windows: list[ImuWindow]) -> np.ndarray:
    """Return the median over windows of the mean specific force, (3,) m/s^2."""
    return np.median([window.mean[3:] for window in windows], axis=0)


def weight(windows: list[ImuWindow]) -> float:
    """Return the median root mean square of the specific force, in m/s^2.

    It is near gravity for any motion within a room, because accelerations are small on average. A tag
    that tumbles turns gravity over within a window: the mean of the specific force is then small.
    """
    return median(float(np.linalg.norm([w.mean[3:], w.deviation[3:]])) for w in windows)


def shakes(windows: list[ImuWindow]) -> float:
    """Return the median over windows of the standard deviation of the specific force, in m/s^2."""
    return median(float(np.linalg.norm(window.deviation[3:])) for window in windows)


def up_in(window: ImuWindow) -> np.ndarray:
    """Return the direction of the mean specific force, (3,)."""
    force = window.mean[3:]
    return force / max(np.linalg.norm(force), 1e-9)


def steadiness(windows: list[ImuWindow]) -> float:
    """Return the length of the mean specific force divided by the mean of its lengths.

    The value is 1 if the specific force always has the same direction.
    """
    return _agreement(np.array([window.mean[3:] for window in windows]))


def _agreement(forces: np.ndarray) -> float:
    """Return the length of the mean of forces (n, 3) over the mean of their lengths."""
    return float(
        np.linalg.norm(forces.mean(axis=0)) / max(np.linalg.norm(forces, axis=1).mean(), 1e-9)
    )


def silent(windows: list[ImuWindow]) -> Iterator[Finding]:
    """Yield a Finding if all samples are equal, because then the sensor is not read."""
    share = median(window.repeated for window in windows)
    if share >= DEAD:
        yield Finding(
            "imu_silent",
            ERROR,
            cause="the IMU is silent: its samples do not change",
            evidence=(
                f"{100.0 * share:.0f} % of the samples equal the one before, specific force "
                f"{weight(windows):.2f} m/s^2"
            ),
            remedy="ros2 topic echo imu/data  # the sensor is not read: check its driver",
            value=share,
        )


def repeated(windows: list[ImuWindow]) -> Iterator[Finding]:
    share = median(window.repeated for window in windows)
    if REPEATS < share < DEAD:
        rate = 1.0 / max(median(window.stamps.step for window in windows), 1e-9)
        yield Finding(
            "imu_repeated",
            WARNING,
            cause="inertial samples are published more than once",
            evidence=(
                f"{100.0 * share:.0f} % equal the one before: {rate:.0f} Hz are published, "
                f"{rate * (1.0 - share):.0f} Hz measured"
            ),
            remedy="publish a sample when there is a new one, not by a timer",
            value=share,
        )


def dead_axis(windows: list[ImuWindow]) -> Iterator[Finding]:
    still = np.median([window.still for window in windows], axis=0)
    axes = [name for name, share in zip(AXES, still) if share > DEAD]
    if 0 < len(axes) < 6:
        yield Finding(
            "imu_axis_dead",
            ERROR,
            cause=f"{', '.join(axes)} does not change",
            evidence=f"{100.0 * still.max():.0f} % of its samples equal the one before",
            remedy=(
                "ros2 topic echo imu/data  # compare with the data sheet's registers: an axis is "
                "not read or not copied"
            ),
            value=float(len(axes)),
        )


in_turns = Limit(
    "imu_in_turns",
    ERROR,
    "gyroscope and accelerometer come in turns: in each message one of them is zero",
    "{:.0f} % of the samples have one of them alone",
    "publish both in one message, or a covariance of -1 for what it does not have",
    REPEATS,
    lambda windows: median(window.halves for window in windows),
)
invalid = Limit(
    "imu_invalid",
    WARNING,
    "inertial samples are not finite",
    "{:.1f} %",
    "do not publish samples that are not finite",
    1e-3,
    lambda windows: float(np.mean([window.invalid for window in windows])),
)


def no_gravity(windows: list[ImuWindow]) -> Iterator[Finding]:
    """Yield a Finding if the driver has subtracted gravity from the acceleration.

    The mean specific force is then small, and the motion outweighs it.
    """
    length, motion = weight(windows), shakes(windows)
    outweighed = not motion < WEIGHTLESS * length or not steadiness(windows) > STEADY
    if outweighed and length <= FORCE_RANGE[0]:
        yield Finding(
            "imu_no_gravity",
            ERROR,
            cause=(
                "gravity was taken out of the acceleration; specific force, with gravity, is needed"
            ),
            evidence=(
                f"the specific force is {length:.2g} on average, and deviates by {motion:.2g}; it "
                "should be 9.81 m/s^2"
            ),
            remedy=(
                "/imu/data_raw:=/imu/data  # publish what the accelerometer reads, not linear "
                "acceleration"
            ),
            value=length,
        )


def force_unit(windows: list[ImuWindow]) -> Iterator[Finding]:
    """Yield a Finding if the mean specific force is not 9.81 m/s^2 long."""
    length = weight(windows)
    if FORCE_RANGE[0] <= length <= FORCE_RANGE[1]:
        return
    scale = GRAVITY / max(length, 1e-9)
    cause = "the accelerometer is not in m/s^2"
    remedy = f"scale linear_acceleration by {scale:.4g}, after a look at the sensor's range setting"
    for unit, (its_scale, low, high) in FORCE_UNITS.items():
        if low <= length <= high:
            scale = its_scale
            cause = f"the accelerometer is in {unit}, not in m/s^2"
            remedy = (
                f"for axis in 'xyz': setattr(a, axis, {scale:g} * getattr(a, axis))  # a = "
                "message.linear_acceleration"
            )
    yield Finding(
        "imu_force_unit",
        ERROR,
        cause=cause,
        evidence=f"the specific force is {length:.3g} on average, and should be 9.81 m/s^2",
        remedy=remedy,
        value=scale,
    )


def rate_unit(windows: list[ImuWindow]) -> Iterator[Finding]:
    """Yield a Finding if gravity does not rotate as the gyroscope does.

    A rotation about a horizontal axis rotates gravity in the body frame. A gyroscope that
    contradicts this is not in rad/s. The specific force of a multirotor that turns while it is
    tilted stays in its z axis, though. In the world, it averages to gravity.
    """
    excess = turn_excess(windows)
    evidence = f"{excess:.2f} rad/s of turning that gravity does not follow"
    if not excess > TURN_EXCESS:
        return
    if resting(windows):
        yield Finding(
            "imu_rate_offset",
            WARNING,
            cause=(
                "the gyroscope turns at rest: its bias is large, or it is not in rad/s; a tag at "
                "rest "
                "does not determine which"
            ),
            evidence=evidence,
            remedy=(
                "calibrate the gyroscope at rest, look at its unit in the data sheet, and check a "
                "recording in motion"
            ),
            value=excess,
        )
    elif not _averages_to_gravity(windows):
        yield Finding(
            "imu_rate_unit",
            ERROR,
            cause="the gyroscope is in degrees/s, not in rad/s",
            evidence=evidence,
            remedy=(
                "for axis in 'xyz': setattr(w, axis, math.radians(getattr(w, axis)))  # w = "
                "message.angular_velocity"
            ),
            value=excess,
        )


def resting(windows: list[ImuWindow]) -> bool:
    """Return whether the specific force neither changes nor rotates.

    At rest, the data determine only the bias of a gyroscope.
    """
    ups = np.array([up_in(window) for window in windows])
    turned = np.linalg.norm(ups - np.median(ups, axis=0), axis=1)
    return shakes(windows) < REST_SHAKES * weight(windows) and bool(turned.max() < REST_TURNS)


def turn_excess(windows: list[ImuWindow]) -> float:
    """Return the rotation rate that the specific force does not follow, in rad/s.

    For each pair of successive windows, it is the rate about horizontal axes minus the rotation
    rate of the specific force. The result is the median over pairs, or NaN without pairs.
    """
    values = []
    for one, two in zip(windows, windows[1:]):
        time = 0.5 * (two.stamps.end - one.stamps.begin)
        up, then = up_in(one), up_in(two)
        rate = 0.5 * (one.mean[:3] + two.mean[:3])
        across = np.linalg.norm(rate - up * (rate @ up))
        if time > 0.0:
            values.append(across - np.arccos(np.clip(up @ then, -1.0, 1.0)) / time)
    return median(values)


def _averages_to_gravity(windows: list[ImuWindow]) -> bool:
    """Return whether the specific force has one direction in the world, and a tag can turn so fast.

    The rates are integrated to turn the specific force into the world.
    """
    if not median(float(np.linalg.norm(window.mean[:3])) for window in windows) < FASTEST:
        return False
    spans = []
    for first in range(0, len(windows), SPAN):
        turn, forces = rotations.Rotation.identity(), []
        for window in windows[first : first + SPAN]:
            half = 0.5 * (window.stamps.end - window.stamps.begin) * window.mean[:3]
            middle = turn * rotations.Rotation.from_rotvec(half)
            turn = middle * rotations.Rotation.from_rotvec(half)
            forces.append(middle.apply(window.mean[3:]))
        spans.append(_agreement(np.array(forces)))
    return median(spans) > AS_GRAVITY


def upright(windows: list[ImuWindow]) -> Iterator[Finding]:
    """Yield a Finding if the mean specific force does not point along +z.

    At rest, and on average in flight, the accelerometer of an upright tag reads +9.81 m/s^2 on z.
    Sound recordings are tilted by 22 degrees at most, with vibration.
    """
    force = force_of(windows)
    length = np.linalg.norm(force)
    # a short mean also means that the tag tumbles
    if length <= 0.5 * weight(windows) or force[2] >= UPRIGHT * length:
        return
    up = force / length
    k = int(np.argmax(np.abs(up)))
    evidence = (
        f"mean specific force ({force[0]:+.2f}, {force[1]:+.2f}, {force[2]:+.2f}); upright it is "
        "(0, 0, +9.81)"
    )
    if abs(up[k]) < AXIS:
        tilt = float(np.rad2deg(np.arccos(np.clip(up[2], -1.0, 1.0))))
        yield Finding(
            "imu_tilted",
            WARNING,
            cause=f"the IMU is tilted by {tilt:.0f} degrees",
            evidence=evidence,
            remedy="turn the samples into base_link (x forward, y left, z up) in the driver",
            value=tilt,
        )
    else:
        axis = ("-" if up[k] < 0.0 else "+") + "xyz"[k]
        yield Finding(
            "imu_turned",
            ERROR,
            cause=f"the IMU is turned: {axis} points up, where base_link has +z",
            evidence=evidence,
            remedy=(
                f"x, y, z = {TURNS[axis]}  # of both sensors, in the driver: {axis} is up in what "
                "it reads"
            ),
            value=float(k),
        )


TURNS = {"-z": "x, -y, -z", "+x": "-z, y, x", "-x": "z, y, -x", "+y": "x, -z, y", "-y": "x, z, -y"}


def shaking(windows: list[ImuWindow]) -> Iterator[Finding]:
    """Yield a Finding if vibration makes the accelerometer rectify, which shifts its mean."""
    rms = np.median([window.vibration[3:] for window in windows], axis=0)
    k = int(np.argmax(rms))
    if rms[k] >= SHAKING:
        mean = ", ".join(f"{v:+.1f}" for v in force_of(windows))
        yield Finding(
            "imu_shaking",
            WARNING,
            cause="the accelerometer shakes, and what it reads on average is wrong then",
            evidence=f"{rms[k]:.1f} m/s^2 rms on {'xyz'[k]}, mean specific force ({mean})",
            remedy=(
                "put the board on foam, balance the propellers; the filter believes the axis less "
                "(vibration_gain)"
            ),
            value=float(rms[k]),
        )


def clipped(windows: list[ImuWindow]) -> Iterator[Finding]:
    """Yield a Finding if many samples are at one far end of the range."""
    far = np.array([FAR_RATE] * 3 + [FAR_FORCE] * 3)
    hits = np.array(
        [np.where(abs(w.limit - w.mean) > far, w.clipped * (1.0 - w.still), 0.0) for w in windows]
    )
    hits[hits < CLIPPED] = 0.0
    k = int(np.argmax(hits.sum(axis=0)))
    if hits[:, k].any():
        limit = windows[int(np.argmax(hits[:, k]))].limit[k]
        yield Finding(
            "imu_clipped",
            WARNING,
            cause=f"{AXES[k]} is clipped",
            evidence=f"{int(hits[:, k].sum())} samples of {limit:.2f}",
            remedy="set the sensor to a larger range",
            value=float(limit),
        )


RULES = (
    silent,
    in_turns,
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
