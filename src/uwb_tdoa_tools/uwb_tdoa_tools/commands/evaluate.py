# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Evaluate an estimate against ground truth: of the filter run here, or a recorded odometry."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, options, parallel
from ..cli import OutputFile, OutputFolder, as_json, option

NOT_OF_ODOMETRY = "effects", "config", "model", "no_bias", "parameters", "without", "smooth"


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "evaluate",
        (
            "Errors of the estimate against ground truth, in metres: in the air (truth z > 0.3 "
            "m), and in each phase of the recording,\n"
            "at rest before and after too (without: s with no estimate; step: the largest jump of "
            "the error between two estimates).\n"
            "Runs bias correction and filter here, as the nodes would, or takes a recorded "
            "odometry.\n\n"
            "Exit code: 0 done, 1 a run DIVERGED, or TDOAs were late for a recorded odometry (as "
            "far as uwb/residual was recorded too),\n"
            "2 bad input."
        ),
        "evaluate flight_bag",
        "evaluate 0425-traj2 --survey anchor_0425.txt --plot error.png",
        "evaluate flights/ --survey surveys/ --no-bias --json errors.json",
        "evaluate flight_bag --odometry recorded_bag --tum out/",
        "evaluate flight_bag --odometry tags_bag --topic odometry=/tag1/odometry",
        "evaluate flights/ --survey surveys/ -p adapt_noise:=false -p loss:=huber",
        "evaluate flights/ --survey surveys/ --without height --without pressure",
        options=[
            *options.recordings(),
            *options.ESTIMATOR,
            options.align(judges=True),
            option(
                "--odometry",
                metavar="BAG",
                help="judge the odometry of this bag; needs exactly one FLIGHT",
            ),
            option(
                "--json", metavar="FILE", type=OutputFile, help="write all figures: runs, pooled"
            ),
            option(
                "--plot",
                metavar="FILE",
                type=OutputFile,
                help="picture of the errors over time (one FLIGHT)",
            ),
            option(
                "--tum",
                metavar="DIR",
                type=OutputFolder,
                help="write estimates and truths as TUM trajectories, e.g. for evo",
            ),
            options.JOBS,
        ],
    )


def _evaluate(args: Namespace) -> int:
    from .. import evaluating
    from ..evaluating import Evaluator
    from ..scoring.metrics import Pool

    if args.odometry:
        options.refuse(
            args,
            NOT_OF_ODOMETRY,
            "has no part in an odometry that was recorded, which is judged as it is (--odometry)",
        )
    estimator = options.estimator_of(args)
    reading = options.reading_of(args)
    found = (replace(reading, topics={}, namespace="") if args.odometry else reading).find(
        args.flights
    )
    for name in ("odometry", "plot"):
        if getattr(args, name) and len(found) != 1:
            raise InputError(f"--{name}: needs exactly one flight, got {len(found)}.")
    trajectories = args.tum.absolute() if args.tum else None
    evaluator = Evaluator(reading, estimator, args.odometry, args.plot, trajectories, args.align)
    if not args.odometry:
        cli.show(f"correcting with: {estimator.correction}")
    cli.show(evaluating.head_line())
    kept, pool = [], Pool()
    for result in parallel.over(evaluator, found, args.jobs):
        pool.add(result)
        # else nothing grows with the number of flights
        kept += [result] if args.json else []
        cli.show(evaluating.line_of_run(result.row))
    together = pool.figures()
    if len(found) > 1:
        cli.show(evaluating.line_of_run(together))
        cli.show(
            f"mean 3D RMSE of the runs {together['rmse_3d_mean_of_runs']:.3f} m, largest "
            f"{together['rmse_3d_max_of_runs']:.3f} m, diverged {together['diverged']}"
        )
    cli.show(
        "", *evaluating.lines_of_phases(together["phases"] if len(found) > 1 else result.phases)
    )
    cli.show(
        "", *evaluating.lines_of_alignment(result.aligned if len(found) == 1 else {}, pool.aligned)
    )
    cli.show(*evaluating.lines_of_attitude(pool.attitudes))
    cli.write_json(
        args.json, {"runs": [one.as_json() for one in kept], "pooled": as_json(together)}
    )
    if late := evaluator.late_tdoas():
        cli.say(
            "evaluate",
            f"{args.odometry}: {late} TDOAs came too late for that filter: this is not what "
            "it can do; "
            "replay it in step with the odometry (replay --follow odometry).",
        )
    return int(late > 0 or together["diverged"] > together["late_start"])


main = cli.executable(_evaluate, parser)
