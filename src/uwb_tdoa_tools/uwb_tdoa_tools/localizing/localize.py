"""Recordings to trajectories, one by one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.foundation.errors import InputError

from .. import command_lines
from ..bags.bag import write_odometry
from ..estimate import FlightEstimator
from ..readers.inputs import Reading
from ..scoring.tum import write_tum
from . import files, pictures, rerun_file, residuals, zones
from .belief import GOOD, Belief, believe

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

SUFFIXES = ".gz", ".csv", ".bag", ".mcap", ".db3", ".log"


@dataclass(frozen=True)
class Located:
    """What became of a recording: what its files are called, how far it is to be believed, and the
    files that were written.
    """

    flight: str
    belief: Belief
    written: tuple[Path, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        belief = self.belief
        return {
            "flight": self.flight,
            "verdict": belief.level,
            **belief.figures,
            "lost_spans": belief.lost,
            "reasons": list(belief.reasons),
            "remedies": list(belief.remedies),
            "files": [str(path) for path in self.written],
        }


@dataclass(frozen=True)
class Localizer:
    """localizer((path, survey)) is the Located of a recording, whose ground truth is not read. Can
    be pickled.

    reading : Reading; estimator : FlightEstimator; folder : where to write; bag : write a bag, too;
        left : write residuals, too; rerun :
    file for Rerun, or None; zones : m, write who is heard in squares of that size, or None; effects
    : file of those of the estimator, or None. Raises InputError.
    """

    reading: Reading
    estimator: FlightEstimator
    folder: Path
    bag: bool = False
    left: bool = False
    rerun: Path | None = None
    zones: float | None = None
    effects: str | None = None

    def __call__(self, recording: tuple[Path, str | Path | None]) -> Located:
        flight, name = self.reading.read(recording), name_of(recording[0])
        run = self.estimator(flight)
        line = command_lines.survey_line(*recording, self.effects)
        belief = believe(flight, run, self.estimator, line)
        written = []

        def path(end: str) -> Path:
            written.append(self.folder / f"{name}{end}")
            return written[-1]

        odometry, left = run.odometry, residuals.of_run(flight, run)
        write_tum(path(".tum"), odometry.t, odometry.p, odometry.q)
        files.write_csv(path(".csv"), odometry)
        title = f"{name}: {belief.sentences()[0].partition(';')[0]}"
        pictures.draw(path(".png"), odometry, flight.anchors, belief.lost, title)
        if self.bag and len(odometry):
            write_odometry(odometry, flight.anchors, path(".bag"), force=True)
        if self.left:
            residuals.write_csv(path("_residuals.csv"), left)
            residuals.picture(path("_residuals.png"), left, name)
        if self.zones is not None and (found := zones.zones_of(odometry, left, self.zones)):
            zones.write_csv(path("_zones.csv"), found)
            zones.draw(
                path("_zones.png"),
                found,
                flight.anchors,
                self.zones,
                f"{name}: squares of {self.zones:g} m",
            )
        if self.rerun is not None:
            rerun_file.write_rerun(self.rerun, flight, odometry, left, belief.sentences())
            written.append(self.rerun)
        return Located(name, belief, tuple(file for file in written if file.exists()))


def name_of(path: str | Path) -> str:
    """What the files of a recording are called: its own name without what says of which kind it is."""
    name = Path(path).name
    while Path(name).suffix in SUFFIXES:
        name = Path(name).stem
    return name


def check_names(recordings: Sequence[tuple[Path, str | Path | None]]) -> None:
    """Raise InputError if two of some recordings, (path, survey), would be written to the same
    files.
    """
    seen: dict[str, Path] = {}
    for path, _ in recordings:
        other = seen.setdefault(name_of(path), path)
        if other is not path:
            raise InputError(
                f"{path}: {other} has the same name, so that one would replace the other; "
                "localize them to two directories."
            )


def all_good(located: Iterable[Located]) -> bool:
    """Whether all of some Located are good."""
    return all(one.belief.level == GOOD for one in located)
