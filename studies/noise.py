# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""noise: test whether the covariance of the position is honest after a calibration (NEES, 3 is
right).

The flights are hold-out flights, with IMU and without. The filter runs with its default parameters
and with the parameters that `survey` and `diagnose` write. With --vary, one more parameter at a
time is a fraction or a multiple of its default.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.diagnosis.self_calibration.equations import tdoa_std_of
from uwb_tdoa_tools.scoring.evaluation import evaluate

from .diagnosis.measured import SPLITS
from .surveying import KNOWN, at, measured_flights

HONEST = 1.5, 4.5  # mean NEES of a flight
# parameter: factors; a longer correlation needs a smaller tdoa_std, to give TDOAs the same weight
VARIED = {
    "tdoa_correlation_length": (0.25, 4.0),
    "motion_noise": (0.5, 2.0),
    "accel_noise": (0.5, 2.0, 4.0),
    "gyro_noise": (0.5, 2.0, 4.0),
}


def add_options(add):
    """add : add_argument of a parser."""
    add("--data", type=Path, required=True, metavar="DATA", help="folder of measured flights")
    add(
        "--diagnosed",
        type=Path,
        metavar="DIR",
        help="what `study diagnosis measured` wrote, for rows with ground truth",
    )
    add(
        "--split",
        choices=tuple(SPLITS),
        nargs="+",
        default=[name for name in SPLITS if SPLITS[name][1]],
        help="these alone",
    )
    add(
        "--vary",
        action="store_true",
        help="instead: surveys with marks, and one more parameter of the filter changed at a time",
    )


def run(args):
    """Print a table, a row for each split and calibration, and how many flights are honest."""
    if args.vary:
        return vary(args.data, args.split)
    print(
        "| split | calibrated | tdoa_std | IMU | NEES, as they are | as told | 3D RMSE, as "
        "they are | as told |\n|---|---|---:|---|---:|---:|---:|---:|"
    )
    honest = {}
    for name in args.split:
        flights, judged = (measured_flights(args.data, paths) for paths in SPLITS[name])
        for how, positions, effects, tdoa_std in calibrations(name, flights, args.diagnosed):
            for imu in ("with", "without"):
                some = [
                    at(flight if imu == "with" else replace(flight, imu=None), positions)
                    for flight in judged
                ]
                if imu == "with" and any(flight.imu is None for flight in some):
                    continue
                sides = [
                    figures(some, FilterConfig(tdoa_std=std), effects)
                    for std in (FilterConfig.tdoa_std, tdoa_std)
                ]
                honest.setdefault((how, imu), []).append(
                    [(HONEST[0] <= nees) & (nees <= HONEST[1]) for nees, _ in sides]
                )
                nees = " | ".join(
                    f"{nees.mean():.1f} ({nees.min():.1f} - {nees.max():.1f})" for nees, _ in sides
                )
                print(
                    f"| {name} | {how} | {tdoa_std:.2f} | {imu} | {nees} | "
                    + " | ".join(f"{error:.3f}" for _, error in sides)
                    + " |",
                    flush=True,
                )
    for (how, imu), several in honest.items():
        counts = [np.concatenate([one[side] for one in several]) for side in (0, 1)]
        print(
            f"{how}, {imu} IMU: NEES from 1.5 to 4.5 in "
            + ", ".join(
                f"{int(c.sum())} of {len(c)} {w}"
                for c, w in zip(counts, ("as they are", "as told"))
            )
        )


def vary(data, splits):
    """Print a table: mean NEES and mean 3D RMSE of judged flights with what a survey writes, and
    what one more parameter would change.
    """
    print("| split | parameter | times | NEES | 3D RMSE |\n|---|---|---:|---:|---:|")
    for name in splits:
        flights, judged = (measured_flights(data, paths) for paths in SPLITS[name])
        ((_, positions, effects, tdoa_std),) = calibrations(
            name, flights, None, ("survey with marks",)
        )
        some, told = [at(flight, positions) for flight in judged], FilterConfig(tdoa_std=tdoa_std)
        inertial = all(flight.imu is not None for flight in some)
        idle = ("motion_noise",) if inertial else ("accel_noise", "gyro_noise")
        rows = [("as told", 1.0, told)]
        for parameter, factors in VARIED.items():
            for factor in factors if parameter not in idle else ():
                std = (
                    tdoa_std / np.sqrt(factor)
                    if parameter == "tdoa_correlation_length"
                    else tdoa_std
                )
                rows.append(
                    (
                        parameter,
                        factor,
                        replace(
                            told,
                            **{
                                parameter: factor * getattr(told, parameter),
                                "tdoa_std": float(std),
                            },
                        ),
                    )
                )
        for parameter, factor, config in rows:
            nees, error = figures(some, config, effects)
            print(
                f"| {name} | {parameter} | {factor:g} | {nees.mean():.1f} | {error:.3f} |",
                flush=True,
            )


def calibrations(name, flights, diagnosed, wanted=("survey", "survey with marks")):
    """Yield (how, positions of the anchors (N, 3) m, EffectSet, tdoa_std m) of a split. wanted :
    which surveys.
    """
    bare, given, rng = (
        [replace(flight, truth=None) for flight in flights],
        flights[0].anchors.positions,
        np.random.default_rng(0),
    )
    marks = [mark for flight in flights for mark in KNOWN["marks"](flight, len(flights), rng)]
    for how, known in (
        (how, known)
        for how, known in (("survey", ()), ("survey with marks", marks))
        if how in wanted
    ):
        result = self_calibrate(bare, Tape(), constraints=known)
        yield how, result.anchors.positions, result.effects, result.tdoa_std
    path = diagnosed / name.replace(" ", "-") / "effects.yaml" if diagnosed else None
    if path is not None and path.is_file():
        effects = EffectSet.from_yaml(path)
        yield "diagnose, ground truth", given, effects, tdoa_std_of(bare, effects)


def figures(flights, config, effects):
    """((n,) mean NEES of each flight, mean 3D RMSE m)."""
    rows = [evaluate(flight, config, effects)[0].row() for flight in flights]
    return np.array([row["nees_mean"] for row in rows]), float(
        np.mean([row["rmse_3d"] for row in rows])
    )
