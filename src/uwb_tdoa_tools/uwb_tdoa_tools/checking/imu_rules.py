# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test whether the inertial sensor fits the TDOAs, and whether its values are clipped or smooth.

Each arrangement of axes and each unit of the rates is tried: a filter that relies on the sensor
shows by its innovations which one fits. A rotation of both sensors about the vertical cannot be
seen, because the yaw is unknown. Nor can a sign about an axis about which the tag did not turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.flight import Flight, Imu
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.imu_fault_detector import FASTEST
from uwb_tdoa_ekf.monitoring.explain import Unexplained, compare, in_words
from uwb_tdoa_ekf.monitoring.finding import ERROR, WARNING, Finding
from uwb_tdoa_ekf.monitoring.inertial_rules import AXES, TURN_EXCESS, turn_excess
from uwb_tdoa_ekf.monitoring.windows import Cutter, imu_window

from .ordered import OrderedRecording, Trial, is_flat

# Clipped: at least HITS samples have the extreme value, more than MORE times the mean count of the
# NEXT values beside it. In healthy recordings it is about 1 time.
HITS, MORE, NEXT = 20, 5.0, 5
# s; limit of the mean square of a step, over the least that the change in FAR permits. Healthy: 2.9
# at least, except a smooth log of 0607, which fits its ground truth. Behind a low pass of 50 ms: 2.4.
FAR, EVEN = 0.02, 2.6
FEWEST = 10  # samples within FAR that a judgement needs


def clipped_axes(flight: Flight) -> Iterator[Finding]:
    """Yield the Finding on the first axis with many samples at its largest or smallest value, if any."""
    assert flight.imu is not None
    # AXES has the axes of the gyroscope, then of the accelerometer, as these columns.
    for name, column in zip(AXES, np.column_stack([flight.imu.gyro, flight.imu.accel]).T):
        values, counts = np.unique(column, return_counts=True)
        unit = "rad/s" if name.startswith("gyro") else "m/s^2"
        for ends, hits in ((values, counts), (values[::-1], counts[::-1])):
            if len(ends) > NEXT and hits[0] >= HITS and hits[0] > MORE * hits[1 : 1 + NEXT].mean():
                yield Finding(
                    "imu_clipped",
                    WARNING,
                    cause=f"{name} is clipped",
                    evidence=(
                        f"{hits[0]} samples of {ends[0]:.2f} {unit}, "
                        f"{hits[1 : 1 + NEXT].mean():.0f} of each "
                        "of the next values"
                    ),
                    remedy="set the sensor to a larger range",
                    value=float(ends[0]),
                )
                return


def is_smooth(t: np.ndarray, values: np.ndarray) -> bool:
    """Return whether a sensor changes so evenly, on all axes, as only behind a low pass.

    The mean square of a step is then at least 1/k^2 of the mean square change in FAR, which k steps
    span. False for a slow sensor, which does not show it.

    Parameters
    ----------
    t : (n,) array
        Stamps, s.
    values : (n, 3) array
        Readings.
    """
    steps = round(FAR / max(np.median(np.diff(t)), 1e-6))
    if steps < FEWEST or len(t) <= steps:
        return False
    one = np.mean(np.diff(values, axis=0) ** 2, axis=0)
    far = np.mean((values[steps:] - values[:-steps]) ** 2, axis=0)
    return bool((one * steps**2 < EVEN * far).all())


# s that are tried, to be sure and to choose; Hz to which the samples are averaged
PART, BRIEF, RATE = 30.0, 14.0, 200.0
SLOWEST = 50.0  # Hz; slower sensors are not judged
# This filter relies on the IMU: a TDOA counts as a hundredth of one of the default tdoa_std, and the
# bias of the accelerometer may be large.
LEANING = FilterConfig(tdoa_std=2.5, adapt_noise=False, initial_accel_bias_std=0.5)
# ratio of the remaining loss, and its standard errors; healthy flights: 0.98 at least in any trial
RATIO, DEVIATIONS = 0.9, 2.5
# Ratio of the losses of the default filter with the inertial sensor as it is and without: up to here it
# fits. Simulated sound sensors 1.03 at most, but for one outside of the anchors with 1.05, within a
# standard error of 1; wrong ones on four measured flights 1.05 at least, by 1.3 standard errors or more.
FITS = 1.04
# Largest ratio to the loss without the inertial sensor: the right arrangement leaves up to 1.17
# times as much on six measured flights. In sound recordings in which the filter leans on it wrongly,
# others leave 1.67 times as much or more.
AS_WITHOUT = 1.3
# IMU of another body: largest ratio of the loss without the sensor. Where the sensor does not fit,
# sound ones have 1.05 at least (simulated) and 0.91 (measured), exchanged ones 0.86 at most with few
# exceptions. Where it fits, outside of the anchors, sound ones have 0.67.
NEEDLESS = 0.85
MOVED = 0.3  # m, standard deviation of positions in motion; measured flights 1.2 at least
TIE = 0.03  # ratios this close are equal: the simplest arrangement is taken
# length of the mean specific force over its root mean square; a tag with less tumbles
LEAST_MEAN = 0.5
CHOSEN = 8  # arrangements that are tried on the longer part
MOST_EQUAL = 8  # arrangements that explain equally much: more of them determine nothing
# Axes of a survey that may point up, as (number of the axis, sign, whether the survey is mirrored)
UPWARDS = [up for up in product(range(3), (1, -1), (False, True)) if up != (2, 1, False)]
BELOW = -0.05  # m, height of the highest anchor below which all are below the floor
NEARLY = 2.0 * TIE  # a second fault, e.g. a useless gyroscope, may explain a little more
UPRIGHT, MIRROR = np.eye(3), np.diag([1.0, -1.0, 1.0])
# Axes that are exchanged or mirrored, as (3, 3) matrices that undo it; the first is as it is.
ARRANGEMENTS = [
    np.diag(signs)[list(order)]
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3))
]
RATE_UNIT = "imu_rate_unit"
# Factors of the gyroscope, and its unit then. (Degrees/s are seen in the stream itself.)
SCALES = {
    180.0 / np.pi: "rad/s, divided by 57.3 once too often",
    2.0 * np.pi: "revolutions/s, not rad/s",
}


# The most frequent mistakes: matrices of the accelerometer and of the gyroscope that undo each.
USUAL = [
    *((UPRIGHT, np.diag(signs)) for signs in list(product((1.0, -1.0), repeat=3))[1:]),
    (UPRIGHT, UPRIGHT[[1, 0, 2]]),
    (MIRROR, UPRIGHT),
    (MIRROR, MIRROR),
    (MIRROR, -MIRROR),
    *((UPRIGHT, scale * UPRIGHT) for scale in SCALES),
]


class Arrangement(NamedTuple):
    """A trial of axes and units of the inertial sensor.

    Attributes
    ----------
    ratio, z : float
        Ratio of the losses, and its number of standard errors.
    mistakes : float
        How many mistakes the arrangement consists of.
    trial : Trial
        The recording in this arrangement.
    """

    ratio: float
    z: float
    mistakes: float
    trial: Trial


def find_imu_mistake(recording: OrderedRecording) -> Finding | None:
    """Return the Finding about axes or units of the IMU that do not fit the TDOAs, or None.

    The TDOAs of the OrderedRecording must be right. The usual mistakes are tried first, and all
    arrangements of the axes only if one of them helps. None is tried if the default filter is not worse
    with the sensor than without it. None is tried with anchors in a plane: the tag
    may be on its other side, and its image contradicts a sound sensor. If none helps, the sensor may
    be on another body.
    """
    brief = replace(recording, imu=averaged(recording.imu)).part(PART)
    if (
        brief.imu is None
        or len(brief.imu) < SLOWEST * PART / 2.0
        or not has_moved(recording.survey_fit.places)
        or is_flat(recording.anchors.positions)
        or _tumbles(brief.imu)
    ):
        return None
    worse, z = compare(brief.unexplained(), brief.unexplained(config=FilterConfig()))
    if not (worse > FITS and z < -1.0):
        return None
    base = brief.unexplained(config=LEANING)
    left_out = compare(base, brief.unexplained(config=replace(LEANING, use_imu=False)))
    found = _wrong_arrangement(brief, base, min(RATIO, AS_WITHOUT * left_out[0]))
    if found is None and left_out[0] < NEEDLESS and left_out[1] > DEVIATIONS:
        found = Finding(
            "imu_other_body",
            ERROR,
            cause="IMU and TDOAs are not of one body, or not of one time: no axes and no unit help",
            evidence=f"without the IMU {in_words(*left_out)}",
            remedy=(
                "ros2 topic info --verbose imu/data  # its publisher must be the tag of uwb/tdoa; "
                "fix the sensor to the tag, and stamp both with one clock"
            ),
            value=left_out[0],
        )
    return found


def _tumbles(imu: Imu) -> bool:
    """Return whether the specific force has no direction on average: no filter finds what is up."""
    mean, square = imu.accel.mean(axis=0), np.mean(np.sum(imu.accel**2, axis=1))
    return bool(np.linalg.norm(mean) < LEAST_MEAN * np.sqrt(square))


def _wrong_arrangement(brief: OrderedRecording, base: Unexplained, most: float) -> Finding | None:
    """Return the Finding about axes or units that explain enough, or None.

    most : largest ratio of the losses that may remain
    """
    assert brief.imu is not None
    usual = [(accel, gyro) for accel, gyro in USUAL if _is_possible(brief.imu, gyro)]
    trials = [_tried(base, brief, accel, gyro) for accel, gyro in usual]
    least = min(one.ratio for one in trials)
    turned = _turned_survey(base, brief, min(least + NEARLY, most))
    if turned is not None or not least < RATIO:
        return turned
    if min(trials, key=lambda one: one.ratio).trial.finding.rule != RATE_UNIT:
        trials += _all(brief, base)  # the unit of the rates is right: an axis is wrong
    least = min(one.ratio for one in trials)
    equal = [one for one in trials if one.ratio < least + TIE and one.z > DEVIATIONS]
    if not 0 < len(equal) <= MOST_EQUAL or least > most:
        return None
    simplest = min(equal, key=lambda one: one.mistakes)
    found = simplest.trial.explained(simplest.ratio, simplest.z)
    if len(equal) > 1:
        more = f"; {len(equal) - 1} other arrangements fit about as well"
        found = replace(found, evidence=found.evidence + more)
    return found


def _is_possible(imu: Imu, gyro: np.ndarray) -> bool:
    """Return whether a tag can turn as a corrected gyroscope says, and gravity turns with it.

    A filter drops a gyroscope that is too large. That would explain whatever the sensor contradicts.
    """
    if abs(scale_of(gyro) - 1.0) < 0.03:
        return True
    rates = imu.gyro @ gyro.T
    cut = Cutter().cut(imu.t, np.full(len(imu), np.nan), rates, imu.accel)
    windows = [imu_window(*window) for window in cut]
    fastest = np.quantile(np.linalg.norm(rates, axis=1), 0.99)
    return bool(fastest < FASTEST) and not turn_excess(windows) > TURN_EXCESS


def _turned_survey(base: Unexplained, recording: OrderedRecording, most: float) -> Finding | None:
    """Return the Finding that z of the survey is not up, or None.

    Systems that survey their own anchors lay the plane z = 0 through three of them, not on the
    floor. Motion capture and game engines have y up. A mirror image with z up competes too, but the
    arrangements of the IMU name it.

    most : largest ratio of the losses that may remain
    """
    places, better = recording.anchors.positions, {}
    for up in UPWARDS:
        turned = replace(recording, anchors=recording.anchors.at(places @ _upright(*up).T))
        ratio, z = compare(base, turned.unexplained(RATIO * base.mean, LEANING))
        if ratio < most and z > DEVIATIONS:
            better[up] = ratio, z
    least = min(better.values(), default=(np.inf, 0.0))[0]
    alike = [up for up, (ratio, _) in better.items() if ratio < least + TIE]
    if not alike:
        return None

    def mistakes(up: tuple[int, int, bool]) -> tuple[bool, bool, float]:
        """Return whether all anchors are below the floor then, whether it mirrors, and the ratio.

        Level motion does not show what is up and what is down.
        """
        heights = (places @ _upright(*up).T)[:, 2]
        return bool(heights.max() < BELOW), up[2], better[up][0]

    axis, sign, mirrored = min(alike, key=mistakes)
    if (axis, sign) == (2, 1):
        return None
    ratio, z = better[axis, sign, mirrored]
    name, where = "xyz"[axis], "up" if sign > 0 else "down"
    axes = ", and its axes are left-handed" * mirrored
    turn = ", ".join(map(signed_axis, _upright(axis, sign, mirrored)))
    return Finding(
        "survey_upside_down",
        ERROR,
        cause=(
            f"{name} of the survey points {where}{axes}: the inertial sensor measures where up is"
        ),
        evidence=in_words(ratio, z),
        remedy=f"x, y, z = {turn}  # of every anchor"
        + "; in a profile: world: ned" * ((axis, sign, mirrored) == (2, -1, False)),
        value=ratio,
    )


def _upright(axis: int, sign: int, mirrored: bool) -> np.ndarray:
    """Return the matrix (3, 3) that turns an axis of a survey up, or down, and mirrors it or not."""
    others = [(axis + 1) % 3, (axis + 2) % 3]
    if mirrored != (sign < 0):
        others.reverse()
    return np.eye(3)[[*others, axis]] * [[1.0], [1.0], [sign]]


def has_moved(places: np.ndarray) -> bool:
    """Return whether a tag at positions (k, 3) m has moved.

    TDOAs of a tag at rest show nothing about the inertial sensor.
    """
    return len(places) > 0 and bool(np.sqrt(np.sum(np.var(places, axis=0))) > MOVED)


def averaged(imu: Imu | None) -> Imu | None:
    """Return the Imu averaged to about RATE, or as it is; None stays None."""
    if imu is None or len(imu) < 2:
        return None
    count = max(1, round((len(imu) - 1) / max(imu.t[-1] - imu.t[0], 1e-9) / RATE))
    rows = len(imu) // count * count
    columns = (
        column[:rows].reshape(-1, count, *column.shape[1:]).mean(axis=1)
        for column in (imu.t, imu.gyro, imu.accel)
    )
    return Imu(*map(np.ascontiguousarray, columns))


def _all(recording: OrderedRecording, base: Unexplained) -> list[Arrangement]:
    """Return trials of all arrangements of the gyroscope, and of their mirror images.

    The accelerometer is fixed, because the yaw is unknown anyway.
    """
    short = recording.part(BRIEF)
    arrangements = list(product((UPRIGHT, MIRROR), ARRANGEMENTS))
    losses: list[float] = []
    for accel, gyro in arrangements:
        least = sorted(losses)[CHOSEN - 1] if len(losses) >= CHOSEN else np.inf
        loss = _arranged(short, accel, gyro).recording.unexplained(least, LEANING).mean
        losses.append(loss if np.isfinite(loss) else np.inf)
    chosen = [arrangements[k] for k in np.argsort(losses, kind="stable")[:CHOSEN]]
    return [_tried(base, recording, accel, gyro) for accel, gyro in chosen]


def _tried(
    base: Unexplained, recording: OrderedRecording, accel: np.ndarray, gyro: np.ndarray
) -> Arrangement:
    """Return the loss of an arrangement in comparison with `base`.

    The ratio is infinite if the loss is too large for the arrangement to be taken, or to tie.
    """
    trial = _arranged(recording, accel, gyro)
    ratio, z = compare(base, trial.recording.unexplained((RATIO + TIE) * base.mean, LEANING))
    ratio = ratio if np.isfinite(ratio) else np.inf
    return Arrangement(ratio, z, _complexity(accel, gyro), trial)


def _arranged(recording: OrderedRecording, accel: np.ndarray, gyro: np.ndarray) -> Trial:
    """Return the Trial with samples rotated by (3, 3) matrices."""
    assert recording.imu is not None
    forces, rates = recording.imu.accel @ accel.T, recording.imu.gyro @ gyro.T
    other = recording.with_imu(accel=np.ascontiguousarray(forces), gyro=np.ascontiguousarray(rates))
    return Trial(other, _finding(accel, gyro))


def _complexity(accel: np.ndarray, gyro: np.ndarray) -> float:
    """Return how many mistakes an arrangement consists of."""
    if np.array_equal(accel, MIRROR) and (
        np.array_equal(gyro, MIRROR) or np.array_equal(gyro, -MIRROR)
    ):
        return 1.5
    wrong_signs = np.count_nonzero(gyro.sum(axis=1) < 0.0)
    moved = np.count_nonzero(np.diag(gyro) == 0.0)
    return wrong_signs + moved + 1.0 * np.array_equal(accel, MIRROR)


def _finding(accel: np.ndarray, gyro: np.ndarray) -> Finding:
    """Return what to report, without evidence, if (3, 3) matrices undo the mistake."""
    scale = scale_of(gyro)
    unit = next((name for value, name in SCALES.items() if abs(value / scale - 1.0) < 1e-6), None)
    if unit:
        return Finding(
            RATE_UNIT,
            ERROR,
            cause=f"the gyroscope is in {unit}",
            evidence="",
            remedy=(
                f"for axis in 'xyz': setattr(w, axis, {scale:.6g} * getattr(w, axis))  # w = "
                "message.angular_velocity"
            ),
            value=np.nan,
        )
    if np.array_equal(accel, MIRROR) and np.array_equal(gyro, -MIRROR):
        return Finding(
            "survey_mirrored",
            ERROR,
            cause=(
                "the survey is the mirror image of the room: an axis has the wrong sign, e.g. z "
                "down, "
                "or two are exchanged"
            ),
            evidence="",
            remedy=(
                "x, y, z = y, x, z  # of every anchor; or the axis with the wrong sign turned: z = "
                "-z"
            ),
            value=np.nan,
        )
    parts = []
    for name, variable, matrix in (("accelerometer", "a", accel), ("gyroscope", "w", gyro)):
        if not np.array_equal(matrix, UPRIGHT):
            parts.append((name, variable, matrix))
    who = " and ".join(name for name, _, _ in parts)
    line = "; ".join(
        f"{v}.x, {v}.y, {v}.z = {', '.join(signed_axis(row, f'{v}.') for row in matrix)}"
        for _, v, matrix in parts
    )
    return Finding(
        "imu_axes",
        ERROR,
        cause=(
            f"axes or signs of the {who} are wrong: x forward, y left, z up is needed, right-handed"
        ),
        evidence="",
        remedy=line,
        value=np.nan,
    )


def scale_of(matrix: np.ndarray) -> float:
    """Return the factor by which a (3, 3) matrix scales lengths."""
    return abs(np.linalg.det(matrix)) ** (1.0 / 3.0)


def signed_axis(direction: np.ndarray, of: str = "") -> str:
    """Return the name of the axis along a direction (3,), "y" or "-y"; `of` is written before it."""
    k = int(np.argmax(np.abs(direction)))
    return f"{'-' if direction[k] < 0.0 else ''}{of}{'xyz'[k]}"
