"""Recordings judged one by one, with a picture and trajectories for others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import parallel
from ..bags.bag import late_tdoas, read_odometry
from ..checking.check import check
from ..checking.flight_rules import judge_truth
from ..checking.recording import of_flight
from ..checking.report import survey_remarks
from ..checking.watch import BEFORE_TRUTH
from ..estimate import FlightEstimator
from ..localizing.rerun_file import write_rerun
from ..readers.inputs import Reading, report_remarks
from ..results_file import ResultsFile, fingerprint_of
from ..scoring.alignment import ALIGN, NONE, alignment_of, need_truth
from ..scoring.evaluation import corrected_truth
from ..scoring.metrics import Pool, Result, Score
from ..scoring.tum import write_tum
from . import table

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.results import Odometry, Residuals

    from ..bags.bag import RecordedOdometry
    from ..readers.inputs import Recording
    from ..scoring.alignment import Alignment


@dataclass(frozen=True)
class Evaluator:
    """evaluator((path, survey)) is the Result of a recording: of the filter run over it, or of the
    odometry in a bag.

    reading : Reading; estimator : FlightEstimator; odometry : path of a bag whose odometry is
        judged instead, or None; picture :
    file to draw the errors to, or None; trajectories : folder for TUM files, or None; rerun : file
    for Rerun, or None; align : of ALIGN, what of the ground truth is moved onto the estimate before
    it judges. Raises InputError. Can be pickled.
    """

    reading: Reading = Reading()
    estimator: FlightEstimator = FlightEstimator()
    odometry: str | None = None
    picture: str | None = None
    trajectories: Path | None = None
    rerun: Path | None = None
    align: str = NONE

    def __call__(self, recording: Recording) -> Result:
        flight = self.reading.read(recording)
        need_truth(flight, self.align == NONE)
        told = [] if self.odometry else list(survey_remarks(flight))
        report_remarks(flight.name, told)
        odometry: Odometry | RecordedOdometry
        residuals: Residuals | None
        if self.odometry:
            recorded = read_odometry(self.odometry, *self._where)
            odometry, residuals = recorded, None
            report_remarks(self.odometry, recorded.remarks)
        else:
            run = self.estimator(flight)
            odometry, residuals = run.odometry, run.residuals
            flight = replace(flight, truth=corrected_truth(flight, self.estimator.effects))
        assert flight.truth is not None  # need_truth
        found = alignment_of(flight, odometry)
        found_wrong = list(self._of_truth(flight, found))
        truths = {how: found.applied(flight.truth, how) for how in ALIGN}
        scores = {
            how: Score(flight.name, odometry, one, residuals, flight.tdoa.t)
            for how, one in truths.items()
        }
        score, truth = scores[self.align], truths[self.align]
        if found_wrong or (score.row()["diverged"] and not score.row()["late_start"]):
            causes = self._of_anchors(flight)  # ids and anchors first: the truth is measured better
            report_remarks(flight.name, [one for one in causes or found_wrong if one not in told])
        if self.picture:
            from ..scoring.plots import plot_error  # takes a second to import

            plot_error(score, odometry, truth, self.picture)
        if self.trajectories:
            folder = self.trajectories
            write_tum(folder / f"{flight.name}.tum", odometry.t, odometry.p, odometry.q)
            write_tum(folder / f"{flight.name}_truth.tum", truth.t, truth.p, truth.q)
        if self.rerun:
            lines = [f"{name}: {value}" for name, value in score.row().items()]
            write_rerun(self.rerun, flight, odometry, residuals, lines, truth)
        aligned = {**found.as_dict(), "align": self.align, "words": found.frame_in_words()}
        return replace(
            score.result(),
            aligned=aligned
            | {f"rmse_3d_{how}": one.row()["rmse_3d"] for how, one in scores.items()},
        )

    def _of_anchors(self, flight: Flight) -> list[str]:
        """Sentences on ids, signs, units and anchors that are wrong in a Flight; of a recorded
        odometry nobody can tell.
        """
        if self.odometry:
            return []
        found = check(of_flight(flight), (), self.estimator).findings
        return [
            f"{one.cause}: {one.evidence}; {one.remedy}."
            for one in found
            if one.rule in BEFORE_TRUTH
        ]

    def _of_truth(self, flight: Flight, found: Alignment) -> Iterator[str]:
        """Sentences on the ground truth of a Flight, by its Alignment and by itself."""
        for how, words in (("time", found.of_clock()), ("frame", found.of_frame())):
            if words:
                yield words + (
                    f"; judge with --align {how}, and put it right where it comes from."
                    if self.align == NONE
                    else "."
                )
        for finding in judge_truth(flight):
            yield f"{finding.cause}: {finding.evidence}; {finding.remedy}."

    def late_tdoas(self) -> int:
        """How many TDOAs were late for the odometry that is judged."""
        return late_tdoas(self.odometry, *self._where) if self.odometry else 0

    @property
    def _where(self) -> tuple[str, bool, dict[str, str]]:
        return self.reading.namespace, self.reading.salvage, self.reading.topics


def results(
    evaluator: Evaluator,
    recordings: Sequence[Recording],
    path: str | Path | None,
    asked: dict[str, Any],
    jobs: int | None = None,
    dask: str | None = None,
) -> Iterator[Result]:
    """Generator of the Result of each of some recordings, in turn; those that are in the file
    `path` are not made again.

    path : of a ResultsFile, or None to keep none; asked : all that results depend on besides the
        recording, see there; jobs,
    dask : as of `parallel.over`.
    """
    if path is None:
        yield from parallel.over(evaluator, recordings, jobs, dask)
        return
    keys = [" ".join(map(fingerprint_of, recording)) for recording in recordings]
    with ResultsFile(path, asked) as done:

        def make(missing: Iterable[Recording]) -> Iterator[dict[str, Any]]:
            return (result.as_dict() for result in parallel.over(evaluator, missing, jobs, dask))

        for key in done.keys_done(keys, recordings, make, "flights"):
            yield done.read(key, _sound)


def _sound(content: dict[str, Any]) -> Result:
    """The Result of what a file holds, of which all figures can be made."""
    result, pool = Result.from_dict(content), Pool()
    pool.add(result)
    table.line({**result.row, **pool.figures()})
    table.lines_of_phases(result.phases)
    return result
