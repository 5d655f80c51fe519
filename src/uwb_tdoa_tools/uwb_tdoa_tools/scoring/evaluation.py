# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the filter over a flight and score it; align its ground truth before that.

Clock and frame of the truth are compared with those of an estimate. The
search has an order, because one error hides the next: other axes (z down, two exchanged),
delayed stamps or another epoch, then a rotated and shifted frame. Nothing is moved unless the
caller asks for it.

If gyroscope and accelerometer show the delay, the ground truth is late. Without an inertial sensor
only the difference between the clocks of ground truth and TDOAs is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.correction.model import Model
from uwb_tdoa_bias.effects import RADIO, EffectSet, Samples, true_samples
from uwb_tdoa_bias.effects.samples import PoseColumns
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import Run

from ..checking.imu_rules import ARRANGEMENTS, signed_axis
from ..checking.motion_rules import FEWEST, TrueMotion, truth_unit
from ..checking.pair_rules import Delays, KnownPath, delays_of_tdoas, repairs
from ..choices import FRAME, NONE, TIME
from ..clock import grid
from ..estimate import FlightEstimator
from ..readers.inputs import report_remarks
from .metrics import Score, position_at, radio_residuals, scored_phase

# Limits beside measured values were set on 37 recordings with a correct ground truth.
OVERLAP = 1.0  # s that ground truth and TDOAs must have in common
LATE = 0.965  # largest ratio of the power after and before a delay is corrected; measured: >= 0.984
LEAST = 0.1  # s, smallest delay that is reported
CONTRAST = 0.9  # smallest power over the median power, over all delays; measured: <= 0.67
RATE = 20.0  # Hz at which paths are compared
AXES = 0.5  # largest ratio of the errors with other axes and without; measured: >= 0.8
LONGEST = 1.6  # s, largest delay in the search; left out at both ends of a path
# rad, rad, m, m; filter errors reach 2.9 degrees, 8.2 degrees, 0.14 m and 0.35 m
YAW, TILT, LEVEL, HEIGHT = np.deg2rad(4.0), np.deg2rad(12.0), 0.25, 0.6
COMMON = 0.6  # smallest overlap of two paths, as a share of the shorter path
DISTINCT_ERROR_RATIO = 1.3  # smallest ratio of the errors of the second best epoch and the best
DISTINCT_EPOCHS = 2.0  # s, smallest difference between two epochs
EQUALLY_LIKELY = 0.02  # relative difference of the errors of equally likely rotation and delay
FITS = 0.6  # largest distance at the best epoch, relative to the size of the path
EPOCH_STEP = 0.1  # s, resolution of the search for the epoch


@dataclass(frozen=True, eq=False)
class Alignment:
    """Offset of a ground truth from an estimate, in time and space.

    Attributes
    ----------
    late : s, delay of the stamps.
    source : evidence for the delay: "inertial", "tdoa", or None.
    axes : (3, 3), signed permutation to the axes of the survey.
    turn, shift : (3, 3) and (3,) m, rotation and translation onto the estimate, after `axes`.
    middle : (3,) m, middle of the path, at which the offset is given.
    ambiguous : a rotated frame explains the data as well as a delay, as on circles.
    """

    late: float
    source: str | None
    axes: np.ndarray
    turn: np.ndarray
    shift: np.ndarray
    middle: np.ndarray
    ambiguous: bool = False

    def applied_to(self, truth: Truth, how: str) -> Truth:
        """Return the Truth with its clock corrected ("time"), or clock and frame ("frame").

        "none" returns it unchanged.
        """
        if how == NONE:
            return truth
        truth = _advanced(truth, self.late)
        return truth if how == TIME else transform_truth(truth, self.turn @ self.axes, self.shift)

    @property
    def yaw(self) -> float:
        """Return the rotation of the ground truth against the estimate about the vertical, rad."""
        return float(
            np.arctan2(self.turn[0, 1] - self.turn[1, 0], self.turn[0, 0] + self.turn[1, 1])
        )

    @property
    def tilt(self) -> float:
        """Return the angle between the two verticals, rad."""
        return float(np.arccos(np.clip(self.turn[2, 2], -1.0, 1.0)))

    @property
    def offset(self) -> np.ndarray:
        """Return the offset of the ground truth from the estimate in the middle of its path: (3,) m."""
        return self.middle - self.turn @ self.middle - self.shift

    @property
    def axes_differ(self) -> bool:
        """Return whether its axes differ from those of the survey."""
        return not np.array_equal(self.axes, np.eye(3))

    @property
    def frame_differs(self) -> bool:
        """Return whether the frame differs by more than filter errors explain."""
        return self.axes_differ or any(self._stands_out)

    @property
    def _stands_out(self) -> tuple[bool, bool, bool, bool]:
        """Return whether yaw, tilt, level shift and height exceed usual errors of a filter."""
        x, y, z = np.abs(self.offset)
        return (
            bool(abs(self.yaw) > YAW),
            bool(self.tilt > TILT),
            bool(np.hypot(x, y) > LEVEL),
            bool(z > HEIGHT),
        )

    def significant(self) -> Alignment:
        """Return the Alignment with only the parts of rotation and shift that exceed filter errors."""
        turned, tilted, level, height = self._stands_out
        level = level or turned or tilted
        turn = (
            self.turn
            if tilted
            else Rotation.from_euler("z", -self.yaw if turned else 0.0).as_matrix()
        )
        there = self.middle - self.offset * (level, level, height)
        return replace(self, turn=turn, shift=there - turn @ self.middle)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON: s, degrees, m."""
        return {
            "late": self.late,
            "told_by": self.source,
            "axes": self.axes.astype(int).tolist(),
            "yaw": float(np.rad2deg(self.yaw)),
            "tilt": float(np.rad2deg(self.tilt)),
            "shift": self.offset.tolist(),
        }

    def clock_sentence(self) -> str | None:
        """Return a sentence on a clock that differs, else None."""
        if not self.late:
            return None
        if abs(self.late) > LONGEST:
            return (
                f"the ground truth is on another clock: its stamps are {self.late:.2f} s ahead of "
                "the TDOAs"
            )
        by = f"{abs(self.late):.2f} s {'late' if self.late > 0.0 else 'early'}"
        if self.source == "inertial":
            return f"the stamps of the ground truth are {by}, as gyroscope and accelerometer show"
        turned = (
            ", or the frame of the truth is turned: on this path both explain the data"
            * self.ambiguous
        )
        apart_by = f"ground truth or TDOAs are {abs(self.late):.2f} s apart"
        return (
            f"{apart_by} (the truth {by}, or the TDOAs the other way{turned}); an inertial "
            "sensor would show which"
        )

    def frame_sentence(self) -> str | None:
        """Return a sentence on a frame that differs, else None."""
        if not self.frame_differs:
            return None
        parts = [self.frame_in_words()]
        if self.axes_differ:
            axes = ", ".join(map(signed_axis, self.axes.T))
            parts.insert(0, f"its axes x, y, z are {axes} of the survey")
        return "the ground truth is in another frame than the survey: " + "; ".join(parts)

    def frame_in_words(self) -> str:
        """Return the difference of the frames as numbers."""
        x, y, z = self.offset
        turned = (
            f"turned by {np.rad2deg(self.yaw):.1f} degrees about the vertical, tilted by "
            f"{np.rad2deg(self.tilt):.1f}"
        )
        return f"{turned}, shifted by ({x:.2f}, {y:.2f}, {z:.2f}) m"


def require_truth(flight: Flight, one_clock: bool = True) -> None:
    """Raise InputError if the Flight has no ground truth to compare with, or one in another unit.

    If `one_clock`, a ground truth on another clock than the TDOAs is refused too.
    """
    if flight.truth is None or len(flight.truth) < 2:
        raise InputError(f"{flight.name}: it holds no ground truth to compare with.")
    for finding in truth_unit(flight):
        raise InputError(f"{flight.name}: {finding.cause}: {finding.evidence}; {finding.remedy}.")
    if one_clock and on_another_clock(flight):
        truth, tdoa = flight.truth.t, flight.tdoa.t
        raise InputError(
            f"{flight.name}: the ground truth is on another clock than the TDOAs: its stamps "
            f"go from {truth[0]:.1f} to {truth[-1]:.1f} s, "
            f"theirs from {tdoa[0]:.1f} to {tdoa[-1]:.1f} s; write both on one clock, or give "
            "--align time, which finds how far they are apart."
        )


def on_another_clock(flight: Flight) -> bool:
    """Return whether ground truth (at least two poses) and TDOAs have hardly a time in common."""
    truth, tdoa = flight.known_truth.t, flight.tdoa.t
    if not len(tdoa):
        return False
    common = min(truth[-1], tdoa[-1]) - max(truth[0], tdoa[0])
    return bool(common < min(OVERLAP, 0.5 * (truth[-1] - truth[0]), 0.5 * (tdoa[-1] - tdoa[0])))


def median_distance(path: np.ndarray, other: np.ndarray) -> float:
    """Return the root of the median square distance of two paths (n, 3) m, in m."""
    return float(np.sqrt(np.median(np.sum((path - other) ** 2, axis=1)))) if len(path) else np.inf


def estimate_alignment(flight: Flight, odometry: PoseColumns) -> Alignment:
    """Estimate the Alignment of the ground truth of a Flight with an Odometry.

    Raises InputError if the truth is on another clock and the paths do not determine the offset.
    """
    epoch = _epoch(flight, odometry) if on_another_clock(flight) else 0.0
    truth = _advanced(flight.known_truth, epoch)
    axes = _other_axes(truth, odometry)
    truth = transform_truth(truth, axes, np.zeros(3))
    flight = replace(flight, truth=truth)
    late, source = _truth_delay(flight, exact=epoch != 0.0)
    behind = _tdoa_delay(flight, late) if source == "inertial" else 0.0
    ratio = _rotation_to_delay_ratio(flight, odometry, late, behind)
    if ratio < 1.0 - EQUALLY_LIKELY and source == "tdoa" and not epoch:
        late = 0.0
    if ratio < 1.0:
        behind = 0.0
    true, estimated = common_paths(_advanced(truth, late + behind), odometry)
    turn, shift = (
        rigid_transform(true, estimated) if len(true) >= FEWEST else (np.eye(3), np.zeros(3))
    )
    middle = true.mean(axis=0) if len(true) else np.zeros(3)
    ambiguous = bool(late and source == "tdoa" and ratio < 1.0 + EQUALLY_LIKELY)
    return Alignment(epoch + late, source, axes, turn, shift, middle, ambiguous)


def _rotation_to_delay_ratio(
    flight: Flight, odometry: PoseColumns, late: float, behind: float
) -> float:
    """Return the remaining distance for a rotated frame over that for a delay.

    Below 1, the rotation explains everything. Infinite if there is no delay or too little data.
    """
    if not (behind or late):
        return np.inf
    pairs = [
        common_paths(_advanced(flight.known_truth, by), odometry)
        for by in ((late, late + behind) if behind else (0.0, late))
    ]
    if min(len(true) for true, _ in pairs) < FEWEST:
        return np.inf
    return _aligned_rms(*pairs[0]) / max(_aligned_rms(*pairs[1]), 1e-9)


def _advanced(truth: Truth, seconds: float) -> Truth:
    """Return the Truth with earlier stamps."""
    return replace(truth, t=truth.t - seconds)


def _aligned_rms(path: np.ndarray, other: np.ndarray) -> float:
    """Return the root mean square distance of two paths (n, 3) m after alignment, in m."""
    turn, shift = rigid_transform(path, other)
    return float(np.sqrt(np.mean(np.sum((path @ turn.T + shift - other) ** 2, axis=1))))


def rigid_transform(path: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit rotation (3, 3) and translation (3,) m from a path (n, 3) m to another, robustly.

    Umeyama, Least-squares estimation of transformation parameters between two point patterns, IEEE
    PAMI 1991, without scale, reweighted.
    """
    weight = np.ones(len(path))
    for _ in range(5):
        here, there = (weight @ one / weight.sum() for one in (path, other))
        u, _, vt = np.linalg.svd(((path - here) * weight[:, None]).T @ (other - there))
        turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        left = np.linalg.norm(other - there - (path - here) @ turn.T, axis=1)
        weight = 1.0 / (1.0 + (left / (2.0 * 1.4826 * np.median(left) + 1e-9)) ** 2)
    return turn, there - turn @ here


def _truth_delay(flight: Flight, exact: bool) -> tuple[float, str | None]:
    """Return (delay s, source) of the ground truth of a Flight.

    The inertial sensor decides if it shows a delay, otherwise the TDOAs. (0, None) if neither does.
    With `exact`, the smallest delay counts.
    """
    found, source = _inertial(flight), "inertial"
    if found is None:
        found, source = delays_of_tdoas(KnownPath(flight)), "tdoa"
    if found is None:
        return 0.0, None
    if not exact and not _is_significant(*found.constant()):
        return 0.0, source
    late = -found.exact()
    # a parabola between the tried delays is inexact: repeat from its minimum
    moved = replace(flight, truth=_advanced(flight.known_truth, late))
    again = _inertial(moved) if source == "inertial" else delays_of_tdoas(KnownPath(moved))
    return late - (again.exact() if again else 0.0), source


def _tdoa_delay(flight: Flight, late: float) -> float:
    """Return the delay of the ground truth against the TDOAs, s, after its own delay `late`."""
    found = delays_of_tdoas(KnownPath(replace(flight, truth=_advanced(flight.known_truth, late))))
    return -found.exact() if found and _is_significant(*found.constant()) else 0.0


def _is_significant(ratio: float, delay: float) -> bool:
    return ratio < LATE and abs(delay) >= LEAST


def _inertial(flight: Flight) -> Delays | None:
    """Return the delays of the inertial samples against the ground truth; None without contrast."""
    if (
        flight.imu is None
        or len(flight.imu) < 2
        or np.isfinite(flight.known_truth.q).all(axis=1).sum() < 2
    ):
        return None
    motion = TrueMotion(flight.imu, flight.known_truth)
    if len(motion) < FEWEST:
        return None
    found = motion.delays()
    power = found.power.sum(axis=(0, 1))
    return found if power.min() < CONTRAST * np.median(power) else None


def _other_axes(truth: Truth, odometry: PoseColumns) -> np.ndarray:
    """Return the signed permutation (3, 3) that brings the truth much nearer, else the identity.

    A truth in a frame of its own is rotated, not mirrored: a mirror image that leaves the truth
    elsewhere must also fit better than a rotation.
    """
    true, estimated = common_paths(truth, odometry)
    if len(true) < FEWEST:
        return np.eye(3)

    def error(axes: np.ndarray) -> float:
        return median_distance(true @ axes.T, estimated)

    best = min(ARRANGEMENTS, key=error)
    if not error(best) < AXES * error(np.eye(3)):
        return np.eye(3)
    if np.linalg.det(best) < 0.0 and error(best) > HEIGHT:
        mirrored = _aligned_rms(true @ best.T, estimated)
        if mirrored * DISTINCT_ERROR_RATIO > _aligned_rms(true, estimated):
            return np.eye(3)
    return best


def common_paths(truth: Truth, odometry: PoseColumns) -> tuple[np.ndarray, np.ndarray]:
    """Return (true (n, 3), estimated (n, 3)) m at the same instants, while the tag moves."""
    if len(odometry.t) < 2:
        return np.empty((0, 3)), np.empty((0, 3))
    _, first, last = scored_phase(truth)
    begin, end = max(first, odometry.t[0]) + LONGEST, min(last, odometry.t[-1]) - LONGEST
    t = grid(begin, end, 1.0 / RATE, odometry.t)
    return position_at(t, truth), position_at(t, odometry)


def _epoch(flight: Flight, odometry: PoseColumns) -> float:
    """Return the offset of the stamps of a ground truth on another clock, s.

    It minimizes the distance between the paths: as they are, or about their middle with other axes.
    """
    truth = flight.known_truth
    if len(odometry.t) < 2:
        raise InputError(
            f"{flight.name}: the ground truth is on another clock than the TDOAs, and there "
            "is no estimate to find it by."
        )
    ours, theirs = (
        position_at(grid(one.t[0], one.t[-1], EPOCH_STEP, one.t), one) for one in (odometry, truth)
    )
    lags = np.arange(-len(theirs) + 1, len(ours))
    size = np.sqrt(np.sum(ours.var(axis=0)))
    tried = []
    for one, other, arrangements in (
        (ours, theirs, (np.eye(3),)),
        (ours - ours.mean(axis=0), theirs - theirs.mean(axis=0), ARRANGEMENTS),
    ):
        error = _distance_by_lag(one, other, lags, arrangements)
        best = int(np.argmin(error))
        others = np.min(
            error[np.abs(lags - lags[best]) > DISTINCT_EPOCHS / EPOCH_STEP], initial=np.inf
        )
        if error[best] < FITS * size and others >= DISTINCT_ERROR_RATIO * error[best]:
            return float(truth.t[0] - odometry.t[0] - lags[best] * EPOCH_STEP)
        tried.append(f"the nearest is {error[best]:.2f} m off, another one {others:.2f} m")
    raise InputError(
        f"{flight.name}: the ground truth is on another clock than the TDOAs, and its path "
        f"does not determine the offset ({tried[0]}; with other axes "
        f"{tried[1]}): write both on one clock."
    )


def _distance_by_lag(
    ours: np.ndarray, theirs: np.ndarray, lags: np.ndarray, arrangements: Sequence[np.ndarray]
) -> np.ndarray:
    """Return the root mean square distance of two paths at each lag (k,), m.

    The paths are (n, 3) and (m, 3) m. The best arrangement (3, 3) of the axes counts. Too little
    overlap gives inf.
    """
    sums = partial(np.correlate, mode="full")  # of products, over the overlap at each lag
    common = np.minimum(lags + len(theirs), len(ours)) - np.maximum(lags, 0)
    square = sums(np.sum(ours**2, axis=1), np.ones(len(theirs)))
    square += sums(np.ones(len(ours)), np.sum(theirs**2, axis=1))
    products = np.array([[sums(mine, its) for its in theirs.T] for mine in ours.T])
    square -= 2.0 * np.max([np.tensordot(axes, products) for axes in arrangements], axis=0)
    error = np.sqrt(np.maximum(square, 0.0) / common)
    error[common < COMMON * min(len(ours), len(theirs))] = np.inf
    return error


def transform_truth(truth: Truth, axes: np.ndarray, shift: np.ndarray) -> Truth:
    """Return the Truth with axes (3, 3), then shift (3,) m, applied to its positions and attitudes.

    A mirrored frame leaves the attitudes unchanged: rotations of the body are the same.
    """
    p, known = truth.p @ axes.T + shift, np.isfinite(truth.q).all(axis=1)
    q = truth.q.copy()
    if np.linalg.det(axes) > 0.0 and known.any():
        q[known] = (Rotation.from_matrix(axes) * Rotation.from_quat(truth.q[known])).as_quat()
    return replace(truth, p=p, q=q)


# largest ratio of the distances with repaired ids and signs, and with another frame
LARGEST_LABEL_RATIO = 1.5
# Largest ratio of the residuals of TDOAs with the frame moved and with it as it is, delays of
# anchors fitted to both. Ten recordings with a ground truth put 0.35 m or 5 degrees off: 0.51 to
# 0.92, and 0.94 to 1.03 where the path is too small to tell. Errors of anchors: 0.94 and more.
LARGEST_FRAME_RATIO = 0.93
FITS_OF_DELAYS = 8  # number of reweighted fits of delays


def evaluate(
    flight: Flight,
    config: FilterConfig | None = None,
    effects: EffectSet | None = None,
    network: Model | None = None,
) -> tuple[Score, Run]:
    """Run the filter over a Flight with ground truth.

    Returns
    -------
    score : Score.
    run : Run.

    Raises InputError without ground truth.
    """
    return score_of(flight, FlightEstimator(config, effects, network))


def score_of(flight: Flight, estimator: FlightEstimator) -> tuple[Score, Run]:
    """Run a FlightEstimator over a Flight with ground truth and score it.

    Returns (Score, Run). Raises InputError without ground truth, or with one on another clock.
    """
    require_truth(flight)
    run = estimator(flight)
    return Score(
        flight.name,
        run.odometry,
        corrected_truth(flight, estimator.effects),
        radio_residuals(flight, run),
        flight.tdoa.t,
    ), run


def corrected_truth(flight: Flight, effects: EffectSet | None = None) -> Truth:
    """Return the ground truth of a Flight without its errors that the EffectSet describes."""
    straight = effects.correct_streams(replace(flight, imu=None)) if effects else flight
    return straight.known_truth


def align_truth(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    align: str = NONE,
) -> tuple[Flight, tuple[str, ...]]:
    """Move the ground truth to the clock and frame of the TDOAs where it clearly differs.

    The moved truth only serves scoring and learning. Effects for the nodes do not contain the
    difference.

    Parameters
    ----------
    flight : Flight with ground truth.
    effects : known effects, or None.
    align : one of ALIGN. With "none", a ground truth on another clock is refused.

    Returns
    -------
    flight : Flight with the moved truth.
    sentences : what was found.

    Raises InputError.
    """
    require_truth(flight, align == NONE)
    effects = effects or EffectSet()
    found = _alignment(flight, effects, config)
    sentences = [
        f"{words}: it is moved to judge by, and nothing of that goes to the nodes"
        for words in (found.clock_sentence(), found.frame_sentence())
        if words
    ]
    return replace(
        flight,
        truth=found.significant().applied_to(
            flight.known_truth, FRAME if found.frame_differs else TIME
        ),
    ), tuple(sentences)


def with_aligned_truth(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    align: str = NONE,
) -> Flight:
    """Return the Flight of `align_truth` and print the findings on stderr.

    Other processes can call it (it can be pickled).
    """
    flight, sentences = align_truth(flight, effects, config, align)
    report_remarks(flight.name, (f"{sentence}." for sentence in sentences))
    return flight


def on_one_clock(flight: Flight, align: str = NONE) -> Flight:
    """Move the ground truth, if there is one, to the clock of the TDOAs.

    With align "none", a ground truth on another clock is refused. Raises InputError.
    """
    if flight.truth is None or len(flight.truth) < 2 or not on_another_clock(flight):
        return flight
    require_truth(flight, align == NONE)
    found = estimate_alignment(flight, FlightEstimator()(flight).odometry)
    report_remarks(flight.name, [f"{found.clock_sentence()}: they are moved."])
    return replace(flight, truth=found.applied_to(flight.truth, TIME))


def _alignment(flight: Flight, effects: EffectSet, config: FilterConfig | None) -> Alignment:
    """Return the Alignment of a Flight.

    If wrong ids and signs explain the difference of the frames as well, they are repaired first.
    """
    straight = effects.correct_streams(flight)
    odometry = FlightEstimator(config, effects)(flight).odometry
    found = estimate_alignment(straight, odometry)
    if found.frame_differs and (
        _ranges_fit(straight, effects, found) or delays_fit(straight, effects, found)
    ):
        found = replace(found, axes=np.eye(3), turn=np.eye(3), shift=np.zeros(3))
    repair = (
        EffectSet(repairs(replace(straight, truth=found.applied_to(straight.known_truth, TIME))))
        if found.frame_differs
        else EffectSet()
    )
    if not len(repair):
        return found
    of_labels = FlightEstimator(config, effects)(repair.correct_streams(flight)).odometry
    error = median_distance(*common_paths(found.applied_to(straight.known_truth, TIME), of_labels))
    left = median_distance(*common_paths(found.applied_to(straight.known_truth, FRAME), odometry))
    return (
        estimate_alignment(repair.correct_streams(straight), of_labels)
        if error < LARGEST_LABEL_RATIO * left
        else found
    )


def delays_fit(flight: Flight, effects: EffectSet, found: Alignment) -> bool:
    """Return whether delays of anchors explain the TDOAs as well as another frame does.

    Errors that depend on the bearing of an anchor shift the estimate, too. False without TDOAs, and
    if the axes differ.

    Parameters
    ----------
    flight : Flight with ground truth and corrected streams.
    effects : known effects.
    found : Alignment of the ground truth with the estimate.
    """
    if found.axes_differ or not len(flight.tdoa):
        return False
    left = []
    for samples, residual in _residuals(flight, effects, found, "tdoa"):
        known = np.isfinite(residual)
        ends = np.stack([samples.a, samples.b])[:, known]
        left.append(_left_by_delays(residual[known], ends) if known.any() else np.nan)
    return bool(left[1] > LARGEST_FRAME_RATIO * left[0])


def _residuals(
    flight: Flight, effects: EffectSet, found: Alignment, stream: str
) -> Iterator[tuple[Samples, np.ndarray]]:
    """Yield (Samples, residual (n,) m) of a stream of RADIO, first in the frame of the truth.

    Then with the frame moved.
    """
    for how in (TIME, FRAME):
        moved = replace(flight, truth=found.significant().applied_to(flight.known_truth, how))
        samples, rows = true_samples(moved, RADIO[stream])
        measured = getattr(flight, stream).d[rows]
        yield samples, measured - samples.predicted() - effects.bias(samples)


def _left_by_delays(residual: np.ndarray, ends: np.ndarray) -> float:
    """Return the median absolute residual (n,) m after a robust fit of one delay per anchor, m.

    ends : (2, n) rows of the anchors a and b of each TDOA; their delays add delay_b - delay_a
    """
    heard, place = np.unique(ends, return_inverse=True)
    (a, b), count = place.reshape(ends.shape), len(heard)
    left: np.ndarray = residual
    weight: np.ndarray = np.ones(len(residual))
    for _ in range(FITS_OF_DELAYS):
        forth = np.bincount(a * count + b, weight, count**2).reshape(count, count)
        pairs = forth + forth.T
        normal = np.diag(pairs.sum(axis=1)) - pairs  # of a graph of anchors: its Laplacian
        vector = np.bincount(b, weight * residual, count) - np.bincount(a, weight * residual, count)
        delay = np.linalg.lstsq(normal, vector, rcond=None)[0]
        left = residual - delay[b] + delay[a]
        weight = 1.0 / (1.0 + (left / (2.0 * 1.4826 * np.median(np.abs(left)) + 1e-9)) ** 2)
    return float(np.median(np.abs(left)))


def _ranges_fit(flight: Flight, effects: EffectSet, found: Alignment) -> bool:
    """Return whether ranges to anchors support the frame of the ground truth as it is.

    Delays of anchors distort the estimate, but are only constants in ranges. False without ranges.
    """
    channels = [
        name for name, kind in RADIO.items() if kind.ends == 1 and getattr(flight, name) is not None
    ]
    if not channels:
        return False
    away = []
    for samples, left in _residuals(flight, effects, found, channels[0]):
        of_anchors = [left[samples.b == anchor] for anchor in np.unique(samples.b)]
        apart = [np.abs(some - np.median(some)) for some in of_anchors]
        away.append(np.median(np.concatenate(apart)) if apart else np.nan)
    return bool(away[0] <= away[1])
