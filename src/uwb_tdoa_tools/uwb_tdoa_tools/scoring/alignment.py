"""Ground truth is a sensor too: its clock and its frame beside those of an estimate.

What is looked for, in this order, because one hides the next: other axes (z down, two exchanged),
stamps that are late, or of another epoch, and a frame that is turned and shifted. Nothing is moved
unless somebody asks for it.

Stamps that are late by what the gyroscope and the accelerometer say are the fault of the ground
truth. Where no inertial sensor shows it, only the difference of two clocks is known, that of the
ground truth and that of the TDOAs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.errors import InputError

from ..checking.imu_rules import ARRANGEMENTS, signed_axis
from ..checking.motion_rules import FEWEST, TrueMotion
from ..checking.pair_rules import KnownPath
from ..checking.time_rules import delays_of_tdoas
from ..clock import grid
from .metrics import ALIGN, judged_part, position_at

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects.samples import PoseColumns
    from uwb_tdoa_bias.foundation.flight import Flight, Truth

    from ..checking.time_rules import Delays

NONE, TIME, FRAME = ALIGN
OVERLAP = 1.0  # s that ground truth and TDOAs must have in common
LATE, LEAST = (
    0.965,
    0.1,
)  # of the power that is left with the stamps moved, and s; 37 measured recordings: 0.984 at least
# of the median power over all delays: what tells a delay leaves less with the best one; measured:
# 0.67 at most
CONTRAST = 0.9
RATE = 20.0  # Hz at which paths are compared
AXES = 0.5  # of the error that must be left with other axes; measured recordings: 0.8 at least
LONGEST = 1.6  # s at either end of a path that is left out, because stamps are moved by that much
# rad and m that stand out; measured: 2.9, 8.2 degrees, 0.14, 0.35 m
YAW, TILT, LEVEL, HEIGHT = np.deg2rad(4.0), np.deg2rad(12.0), 0.25, 0.6
COMMON, ALIKE, APART = (
    0.6,
    1.3,
    2.0,
    # of the shorter path in common; error of the second best epoch over that of the best; s between
    # them
)
# share by which a turned frame and stamps that are late may differ in what they leave, to be as
# likely
AS_WELL = 0.02
FITS = 0.6  # of the size of the path, that may be left where an epoch is found
EPOCH_STEP = 0.1  # s between epochs that are tried


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where a ground truth is beside an estimate. late : s, by which its stamps are late; source :
    what shows that, "inertial" or "tdoa", None where nothing does; axes (3, 3) : what makes its
    axes those of the survey; turn (3, 3), shift (3,) m : rotation and translation that bring it,
    its axes put right, onto the estimate; middle (3,) m : of the path, at which a shift is given;
    or_turned : whether a frame that is turned would explain as much as stamps that are late, as on
    circles.
    """

    late: float
    source: str | None
    axes: np.ndarray
    turn: np.ndarray
    shift: np.ndarray
    middle: np.ndarray
    or_turned: bool = False

    def applied(self, truth: Truth, how: str) -> Truth:
        """The Truth with its clock put right ("time"), or its frame too ("frame"); "none" leaves it
        as it is.
        """
        if how == NONE:
            return truth
        truth = _earlier(truth, self.late)
        return truth if how == TIME else moved_frame(truth, self.turn @ self.axes, self.shift)

    @property
    def yaw(self) -> float:
        """rad, by which the ground truth is turned against the estimate about the vertical."""
        return float(
            np.arctan2(self.turn[0, 1] - self.turn[1, 0], self.turn[0, 0] + self.turn[1, 1])
        )

    @property
    def tilt(self) -> float:
        """rad, between the verticals of the two."""
        return float(np.arccos(np.clip(self.turn[2, 2], -1.0, 1.0)))

    @property
    def moved(self) -> np.ndarray:
        """(3,) m, by which the ground truth is beside the estimate in the middle of its path."""
        return self.middle - self.turn @ self.middle - self.shift

    @property
    def other_axes(self) -> bool:
        """Whether its axes are not those of the survey."""
        return not np.array_equal(self.axes, np.eye(3))

    @property
    def other_frame(self) -> bool:
        """Whether the frame is another one than what a filter errs by makes it seem."""
        return self.other_axes or any(self._stands_out)

    @property
    def _stands_out(self) -> tuple[bool, bool, bool, bool]:
        """Whether yaw, tilt, level shift and height are more than a filter errs by: (bool, ...)."""
        x, y, z = np.abs(self.moved)
        return (
            bool(abs(self.yaw) > YAW),
            bool(self.tilt > TILT),
            bool(np.hypot(x, y) > LEVEL),
            bool(z > HEIGHT),
        )

    def least(self) -> Alignment:
        """The Alignment with those parts alone of turn and shift that stand out, and what goes with
        a turn: the rest may be what the estimate errs by.
        """
        turned, tilted, level, height = self._stands_out
        level = level or turned or tilted
        turn = (
            self.turn
            if tilted
            else Rotation.from_euler("z", -self.yaw if turned else 0.0).as_matrix()
        )
        there = self.middle - self.moved * (level, level, height)
        return replace(self, turn=turn, shift=there - turn @ self.middle)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: s, degrees, m."""
        return {
            "late": self.late,
            "told_by": self.source,
            "axes": self.axes.astype(int).tolist(),
            "yaw": float(np.rad2deg(self.yaw)),
            "tilt": float(np.rad2deg(self.tilt)),
            "shift": self.moved.tolist(),
        }

    def of_clock(self) -> str | None:
        """Sentence on a clock that is off; None if it is not."""
        if not self.late:
            return None
        if abs(self.late) > LONGEST:
            return (
                f"the ground truth is on another clock: its stamps are {self.late:.2f} s ahead of "
                "those of the TDOAs"
            )
        by = f"{abs(self.late):.2f} s {'late' if self.late > 0.0 else 'early'}"
        if self.source == "inertial":
            return (
                f"the stamps of the ground truth are {by}, as the gyroscope and the accelerometer "
                "tell"
            )
        turned = (
            ", or the frame of the truth is turned: along this path one looks like the other"
            * self.or_turned
        )
        apart_by = f"ground truth or TDOAs are {abs(self.late):.2f} s apart"
        return (
            f"{apart_by} (the truth {by}, or the TDOAs the other way{turned}); no inertial sensor "
            "tells which"
        )

    def of_frame(self) -> str | None:
        """Sentence on a frame that is another one; None if it is not."""
        if not self.other_frame:
            return None
        parts = (
            [f"its axes x, y, z are {_axes_in_words(self.axes)} of the survey"]
            if self.other_axes
            else []
        )
        parts.append(self.frame_in_words())
        return "the ground truth is in another frame than the survey: " + "; ".join(parts)

    def frame_in_words(self) -> str:
        """By how much the frames differ, as numbers."""
        x, y, z = self.moved
        turned = (
            f"turned by {np.rad2deg(self.yaw):.1f} degrees about the vertical, tilted by "
            f"{np.rad2deg(self.tilt):.1f}"
        )
        return f"{turned}, shifted by ({x:.2f}, {y:.2f}, {z:.2f}) m"


def need_truth(flight: Flight, one_clock: bool = True) -> None:
    """Raise InputError if the Flight has no ground truth, or, unless `one_clock` is False, one on
    another clock than its TDOAs.
    """
    if flight.truth is None or len(flight.truth) < 2:
        raise InputError(f"{flight.name}: it holds no ground truth to compare with.")
    if one_clock and on_another_clock(flight):
        truth, tdoa = flight.truth.t, flight.tdoa.t
        raise InputError(
            f"{flight.name}: the ground truth is on another clock than the TDOAs: its stamps "
            f"go from {truth[0]:.1f} to {truth[-1]:.1f} s, "
            f"theirs from {tdoa[0]:.1f} to {tdoa[-1]:.1f} s; write both on one clock, or give "
            "--align time, which finds how far they are apart."
        )


def on_another_clock(flight: Flight) -> bool:
    """Whether the ground truth of a Flight, at least two poses, has hardly an instant in common
    with its TDOAs.
    """
    assert flight.truth is not None
    truth, tdoa = flight.truth.t, flight.tdoa.t
    if not len(tdoa):
        return False
    common = min(truth[-1], tdoa[-1]) - max(truth[0], tdoa[0])
    return bool(common < min(OVERLAP, 0.5 * (truth[-1] - truth[0]), 0.5 * (tdoa[-1] - tdoa[0])))


def apart(path: np.ndarray, other: np.ndarray) -> float:
    """m, root of the median square distance of two paths (n, 3)."""
    return float(np.sqrt(np.median(np.sum((path - other) ** 2, axis=1)))) if len(path) else np.inf


def alignment_of(flight: Flight, odometry: PoseColumns) -> Alignment:
    """Alignment of the ground truth of a Flight beside an Odometry. Raises InputError where it is
    on another clock, and the paths do not tell on which.
    """
    assert flight.truth is not None
    epoch = _epoch(flight, odometry) if on_another_clock(flight) else 0.0
    truth = _earlier(flight.truth, epoch)
    axes = _other_axes(truth, odometry)
    truth = moved_frame(truth, axes, np.zeros(3))
    flight = replace(flight, truth=truth)
    late, source = _late(flight, exact=epoch != 0.0)
    behind = _behind(flight, late) if source == "inertial" else 0.0
    ratio = _turned_or_late(flight, odometry, late, behind)
    if ratio < 1.0 - AS_WELL and source == "tdoa" and not epoch:
        late = 0.0
    if ratio < 1.0:
        behind = 0.0
    true, estimated = paths(_earlier(truth, late + behind), odometry)
    turn, shift = rigid(true, estimated) if len(true) >= FEWEST else (np.eye(3), np.zeros(3))
    middle = true.mean(axis=0) if len(true) else np.zeros(3)
    or_turned = bool(late and source == "tdoa" and ratio < 1.0 + AS_WELL)
    return Alignment(epoch + late, source, axes, turn, shift, middle, or_turned)


def _turned_or_late(flight: Flight, odometry: PoseColumns, late: float, behind: float) -> float:
    """What is left of the distance of the paths if the frame is turned, over what is left if ground
    truth and TDOAs are apart in time too: below 1 the turn is all of it. Infinite where they are
    not apart, or nobody can tell.
    """
    assert flight.truth is not None
    if not (behind or late):
        return np.inf
    pairs = [
        paths(_earlier(flight.truth, by), odometry)
        for by in ((late, late + behind) if behind else (0.0, late))
    ]
    if min(len(true) for true, _ in pairs) < FEWEST:
        return np.inf
    return _left(*pairs[0]) / max(_left(*pairs[1]), 1e-9)


def _earlier(truth: Truth, seconds: float) -> Truth:
    """The Truth with stamps that much earlier."""
    return replace(truth, t=truth.t - seconds)


def _left(path: np.ndarray, other: np.ndarray) -> float:
    """m, root mean square distance of two paths (n, 3) after one was laid onto the other."""
    turn, shift = rigid(path, other)
    return float(np.sqrt(np.mean(np.sum((path @ turn.T + shift - other) ** 2, axis=1))))


def rigid(path: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rotation (3, 3), translation (3,) m) that bring a path (n, 3) m onto another one, robustly
    (Umeyama, Least-squares estimation of transformation parameters between two point patterns, IEEE
    PAMI 1991, without scale).
    """
    weight = np.ones(len(path))
    for _ in range(5):
        here, there = (weight @ one / weight.sum() for one in (path, other))
        u, _, vt = np.linalg.svd(((path - here) * weight[:, None]).T @ (other - there))
        turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        left = np.linalg.norm(other - there - (path - here) @ turn.T, axis=1)
        weight = 1.0 / (1.0 + (left / (2.0 * 1.4826 * np.median(left) + 1e-9)) ** 2)
    return turn, there - turn @ here


def _late(flight: Flight, exact: bool) -> tuple[float, str | None]:
    """(s, source) by which the ground truth of a Flight is late: by the inertial sensor if that
    shows it, else against the TDOAs; (0, None) where neither does. exact : whether the least
    counts.
    """
    assert flight.truth is not None
    found, source = _inertial(flight), "inertial"
    if found is None:
        found, source = delays_of_tdoas(KnownPath(flight)), "tdoa"
    if found is None:
        return 0.0, None
    if not exact and not _is_late(*found.constant()):
        return 0.0, source
    late = -found.exact()
    moved = replace(
        flight, truth=_earlier(flight.truth, late)
    )  # once more from there: a parabola is off between what is tried
    again = _inertial(moved) if source == "inertial" else delays_of_tdoas(KnownPath(moved))
    return late - (again.exact() if again else 0.0), source


def _behind(flight: Flight, late: float) -> float:
    """s by which the ground truth of a Flight, with its own `late` taken out, is later than the
    TDOAs, and so than an estimate.
    """
    assert flight.truth is not None
    found = delays_of_tdoas(KnownPath(replace(flight, truth=_earlier(flight.truth, late))))
    return -found.exact() if found and _is_late(*found.constant()) else 0.0


def _is_late(ratio: float, delay: float) -> bool:
    return ratio < LATE and abs(delay) >= LEAST


def _inertial(flight: Flight) -> Delays | None:
    """Delays of the inertial samples of a Flight against its ground truth; None where they do not
    tell.
    """
    assert flight.truth is not None
    if (
        flight.imu is None
        or len(flight.imu) < 2
        or np.isfinite(flight.truth.q).all(axis=1).sum() < 2
    ):
        return None
    motion = TrueMotion(flight)
    if len(motion) < FEWEST:
        return None
    found = motion.delays()
    power = found.power.sum(axis=(0, 1))
    return found if power.min() < CONTRAST * np.median(power) else None


def _other_axes(truth: Truth, odometry: PoseColumns) -> np.ndarray:
    """(3, 3) signed permutation after which the ground truth is much nearer to the estimate; the
    identity if there is none.
    """
    true, estimated = paths(truth, odometry)
    if len(true) < FEWEST:
        return np.eye(3)

    def error(axes: np.ndarray) -> float:
        return apart(true @ axes.T, estimated)

    best = min(ARRANGEMENTS, key=error)
    return best if error(best) < AXES * error(np.eye(3)) else np.eye(3)


def paths(truth: Truth, odometry: PoseColumns) -> tuple[np.ndarray, np.ndarray]:
    """(true (n, 3), estimated (n, 3)) m at the same instants, while the tag moves."""
    if len(odometry.t) < 2:
        return np.empty((0, 3)), np.empty((0, 3))
    _, first, last = judged_part(truth)
    begin, end = max(first, odometry.t[0]) + LONGEST, min(last, odometry.t[-1]) - LONGEST
    t = grid(begin, end, 1.0 / RATE, odometry.t)
    return position_at(t, truth), position_at(t, odometry)


def _epoch(flight: Flight, odometry: PoseColumns) -> float:
    """s by which the stamps of a ground truth on another clock are late: where its path is nearest
    to that of the estimate, as it is, or else, about its middle, with other axes.
    """
    assert flight.truth is not None
    truth = flight.truth
    if len(odometry.t) < 2:
        raise InputError(
            f"{flight.name}: the ground truth is on another clock than the TDOAs, and there "
            "is no estimate to find it by."
        )
    ours, theirs = (
        position_at(grid(one.t[0], one.t[-1], EPOCH_STEP, one.t), one) for one in (odometry, truth)
    )
    lags, size, tried = (
        np.arange(-len(theirs) + 1, len(ours)),
        np.sqrt(np.sum(ours.var(axis=0))),
        [],
    )
    for pair, arrangements in (
        ((ours, theirs), (np.eye(3),)),
        ((ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)), ARRANGEMENTS),
    ):
        error = _apart_by_lag(pair[0], pair[1], lags, arrangements)
        best = int(np.argmin(error))
        others = np.min(error[np.abs(lags - lags[best]) > APART / EPOCH_STEP], initial=np.inf)
        if error[best] < FITS * size and others >= ALIKE * error[best]:
            return float(truth.t[0] - odometry.t[0] - lags[best] * EPOCH_STEP)
        tried.append(f"the nearest is {error[best]:.2f} m off, another one {others:.2f} m")
    raise InputError(
        f"{flight.name}: the ground truth is on another clock than the TDOAs, and its path "
        f"does not tell on which ({tried[0]}; with other axes "
        f"{tried[1]}): write both on one clock."
    )


def _apart_by_lag(
    ours: np.ndarray, theirs: np.ndarray, lags: np.ndarray, arrangements: Sequence[np.ndarray]
) -> np.ndarray:
    """m, root mean square distance of two paths (n, 3), (m, 3) m at each lag (k,) of the second,
    with the best of some arrangements (3, 3) of its axes; infinite where they have too little in
    common.
    """
    common = np.minimum(lags + len(theirs), len(ours)) - np.maximum(lags, 0)
    square = _over(np.sum(ours**2, axis=1), np.ones(len(theirs))) + _over(
        np.ones(len(ours)), np.sum(theirs**2, axis=1)
    )
    products = np.array([[_over(mine, its) for its in theirs.T] for mine in ours.T])
    square -= 2.0 * np.max([np.tensordot(axes, products) for axes in arrangements], axis=0)
    error = np.sqrt(np.maximum(square, 0.0) / common)
    error[common < COMMON * min(len(ours), len(theirs))] = np.inf
    return error


def _over(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Sums of products over what both have in common, with theirs moved by each lag."""
    return np.correlate(ours, theirs, mode="full")


def moved_frame(truth: Truth, axes: np.ndarray, shift: np.ndarray) -> Truth:
    """The Truth in a frame whose axes are (3, 3) others, then shifted by (3,) m. Attitudes stay
    where it is mirrored: whatever they are, turns of the body are the same.
    """
    p, known = truth.p @ axes.T + shift, np.isfinite(truth.q).all(axis=1)
    q = truth.q.copy()
    if np.linalg.det(axes) > 0.0 and known.any():
        q[known] = (Rotation.from_matrix(axes) * Rotation.from_quat(truth.q[known])).as_quat()
    return replace(truth, p=p, q=q)


def _axes_in_words(axes: np.ndarray) -> str:
    """Which axis of the survey each axis of the ground truth is: "x, y, -z"."""
    return ", ".join(map(signed_axis, axes.T))
