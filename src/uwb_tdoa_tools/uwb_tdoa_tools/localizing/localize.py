# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings to trajectories, one by one, and the files of a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_filled
from uwb_tdoa_ekf.results import Odometry, rotation_std

from .. import command_lines
from ..bags.bag import write_odometry
from ..estimate import FlightEstimator
from ..readers.inputs import Reading
from ..scoring.metrics import radio_residuals
from . import pictures, residuals
from .assessment import GOOD, Assessment, assess

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


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
)
SUFFIXES = ".gz", ".csv", ".bag", ".mcap", ".db3", ".log"


def trajectory_rows(odometry: Odometry) -> np.ndarray:
    """Return the COLUMNS of an Odometry, (n, 18), in the world frame.

    Columns: s, m, quaternion from body to world, m/s, then standard deviations in m, m/s and rad.
    """
    std = np.sqrt(np.einsum("nii->ni", odometry.covariance))
    yaw = rotation_std(odometry.q, odometry.covariance)[:, 2]
    return np.column_stack([odometry.t, odometry.p, odometry.q, odometry.v, std[:, :6], yaw])


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
    """Result of a recording: name of its files, assessment, and the written files."""

    flight: str
    assessment: Assessment
    written: tuple[Path, ...]

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
    rerun : file for Rerun, or None.
    zones : m, size of squares for a table of heard anchors, or None.
    effects : file with the effects of the estimator, or None.
    """

    reading: Reading
    estimator: FlightEstimator
    folder: Path
    bag: bool = False
    residuals: bool = False
    rerun: Path | None = None
    zones: float | None = None
    effects: str | None = None

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
        pictures.draw_estimate(path(".png"), odometry, flight.anchors, assessment.lost, title)
        if self.bag and len(odometry):
            write_odometry(odometry, flight.anchors, path(".bag"), force=True)
        if self.residuals:
            residuals.write_residuals(path("_residuals.csv"), left)
            residuals.draw_residuals(path("_residuals.png"), left, name)
        if self.zones is not None and (found := residuals.zones_of(odometry, left, self.zones)):
            residuals.write_zones(path("_zones.csv"), found)
            residuals.draw_zones(
                path("_zones.png"),
                found,
                flight.anchors,
                self.zones,
                f"{name}: squares of {self.zones:g} m",
            )
        if self.rerun is not None:
            pictures.write_rerun(self.rerun, flight, odometry, left, assessment.sentences())
            written.append(self.rerun)
        return Located(name, assessment, tuple(file for file in written if file.exists()))


def name_of(path: str | Path) -> str:
    """Return the base name of the files of a recording: its name without known suffixes."""
    name = Path(path).name
    while Path(name).suffix in SUFFIXES:
        name = Path(name).stem
    return name


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
