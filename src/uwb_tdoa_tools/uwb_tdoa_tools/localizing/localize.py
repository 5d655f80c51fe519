# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings to trajectories, one by one: files of a trajectory, and how reliable it is.

The assessment uses the recording and the run, without ground truth.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
import math
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_filled, write_picture
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.core.yaw_check import YAW_KNOWN
from uwb_tdoa_ekf.monitoring.finding import ERROR
from uwb_tdoa_ekf.offline import Run
from uwb_tdoa_ekf.results import Odometry, Residuals, rotation_std

from .. import command_lines
from ..bags.bag import write_odometry
from ..checking.check import check
from ..checking.recording import of_flight
from ..checking.watch import OF_ANCHORS, OF_SENSORS
from ..estimate import FlightEstimator
from ..readers.inputs import Reading
from ..scoring.metrics import LOST, has_innovation, nis, radio_residuals
from . import areas, pictures

GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"
# standard deviations that contain the 3D position for 95 % of the time; 1.6 to 2.0 by its shape
SIGMAS = 2.0
LOCATING = (("tdoas", "TDOAs"), ("ranges", "ranges"))  # figures that count measurements, in words
# s, and median times between measurements, without an estimate: the tag is lost
GAP, MISSED = 1.0, 3.0
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
    warned = [
        finding
        for finding in found
        if finding.severity != ERROR and finding.rule in (*OF_ANCHORS, *OF_SENSORS)
    ]
    reasons = [f"check: {finding.cause} ({finding.evidence})" for finding in faults + warned]
    remedies = [f"{finding.cause}: {finding.remedy}" for finding in faults + warned]
    if not len(odometry) or not there.any():
        reasons.append(f"the filter found no place that explains the {_measured(figures)}")
        return Assessment(BAD, figures, [], tuple(reasons), tuple(remedies))
    figures |= _deviation(odometry)
    figures["explained"] = float(pictures.explained(left)[there].mean())
    figures["nis"] = float(nis(left).mean())
    lost = lost_spans(left.t, odometry)
    figures["lost"] = float(sum(end - begin for begin, end in lost))
    doubts = list(_doubts(flight, left, figures, lost))
    level = GOOD
    if faults or figures["lost"] > 0.5 * figures["seconds"]:
        level = BAD
    elif warned or doubts:
        level = DOUBTFUL
    remedies += estimator.remarks(flight.anchors)
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

    The tag is lost with a deviation above LOST, or without an estimate for GAP, or longer where it is
    heard less often. Spans closer than that are joined. They end with the last stamp in `heard` (n,) s.
    """
    steps = np.diff(np.unique(heard))
    gap = max(GAP, MISSED * float(np.median(steps))) if len(steps) else GAP
    t, std = odometry.t, np.sqrt(np.einsum("nii->n", odometry.covariance[:, :3, :3]))
    ends = np.append(t[1:], max(t[-1], heard.max(initial=-math.inf)))
    wide = (std > LOST) | (ends - t > gap)
    spans: list[tuple[float, float]] = []
    for begin, end in zip(t[wide].tolist(), ends[wide].tolist()):
        if spans and begin - spans[-1][1] < gap:
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


COLUMNS = (
    "t",
    "x",
    "y",
    "z",
    "qx",
    "qy",
    "qz",
    "qw",
    "vx",
    "vy",
    "vz",
    "std_x",
    "std_y",
    "std_z",
    "std_vx",
    "std_vy",
    "std_vz",
    "std_yaw",
    "circle",
)
SUFFIXES = ".gz", ".csv", ".bag", ".mcap", ".db3", ".log"


def trajectory_rows(odometry: Odometry) -> np.ndarray:
    """Return the COLUMNS of an Odometry, (n, 19), in the world frame.

    Columns: s, m, quaternion from body to world, m/s, then standard deviations in m, m/s and rad, and
    the radius in m of a circle about x and y that holds the tag for 95 % of the time.
    """
    std = np.sqrt(np.einsum("nii->ni", odometry.covariance))
    yaw = rotation_std(odometry.q, odometry.covariance)[:, 2]
    circle = areas.circle_of(odometry.covariance)
    return np.column_stack(
        [odometry.t, odometry.p, odometry.q, odometry.v, std[:, :6], yaw, circle]
    )


def write_trajectory(path: Path, odometry: Odometry) -> None:
    """Write `trajectory_rows` of an Odometry as CSV, one line per estimate."""
    rows = trajectory_rows(odometry)
    kinds = ["%.9f"] + ["%.6f"] * (len(COLUMNS) - 1)
    write_filled(
        path,
        lambda file: np.savetxt(
            file, rows, fmt=kinds, delimiter=",", header=",".join(COLUMNS), comments=""
        ),
    )


def write_tum(path: str | Path, t: np.ndarray, p: np.ndarray, q: np.ndarray) -> None:
    """Write a TUM trajectory, `stamp x y z qx qy qz qw` per line, for evo and others.

    Parameters
    ----------
    t : (n,) s.
    p : (n, 3) m.
    q : (n, 4) x y z w; an unknown attitude becomes the identity.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    q = np.where(np.isfinite(q), q, [0.0, 0.0, 0.0, 1.0])
    write_filled(
        path, lambda file: np.savetxt(file, np.column_stack([t, p, q]), fmt=["%.9f"] + ["%.6f"] * 7)
    )


@dataclass(frozen=True)
class Located:
    """Result of a recording: name of its files, assessment, written files, track and stays."""

    flight: str
    assessment: Assessment
    written: tuple[Path, ...]
    track: areas.Track
    stays: tuple[areas.Stay, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        assessment = self.assessment
        return {
            "flight": self.flight,
            "verdict": assessment.level,
            **assessment.figures,
            "lost_spans": assessment.lost,
            "reasons": list(assessment.reasons),
            "remedies": list(assessment.remedies),
            "stays": [asdict(stay) for stay in self.stays],
            "files": [str(path) for path in self.written],
        }


@dataclass(frozen=True)
class Localizer:
    """Localize a recording (path, survey) and return Located. Its ground truth is not read.

    Can be pickled. Raises InputError.

    Attributes
    ----------
    reading : how recordings are read.
    estimator : filter with corrections.
    folder : output folder.
    bag, residuals : also write a bag, residuals.
    zones : m, size of squares for a table of heard anchors, or None.
    effects : file with the effects of the estimator, or None.
    areas : named polygons, whose visits are written.
    """

    reading: Reading
    estimator: FlightEstimator
    folder: Path
    bag: bool = False
    residuals: bool = False
    zones: float | None = None
    effects: str | None = None
    areas: areas.Areas = field(default_factory=dict)

    def __call__(self, recording: tuple[Path, str | Path | None]) -> Located:
        flight, name = self.reading.read(recording), name_of(recording[0])
        run = self.estimator(flight)
        line = command_lines.survey_line(*recording, self.effects)
        assessment = assess(flight, run, self.estimator, line)
        written = []

        def path(end: str) -> Path:
            written.append(self.folder / f"{name}{end}")
            return written[-1]

        odometry, left = run.odometry, radio_residuals(flight, run)
        write_tum(path(".tum"), odometry.t, odometry.p, odometry.q)
        write_trajectory(path(".csv"), odometry)
        title = f"{name}: {assessment.sentences()[0].partition(';')[0]}"
        figure = pictures.estimate_figure(odometry, flight.anchors, assessment.lost, title)
        write_picture(path(".png"), figure)
        if self.bag and len(odometry):
            write_odometry(odometry, flight.anchors, path("_bag"), force=True)
        if self.residuals:
            pictures.write_residuals(path("_residuals.csv"), left)
            pictures.draw_residuals(path("_residuals.png"), left, name)
        if self.zones is not None and (found := pictures.zones_of(odometry, left, self.zones)):
            pictures.write_zones(path("_zones.csv"), found)
            pictures.draw_zones(
                path("_zones.png"),
                found,
                flight.anchors,
                self.zones,
                f"{name}: squares of {self.zones:g} m",
            )
        track = areas.track_of(odometry)
        stays = (*areas.visits(track, self.areas), *areas.parked(track))
        if stays:
            areas.write_stays(path("_stays.csv"), stays)
        files = tuple(file for file in written if file.exists())
        return Located(name, assessment, files, track, stays)


def name_of(path: str | Path) -> str:
    """Return the base name of the files of a recording: its name without known suffixes."""
    name = Path(path).name
    while Path(name).suffix in SUFFIXES:
        name = Path(name).stem
    return name.removesuffix("_bag")


def check_names(recordings: Sequence[tuple[Path, str | Path | None]]) -> None:
    """Raise InputError if two recordings (path, survey) would be written to the same files."""
    seen: dict[str, Path] = {}
    for path, _ in recordings:
        other = seen.setdefault(name_of(path), path)
        if other is not path:
            raise InputError(
                f"{path}: {other} has the same name, so that one would replace the other; "
                "localize them to two directories."
            )


def all_good(located: Iterable[Located]) -> bool:
    """Return whether all recordings are good."""
    return all(one.assessment.level == GOOD for one in located)
