# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Assess how reliable an estimate is, from the recording and the run, without ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.core.yaw_check import YAW_KNOWN
from uwb_tdoa_ekf.monitoring.finding import ERROR
from uwb_tdoa_ekf.offline import Run
from uwb_tdoa_ekf.results import Odometry, Residuals, rotation_std

from ..checking.check import check
from ..checking.recording import of_flight
from ..checking.watch import OF_ANCHORS
from ..estimate import FlightEstimator
from ..scoring.metrics import LOST, has_innovation, nis, radio_residuals
from . import residuals

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"
# standard deviations that contain the 3D position for 95 % of the time; 1.6 to 2.0 by its shape
SIGMAS = 2.0
LOCATING = (("tdoas", "TDOAs"), ("ranges", "ranges"))  # figures that count measurements, in words
GAP = 1.0  # s without an estimate: the tag is lost
LARGEST_LOST_SHARE = 0.05  # largest share of lost time in a good estimate
SMALLEST_EXPLAINED_SHARE = 0.9  # smallest share of explained TDOAs in a good estimate
# ratio of the deviation of z to x and y that makes the height the weakest coordinate
WEAK_HEIGHT_RATIO = 1.5
# m, smallest reported offset of all ranges; without an offset the filter estimates up to 2 cm
REPORTED_OFFSET = 0.03
# share of lasting errors in the variance above which a calibration helps
LASTING_SHARE = 0.5


@dataclass(frozen=True)
class Assessment:
    """Reliability of an estimate.

    Attributes
    ----------
    level : GOOD, DOUBTFUL or BAD.
    figures : {name: number}.
    lost : [(begin, end)] s, spans in which the tag was lost.
    reasons : sentences on why it is not good.
    remedies : sentences on what would improve it.
    """

    level: str
    figures: dict[str, Any]
    lost: list[tuple[float, float]] = field(default_factory=list)
    reasons: tuple[str, ...] = ()
    remedies: tuple[str, ...] = ()

    def sentences(self) -> list[str]:
        """Return the verdict as sentences."""
        figures = self.figures
        if not figures["estimates"]:
            return [f"{self.level}: there is no estimate", *self.reasons, *self.remedies]
        spread = ", ".join(f"{axis} {100 * figures[f'std_{axis}']:.0f}" for axis in "xyz")
        within = (
            f"standard deviation {100 * figures['std']:.0f} cm ({spread}): the position is within "
            f"{100 * figures['within']:.0f} cm for 95 % of the time"
        )
        fits = (
            f"{figures['explained']:.1%} of {_counted(figures)} fit it within three standard "
            f"deviations (NIS {figures['nis']:.2f}: with outliers in full, 1 if there were none)"
        )
        lines = [f"{self.level}: {within}; {fits}"]
        off = figures.get("range_offset", 0.0)
        if abs(off) >= REPORTED_OFFSET:
            lines.append(
                f"all ranges are {100 * abs(off):.0f} cm too "
                f"{'long' if off > 0.0 else 'short'}: that was found, and taken out"
            )
        return [*lines, *self.reasons, *self.remedies]


def assess(
    flight: Flight,
    run: Run,
    estimator: FlightEstimator = FlightEstimator(),
    line: str | None = None,
) -> Assessment:
    """Assess a Run of a FlightEstimator over a Flight; its ground truth is not used.

    `line` is the command that `check` suggests, see there.
    """
    odometry, left = run.odometry, radio_residuals(flight, run)
    there = has_innovation(left)
    figures = {
        "seconds": float(np.ptp(left.t)) if len(left) else 0.0,
        "estimates": len(odometry),
        "tdoas": len(flight.tdoa),
        "recoveries": run.recoveries,
    }
    if ranges := len(left) - len(flight.tdoa):
        figures["ranges"] = ranges
    if run.range_offset is not None:
        figures["range_offset"] = run.range_offset[0]
    found = check(of_flight(flight), (), estimator, line).findings
    faults = [finding for finding in found if finding.severity == ERROR]
    moved = [
        finding for finding in found if finding.severity != ERROR and finding.rule in OF_ANCHORS
    ]
    reasons = [f"check: {finding.cause} ({finding.evidence})" for finding in faults + moved]
    remedies = [f"{finding.cause}: {finding.remedy}" for finding in faults + moved]
    if not len(odometry) or not there.any():
        reasons.append(f"the filter found no place that explains the {_measured(figures)}")
        return Assessment(BAD, figures, [], tuple(reasons), tuple(remedies))
    figures |= _deviation(odometry)
    figures["explained"] = float(residuals.explained(left)[there].mean())
    figures["nis"] = float(nis(left).mean())
    lost = lost_spans(left.t, odometry)
    figures["lost"] = float(sum(end - begin for begin, end in lost))
    doubts = list(_doubts(flight, left, figures, lost))
    level = GOOD
    if faults or figures["lost"] > 0.5 * figures["seconds"]:
        level = BAD
    elif moved or doubts:
        level = DOUBTFUL
    remedies += _remedies(flight, left, figures, estimator.effects is not None)
    return Assessment(level, figures, lost, tuple(reasons + doubts), tuple(remedies))


def _measured(figures: Mapping[str, Any]) -> str:
    """Return the name of the measurements that locate the tag."""
    return " and ".join(words for name, words in LOCATING if figures.get(name)) or "TDOAs"


def _counted(figures: Mapping[str, Any]) -> str:
    """Return the measurements that locate the tag, with their numbers."""
    counts = [f"{figures[name]} {words}" for name, words in LOCATING if figures.get(name)]
    return " and ".join(counts) or "0 TDOAs"


def lost_spans(heard: np.ndarray, odometry: Odometry) -> list[tuple[float, float]]:
    """Return [(begin, end)] s, spans in which the tag is lost.

    The tag is lost without an estimate for GAP, or with a deviation above LOST. Spans closer than
    GAP are joined. They end with the last stamp in `heard` (n,) s.
    """
    t, std = odometry.t, np.sqrt(np.einsum("nii->n", odometry.covariance[:, :3, :3]))
    ends = np.append(t[1:], max(t[-1], heard.max(initial=-math.inf)))
    wide = (std > LOST) | (ends - t > GAP)
    spans: list[tuple[float, float]] = []
    for begin, end in zip(t[wide].tolist(), ends[wide].tolist()):
        if spans and begin - spans[-1][1] < GAP:
            spans[-1] = spans[-1][0], end
        else:
            spans.append((begin, end))
    return [(begin, end) for begin, end in spans if end > begin]


def _deviation(odometry: Odometry) -> dict[str, float]:
    """Return the mean standard deviations of an Odometry (m, rad), and the share of lasting errors."""
    known = np.einsum("nii->n", odometry.covariance[:, :3, :3]) <= LOST**2
    rows = known if known.any() else np.ones(len(known), bool)
    variance = np.einsum("nii->ni", odometry.covariance[rows, :3, :3]).mean(axis=0)
    lasting = float(
        np.einsum("nii->n", odometry.consider_covariance[rows]).mean() / max(variance.sum(), 1e-12)
    )
    yaw = rotation_std(odometry.q[-1:], odometry.covariance[-1:])[0, 2]
    out = {f"std_{axis}": float(math.sqrt(value)) for axis, value in zip("xyz", variance)}
    std = float(math.sqrt(variance.sum()))
    return out | {"std": std, "within": SIGMAS * std, "lasting": lasting, "yaw_std": float(yaw)}


def _doubts(
    flight: Flight, left: Residuals, figures: Mapping[str, Any], lost: Sequence[tuple[float, float]]
) -> Iterator[str]:
    """Yield reasons against an estimate."""
    if figures["lost"] > LARGEST_LOST_SHARE * figures["seconds"]:
        spans = ", ".join(
            f"{begin - left.t.min():.0f} - {end - left.t.min():.0f} s" for begin, end in lost[:5]
        )
        yield (
            f"the tag was lost for {figures['lost']:.0f} s of {figures['seconds']:.0f} s "
            f"({spans}{', ...' * (len(lost) > 5)})"
        )
    if figures["recoveries"]:
        yield (
            f"the filter was wrong and was reset to another position {figures['recoveries']} times"
        )
    if figures["explained"] < SMALLEST_EXPLAINED_SHARE:
        yield f"{1.0 - figures['explained']:.0%} of the {_measured(figures)} speak against it"
    if figures["std"] > LOST:
        yield f"the position is stated to no better than {figures['std']:.1f} m"
    if flight.imu is not None and figures["yaw_std"] > YAW_KNOWN:
        yield f"the yaw is unknown at the end: +-{math.degrees(figures['yaw_std']):.0f} degrees"


def _remedies(
    flight: Flight, left: Residuals, figures: Mapping[str, Any], corrected: bool
) -> Iterator[str]:
    """Yield improvements for the next recording."""
    ids = np.unique(np.concatenate([left.a, left.b]).astype(int))
    lacking = ids[flight.anchors.index(ids) < 0]
    if len(lacking):
        yield (
            f"survey anchor {', '.join(map(str, lacking.tolist()))}, which the tag hears: its "
            f"{_measured(figures)} are not used"
        )
    if flight.imu is None:
        yield "record the inertial sensor, too: the filter then knows the attitude, and bridges gaps"
    if (
        figures["std_z"] > WEAK_HEIGHT_RATIO * max(figures["std_x"], figures["std_y"])
        and flight.height is None
    ):
        yield (
            "the height is the weakest coordinate: add a range finder that looks down, or put "
            "anchors further apart in height (plan says where)"
        )
    if not corrected and figures["lasting"] > LASTING_SHARE:
        yield (
            f"{figures['lasting']:.0%} of the variance is of errors that last, as of delays and "
            "places of anchors: calibrate them"
        )
