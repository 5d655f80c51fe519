# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Score recordings one by one against their ground truth, and tabulate the errors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.files import write_picture
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.results import Odometry, Residuals

from .bags.bag import RecordedOdometry, late_tdoas, read_odometry
from .checking.check import check, judge_truth, survey_remarks
from .checking.motion_rules import judge_imu
from .checking.recording import of_flight
from .checking.watch import BEFORE_TRUTH
from .choices import ALIGN, FRAME, NONE, TIME
from .cli import file_name
from .estimate import FlightEstimator
from .localizing.localize import write_tum
from .readers.inputs import Reading, Recording, report_remarks
from .scoring.evaluation import (
    Alignment,
    corrected_truth,
    delays_fit,
    estimate_alignment,
    require_truth,
)
from .scoring.metrics import Result, Score, radio_residuals
from .scoring.phases import TITLES

COLUMNS = {
    "rmse_x": "x",
    "rmse_y": "y",
    "rmse_z": "z",
    "rmse_3d": "3D",
    "median_3d": "median",
    "max_3d": "max",
    "frac_gt_1m": ">1 m",
    "nees_mean": "NEES",
    "nis_mean": "NIS",
    "start_delay": "delay",
}
PHASE = {  # of the figures of a phase
    "duration": "s",
    "rmse_x": "x",
    "rmse_y": "y",
    "rmse_z": "z",
    "rmse_3d": "3D",
    "max_3d": "max",
    "std_3d": "stated",
    "nees_mean": "NEES",
    "step": "step",
    "without_estimate": "without, s",
}
OF_RUNS = {
    "rmse_3d_median_of_runs": "runs: median",
    "rmse_3d_max_of_runs": "largest",
    "nees_mean_max_of_runs": "largest NEES",
}
ERRORS = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "median_3d", "max_3d")


@dataclass(frozen=True)
class Evaluator:
    """Return the Result of a recording (path, survey): score the filter, or a recorded odometry.

    Can be pickled. Raises InputError.

    Attributes
    ----------
    reading : how recordings are read.
    estimator : filter with corrections.
    odometry : bag whose odometry is scored instead, or None.
    picture : image file of the errors, or None.
    trajectories : folder for TUM files, or None.
    align : one of ALIGN, alignment of the ground truth before scoring.
    """

    reading: Reading = Reading()
    estimator: FlightEstimator = FlightEstimator()
    odometry: str | None = None
    picture: str | None = None
    trajectories: Path | None = None
    align: str = NONE

    def __call__(self, recording: Recording) -> Result:
        """Return the Result of a Recording, (path, survey).

        The Result is of the truth aligned as asked. Its 3D RMSE is given for each of ALIGN. Remarks
        on the survey go to stderr, and causes of the error if the run diverged or the truth is off.
        """
        flight = self.reading.read(recording)
        require_truth(flight, self.align == NONE)
        survey_sentences = []
        if not self.odometry:
            survey_sentences = [*survey_remarks(flight), *self.estimator.remarks(flight.anchors)]
        survey_sentences += [
            f"{one.cause}: {one.evidence}; {one.remedy}." for one in judge_imu(flight, stamps=False)
        ]
        report_remarks(flight.name, survey_sentences)
        odometry: Odometry | RecordedOdometry
        residuals: Residuals | None
        if self.odometry:
            recorded = read_odometry(self.odometry, *self._where)
            odometry, residuals = recorded, None
            report_remarks(self.odometry, recorded.remarks)
        else:
            run = self.estimator(flight)
            odometry, residuals = run.odometry, radio_residuals(flight, run)
            flight = replace(flight, truth=corrected_truth(flight, self.estimator.effects))
        alignment = estimate_alignment(flight, odometry)
        truth_findings = list(self._truth_findings(flight, alignment))
        truths = {align: alignment.applied_to(flight.known_truth, align) for align in ALIGN}
        scores = {
            align: Score(flight.name, odometry, truth, residuals, flight.tdoa.t)
            for align, truth in truths.items()
        }
        score, truth = scores[self.align], truths[self.align]
        if truth_findings or (score.row()["diverged"] and not score.row()["late_start"]):
            # A late start alone is no divergence. Wrong ids or anchors make the truth look wrong too:
            # its findings count only without such findings.
            causes = self._anchor_findings(flight)
            report_remarks(
                flight.name,
                [text for text in causes or truth_findings if text not in survey_sentences],
            )
        if self.picture:
            from .scoring.plots import error_figure  # takes a second to import

            write_picture(self.picture, error_figure(score, odometry, truth))
        if self.trajectories:
            folder, name = self.trajectories, file_name(flight.name)
            write_tum(folder / f"{name}.tum", odometry.t, odometry.p, odometry.q)
            write_tum(folder / f"{name}_truth.tum", truth.t, truth.p, truth.q)
        aligned = {
            **alignment.as_dict(),
            "align": self.align,
            "words": alignment.frame_in_words(),
        }
        return replace(
            score.result(),
            aligned=aligned
            | {f"rmse_3d_{align}": each.row()["rmse_3d"] for align, each in scores.items()},
        )

    def _anchor_findings(self, flight: Flight) -> list[str]:
        """Return sentences on wrong ids, signs, units and anchors of a Flight.

        Empty for a recorded odometry.
        """
        if self.odometry:
            return []
        found = check(of_flight(flight), (), self.estimator).findings
        return [
            f"{one.cause}: {one.evidence}; {one.remedy}."
            for one in found
            if one.rule in BEFORE_TRUTH
        ]

    def _truth_findings(self, flight: Flight, found: Alignment) -> Iterator[str]:
        """Yield sentences on errors of the ground truth."""
        align = "judge with --align {}, and put it right where it comes from"
        remedies = {TIME: align, FRAME: align}
        effects = self.estimator.effects or EffectSet()
        # The truth is corrected already.
        straight = replace(effects.correct_streams(flight), truth=flight.truth)
        if found.frame_differs and delays_fit(straight, effects, found):
            remedies[FRAME] = (
                "delays of anchors explain the TDOAs as well: run `diagnose` before you judge with "
                "--align {}"
            )
        for how, words in ((TIME, found.clock_sentence()), (FRAME, found.frame_sentence())):
            if words:
                yield words + (f"; {remedies[how].format(how)}." if self.align == NONE else ".")
        for finding in judge_truth(flight):
            yield f"{finding.cause}: {finding.evidence}; {finding.remedy}."

    def late_tdoas(self) -> int:
        """Return the number of TDOAs that came too late for a recorded odometry."""
        return late_tdoas(self.odometry, *self._where) if self.odometry else 0

    @property
    def _where(self) -> tuple[str, dict[str, str]]:
        return self.reading.namespace, self.reading.topics


def head_line() -> str:
    """Return the heading of the lines of `line_of_run`."""
    return _cells("flight", COLUMNS.values())


def line_of_run(row: dict[str, Any]) -> str:
    """Return the figures of one run, `Score.row`, or of several, `Pool.figures`, as a line."""
    word = ""
    if row["diverged"]:
        word = "  LATE START" if row["diverged"] == row["late_start"] else "  DIVERGED"
    return _cells(row["flight"], (f"{row[key]:.3f}" for key in COLUMNS)) + word


def lines_of_errors(scores: Sequence[Score]) -> list[str]:
    """Return lines of the errors, m, of several Scores of one flight."""
    titles = "".join(f"{COLUMNS[key]:>9s}" for key in ERRORS)
    rows = [
        f"{score.name:28s}" + "".join(f"{score.row()[key]:9.3f}" for key in ERRORS)
        for score in scores
    ]
    return [f"{'error, m':28s}{titles}", *rows]


def lines_of_alignment(aligned: dict[str, Any], means: dict[str, float]) -> Iterator[str]:
    """Yield lines on the alignment of ground truth and estimates.

    Parameters
    ----------
    aligned : of a single run, see Result; empty for several.
    means : {one of ALIGN: 3D RMSE, m}.
    """
    if aligned:
        late = aligned["late"]
        clock = (
            f"its stamps {abs(late):.2f} s {'late' if late > 0.0 else 'early'}"
            if late
            else "its stamps in time"
        )
        yield f"ground truth beside the estimate: {clock}, {aligned['words']}"
    figures = [f"{error:.3f} m --align {how}" for how, error in means.items() if np.isfinite(error)]
    if figures:
        yield f"{'3D RMSE' if aligned else 'mean 3D RMSE of the runs'}: {', '.join(figures)}"


def lines_of_attitude(attitudes: Mapping[str, tuple[float, ...]]) -> Iterator[str]:
    """Yield lines on the errors of attitude of runs, {flight: ATTITUDE}; none if unknown."""
    if not attitudes:
        return
    roll, pitch, yaw, stated, nees = np.mean([*attitudes.values()], axis=0)
    yield (
        f"attitude, degrees (median): roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f} "
        f"({stated:.1f} stated); NEES {nees:.2f}, honest is 3"
    )
    worst = max(attitudes, key=lambda name: attitudes[name][2])
    if len(attitudes) > 1:
        yield f"largest yaw: {attitudes[worst][2]:.1f} degrees in {worst}"


def lines_of_phases(phases: dict[str, dict[str, Any]]) -> list[str]:
    """Return lines on the phases of one run, `Score.phases`, or of several, `Pool.phases`."""
    columns = PHASE | (OF_RUNS if any("runs" in figures for figures in phases.values()) else {})
    head_line = ["phase", *columns.values()]
    rows = [
        [TITLES[name], *(_cell(figures[key]) for key in columns)]
        for name, figures in phases.items()
    ]
    return [
        f"{row[0]:20s}"
        + "".join(
            f"{cell:>{max(8, len(title)) + 1}s}" for cell, title in zip(row[1:], head_line[1:])
        )
        for row in (head_line, *rows)
    ]


def _cell(value: float | None) -> str:
    """Return a number as text; empty if there is none."""
    return (
        ""
        if value is None or math.isnan(value)
        else f"{value:.{1 if abs(value) >= 100.0 else 2 if abs(value) >= 10.0 else 3}f}"
    )


def _cells(first: str, cells: Iterable[str]) -> str:
    return f"{first:20s}" + "".join(f"{cell:>9s}" for cell in cells)
