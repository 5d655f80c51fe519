"""noise: whether the covariance of the position is honest after a calibration (NEES, 3 is right), on flights that took no part in it,
with IMU and without, with the parameters of the filter as they are and as `survey` and `diagnose` write them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig

from ..diagnosis.self_survey import tdoa_std_of
from ..scoring.evaluation import evaluate
from ..surveying.survey import survey
from ..surveying.tape import Tape
from .diagnosis.measured import SPLITS
from .surveying import KNOWN, at, measured_flights

HONEST = 1.5, 4.5  # mean NEES of a flight


def add_options(add):
    """add : add_argument of a parser."""
    add("--data", type=Path, required=True, metavar="DATA", help="folder of measured flights")
    add("--diagnosed", type=Path, metavar="DIR", help="what `study diagnosis measured` wrote, for rows with ground truth")
    add("--split", choices=tuple(SPLITS), nargs="+", default=[name for name in SPLITS if SPLITS[name][1]], help="these alone")


def run(args):
    """Print a table, a row for each split and calibration, and how many flights are honest."""
    print("| split | calibrated | tdoa_std | IMU | NEES, as they are | as told | 3D RMSE, as they are | as told |\n|---|---|---:|---|---:|---:|---:|---:|")
    honest = {}
    for name in args.split:
        flights, judged = (measured_flights(args.data, paths) for paths in SPLITS[name])
        for how, positions, effects, tdoa_std in calibrations(name, flights, args.diagnosed):
            for imu in ("with", "without"):
                some = [at(flight if imu == "with" else replace(flight, imu=None), positions) for flight in judged]
                if imu == "with" and any(flight.imu is None for flight in some):
                    continue
                sides = [figures(some, FilterConfig(tdoa_std=std), effects) for std in (FilterConfig.tdoa_std, tdoa_std)]
                honest.setdefault((how, imu), []).append([(HONEST[0] <= nees) & (nees <= HONEST[1]) for nees, _ in sides])
                nees = " | ".join(f"{nees.mean():.1f} ({nees.min():.1f} - {nees.max():.1f})" for nees, _ in sides)
                print(f"| {name} | {how} | {tdoa_std:.2f} | {imu} | {nees} | " + " | ".join(f"{error:.3f}" for _, error in sides) + " |", flush=True)
    for (how, imu), several in honest.items():
        counts = [np.concatenate([one[side] for one in several]) for side in (0, 1)]
        print(f"{how}, {imu} IMU: NEES from 1.5 to 4.5 in " + ", ".join(f"{int(c.sum())} of {len(c)} {w}" for c, w in zip(counts, ("as they are", "as told"))))


def calibrations(name, flights, diagnosed):
    """Yield (how, positions of the anchors (N, 3) m, EffectSet, tdoa_std m) of a split."""
    bare, given, rng = [replace(flight, truth=None) for flight in flights], flights[0].anchors.positions, np.random.default_rng(0)
    marks = [mark for flight in flights for mark in KNOWN["marks"](flight, len(flights), rng)]
    for how, known in (("survey", ()), ("survey with marks", marks)):
        result = survey(bare, Tape(), constraints=known)
        yield how, result.anchors.positions, result.effects, result.surveyed.tdoa_std
    path = diagnosed / name.replace(" ", "-") / "effects.yaml" if diagnosed else None
    if path is not None and path.is_file():
        effects = EffectSet.from_yaml(path)
        yield "diagnose, ground truth", given, effects, tdoa_std_of(bare, effects)


def figures(flights, config, effects):
    """((n,) mean NEES of each flight, mean 3D RMSE m)."""
    rows = [evaluate(flight, config, effects)[0].row() for flight in flights]
    return np.array([row["nees_mean"] for row in rows]), float(np.mean([row["rmse_3d"] for row in rows]))
