"""Pairs of measured and true positions, to fit a bias map to: from flights, and from places where a tag stood still."""

import csv
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.debias import Part
from uwb_tdoa_ekf.offline import run_offline

from ..readers import inputs
from ..scoring.evaluation import judging_truth
from ..scoring.metrics import position_at
from ..readers import read_flight

LEAST = 10  # positions of flights, 5 ms apart, that make a marker
COLUMNS = ("true_x", "true_y", "true_z", "x", "y", "z")
SETTLE = 1.0  # s at a place before positions count
REST = 0.02  # m that a tag at rest may move in SETTLE
SHORTEST = 100  # positions that make a stay


def part_of(score, odometry):
    """Part of an evaluated flight: its airborne odometry, at the stamps that the Score has."""
    measured = odometry.p[(odometry.t >= score.first) & (odometry.t <= score.last)]
    return Part(measured, measured - score.error, score.covariance)


def static_parts(path, survey=None, config=None, effects=None, planar=False):
    """List of Part of a tag that stood still, one for each place.

    path : a CSV file with the columns true_x, true_y, true_z, x, y, z (m; without the z if planar), one row for each
        measured position; or any recording with ground truth, through which the filter is run, and of which the time at
        rest counts, but for the first SETTLE s at each place. Raises InputError.
    """
    if not Path(path).is_dir():
        with open(path, "rb") as file:
            if b"true_x" in file.readline():
                return _from_table(path, planar)
    flight = read_flight(path, inputs.survey_for(path, survey))
    if flight.truth is None:
        raise InputError(f"{path}: holds no ground truth; record where the tag stood as ground_truth/pose.")
    odometry = run_offline(flight, config, Corrector(flight.anchors, effects)).odometry
    truth = judging_truth(flight, effects)
    true, t = position_at(odometry.t, truth), odometry.t
    moved = np.linalg.norm(true - position_at(t - SETTLE, truth), axis=1)
    resting = (moved < REST) & (t > np.min(t, initial=np.inf) + SETTLE)
    stays = np.split(np.arange(len(t)), np.flatnonzero(np.diff(resting)) + 1)
    stays = [rows for rows in stays if len(rows) >= SHORTEST and resting[rows[0]]]
    if not stays:
        raise InputError(f"{path}: the tag never stands still for long enough; give it as a flight, not with --static.")
    return [Part(odometry.p[rows], true[rows], odometry.covariance[rows, :3, :3]) for rows in stays]


def _from_table(path, planar):
    names = [name for name in COLUMNS if not (planar and name.endswith("z"))]
    with open(path, newline="") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        missing = [name for name in names if name not in (rows.fieldnames or ())]
        if missing:
            raise InputError(f"{path}: has no column {missing[0]}; it needs {', '.join(names)}, in metres.")
        values = []
        for row in rows:
            try:
                values.append([float(row[name]) for name in names])
            except (TypeError, ValueError):
                raise InputError(
                    f"{path}: line {rows.line_num}: {row} needs a number in each of {', '.join(names)}."
                ) from None
    if not values:
        raise InputError(f"{path}: holds no positions; give one row for each.")
    table, d = np.array(values), len(names) // 2
    _, place = np.unique(table[:, :d], axis=0, return_inverse=True)
    true, measured = (np.pad(side, ((0, 0), (0, 3 - d))) for side in (table[:, :d], table[:, d:]))
    return [Part(measured[rows], true[rows]) for rows in (place.ravel() == k for k in range(place.max() + 1))]
