# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find missing effects from residuals, and reduce the error."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from functools import partial

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text

from .. import cli, command_lines, options, parallel
from ..choices import DRIFT, NONE, PLAN_SPEED, PLAN_TIME, REFERENCES, TAPE_STD
from ..cli import exclusive, option

DESCRIPTION = """Find systematic errors in the measurements of some flights, and correct them.

Computes the residuals of every channel, and traces them to effects that the model lacks, with their uncertainty and
alternatives. Adds the effects that help, and reports the error before and after on hold-out data.
Writes diagnosis.json, effects.yaml (for evaluate, bias_node and ekf_node), ekf_node.yaml (the noise that the filter should
assume with them; --config of evaluate) and report.html. If the ground truth is in another frame, truth_to_survey.txt has its
transform.
Exit code: 0 done; 1 ids, signs or units are wrong, or the survey is of another room, and --no-truth or --reference marks is given;
2 bad input."""

MOST = 300_000  # TDOAs; what they take: docs/notebook/speed.md
BLIND = "nothing", "marks"  # references of which no path shows that ids are wrong
UNUSED = {  # by references, of the options of what is known
    "truth": ("marks", "distances", "odometry"),
    "heights": ("marks", "distances", "odometry", "plan_flight"),
    "odometry": ("distances", "plan_flight"),
    "marks": ("odometry", "plan_flight"),
    "nothing": ("odometry", "plan_flight"),
}


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "diagnose",
        DESCRIPTION,
        "diagnose flight_bag --out diagnosis/",
        (
            "diagnose 0425-traj1 0425-traj2 --survey anchor_0425.txt --holdout 0425-traj3 --out "
            "diagnosis/"
        ),
        "diagnose flight_bag --effects effects.yaml --out second/",
        "diagnose flight_bag --reference heights --out by-height/",
        (
            "diagnose flight_bag --reference odometry --odometry /vio/odometry --marks marks.yaml "
            "--out by-odometry/"
        ),
        "diagnose flight_bag --plan-flight -3 3 -4 4 0 3 --out diagnosis/",
        "diagnose flight_bag --no-truth --out without/",
        "diagnose today_bag --no-truth --effects last-week/effects.yaml --out today/",
        options=[
            *options.recordings(),
            *options.filtering(
                "effects.yaml: effects in the model already; without ground truth its covariance is "
                "the prior"
            ),
            options.PARAMETERS,
            options.HOLDOUT,
            exclusive(
                option(
                    "--reference",
                    choices=REFERENCES,
                    default="truth",
                    help=(
                        "what flights are compared with: their ground truth (default), the heights of a range "
                        "finder, --marks, "
                        "--odometry, or nothing; other references are not read"
                    ),
                ),
                option(
                    "--no-truth",
                    dest="reference",
                    action="store_const",
                    const="nothing",
                    help="short for --reference nothing",
                ),
            ),
            *options.KNOWN,
            option(
                "--odometry",
                metavar="CSV|TOPIC",
                help=(
                    "path of another odometry or SLAM, in a frame of its own with z up: a CSV file with "
                    "columns flight, t, x, y, z, or a "
                    "topic (nav_msgs/Odometry) of the bags; with --marks, e.g. where it took off and "
                    "landed, it goes through them"
                ),
            ),
            option(
                "--drift",
                type=float,
                default=DRIFT,
                metavar="M",
                help="of that, m per square root of a second (default %(default)s)",
            ),
            option(
                "--plan-flight",
                nargs=6,
                type=float,
                metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
                help=(
                    "plan the flight that settles what stays ambiguous, m, between these walls, floor and "
                    "ceiling; needs ground truth. Writes next_flight.csv (t, x, y, z, yaw; for simulate "
                    "--poses), .tum and _waypoints.csv"
                ),
            ),
            option(
                "--plan-time",
                type=float,
                metavar="S",
                default=PLAN_TIME,
                help="of that flight, s at most (default %(default)s)",
            ),
            option(
                "--plan-speed",
                type=float,
                metavar="M/S",
                default=PLAN_SPEED,
                help="of that flight, m/s at most (default %(default)s)",
            ),
            options.most(MOST),
            options.align(),
            options.JOBS,
            options.out(),
        ],
    )


def _diagnose(args: Namespace) -> int:
    from uwb_tdoa_bias.effects import EffectSet

    from ..checking.check import nothing_comes_first, remarks_on
    from ..diagnosis import diagnose, output, references, with_noise
    from ..diagnosis.motions import Limits, motions
    from ..diagnosis.next_flight import plan_flight
    from ..diagnosis.noise import has_imu, write_parameters
    from ..estimate import FlightEstimator
    from ..readers import inputs
    from ..simulation.config import Room
    from ..surveying.report import read_paths

    out = args.out
    options.refuse(
        args, UNUSED[args.reference], f"no part of it is used with --reference {args.reference}"
    )
    config, effects = options.filter_of(args)
    reading = options.reading_of(args)
    judge = FlightEstimator(config, effects)
    if args.reference in BLIND and not nothing_comes_first(
        "diagnose", reading, args.flights, judge, TAPE_STD
    ):
        return 1
    found = reading.find(args.flights)
    jobs, over = parallel.workers_for(args, len(found))
    flights, holdout = (
        reading.flights(paths, args.most, jobs) for paths in (args.flights, args.holdout)
    )
    options.check_holdout((flight.name for flight in flights), (flight.name for flight in holdout))
    if args.reference in ("heights", "odometry"):
        inputs.require_tdoas([*flights, *holdout], f"--reference {args.reference}")
    surveys = [its_survey for _, its_survey in (*found, *reading.find(args.holdout))]
    remarks = remarks_on([*flights, *holdout], surveys)
    cli.say("diagnose", *remarks, *judge.remarks(flights[0].anchors))
    for name in ("marks", "odometry"):
        if args.reference == name and getattr(args, name) is None:
            raise InputError(f"--reference {name}: --{name} says which, and is missing.")
    every = (*flights, *holdout)
    known = (
        *options.known_of(args, every),
        *(
            read_paths(args.odometry, every, args.drift, args.namespace)
            if args.odometry is not None
            else ()
        ),
    )
    reference = references.REFERENCES[args.reference](
        config, known, *[args.align][: args.reference == "truth"]
    )
    library = (
        motions(
            Room.of_numbers("--plan-flight", args.plan_flight),
            flights,
            Limits(args.plan_time, args.plan_speed),
        )
        if args.plan_flight
        else None
    )
    with cli.Progress("diagnose") as progress:
        result = diagnose(
            flights, holdout, effects or EffectSet(), config, reference, progress, over
        )
        progress("measuring the noise")
        result = with_noise(result, config, over, partial(cli.say, "diagnose"))
    if library:
        plan = plan_flight(result.flights, result.attribution, result.findings, library)
        result = replace(result, next_flight=plan)
        if plan is None:
            cli.say("diagnose", "no effect was found, so no flight is planned to settle one")
    from ..diagnosis.report.page import html  # here, because drawing takes a second to import

    out.mkdir(parents=True, exist_ok=True)
    (_, its_survey), *_ = found
    write_parameters(out / "ekf_node.yaml", result.tdoa_std, config, has_imu([*flights, *holdout]))
    truth = all(flight.truth is not None for flight in holdout or flights)
    more = [*options.words_of_reading(args)]
    more += [word for sensor in reference.left_out for word in ("--without", sensor)]
    more += ["--align", args.align] if truth and args.align != NONE else []
    applying = command_lines.lines_of_use(
        out,
        args.holdout or args.flights,
        args.survey,
        its_survey,
        truth,
        more,
    )
    result = replace(result, applying=applying)
    cli.write_json(out / "diagnosis.json", output.as_json(result))
    result.effects.to_yaml(out / "effects.yaml")
    write_text(out / "report.html", html(result))
    more_files = {
        **(result.next_flight.files() if result.next_flight else {}),
        **(result.truth_transform.files() if result.truth_transform else {}),
    }
    for name, text in more_files.items():
        write_text(out / name, text)
    cli.show(output.as_text(result))
    files = "diagnosis.json", "effects.yaml", "ekf_node.yaml", *more_files
    cli.show(f"wrote {', '.join(files)} and report.html to {out}")
    return 0


main = cli.executable(_diagnose, parser)
