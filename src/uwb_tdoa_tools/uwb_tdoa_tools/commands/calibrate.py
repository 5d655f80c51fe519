# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibrate a tag from recordings, in one command."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, command_lines, options, parallel
from ..cli import option

if TYPE_CHECKING:  # they take a second to import
    from uwb_tdoa_bias.common.flight import Flight

    from ..surveying.stream import StreamCalibration

DESCRIPTION = """Calibrate a tag from recordings: check them, find systematic errors, and validate the correction on hold-out flights.

With ground truth in every FLIGHT, `diagnose` finds the errors. Without it, or with --no-truth, which leaves it unread, `survey` finds
better anchors and delays from the flights alone. --holdout names the flights for the validation; else it uses the last of several
flights, or parts of a single one. Stops at a step that fails, and prints why. A correction that increases the error is not written.

Writes to --out: anchors.yaml, effects.yaml and ekf_node.yaml, for evaluate and for both nodes, and calibration.json; prints the two
lines that start the nodes. --quick predicts within a minute what that gains, with ground truth or without, and writes nothing.
A flight in which `check` finds an error is left out, and named with the rule; --keep uses it all the same.

--stream calibrates as if the flights were heard one after the other, without their ground truth: in pieces of 35 s, each of which
judges what the pieces before it have found. It prints a line for each piece, and writes the last calibration that was in use.

Exit code: 0 calibrated, or predicted (--quick), 1 stopped, 2 bad input."""


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "calibrate",
        DESCRIPTION,
        "calibrate flight_bag --out calibrated/",
        (
            "calibrate first_bag second_bag --survey tape.yaml --no-truth --std 0.1 --trusted 0 6 "
            "--out calibrated/"
        ),
        "calibrate flight.log --survey anchors.yaml --holdout other.log --out calibrated/",
        "calibrate flight_bag --quick",
        "calibrate flight_bag --no-truth --quick",
        "calibrate first_bag second_bag --stream --survey tape.yaml --std 0.1 --out calibrated/",
        "calibrate flights/ --survey anchors.yaml --without height --keep --out calibrated/",
        (
            "calibrate today_bag --no-truth --survey calibrated/anchors.yaml --effects "
            "calibrated/effects.yaml --out today/"
        ),
        options=[
            *options.recordings(),
            *options.filtering(
                "effects.yaml: effects in the model already; without ground truth its covariance is "
                "the prior"
            ),
            options.PARAMETERS,
            options.HOLDOUT,
            option(
                "--no-truth",
                action="store_true",
                help="do without ground truth, and leave it unread",
            ),
            *options.TAPE,
            option(
                "--quick",
                action="store_true",
                help="say within a minute what to expect of a calibration, and of more flights",
            ),
            option(
                "--stream",
                action="store_true",
                help="take the flights as one stream, in pieces; ground truth is not read",
            ),
            option(
                "--keep", action="store_true", help="use flights in which check finds an error, too"
            ),
            options.out(required=False),
            options.JOBS,
        ],
    )


def _calibrate(args: Namespace) -> int:
    from uwb_tdoa_bias.effects import EffectSet

    from ..calibrating import forecast, prospect, usable_paths, with_truth, without_truth
    from ..diagnosis.noise import has_imu
    from ..estimate import FlightEstimator
    from ..surveying.stream import StreamCalibration

    if not (args.out or args.quick):
        raise InputError("--out: is missing; say where to write, or ask for --quick.")
    if args.stream:
        options.refuse(args, ("holdout", "quick"), "--stream judges each piece by the next one")
    config, effects = options.filter_of(args)
    base, tape = effects or EffectSet(), options.tape_of(args, effects)
    reading = options.reading_of(args, truth=not (args.no_truth or args.stream))
    found, held = reading.find(args.flights), reading.find(args.holdout)
    options.check_holdout(
        (path.resolve() for path, _ in found), (path.resolve() for path, _ in held)
    )
    estimator = FlightEstimator(config, base)
    paths, judges = usable_paths(
        reading, (found, held), estimator, tape.std, args.keep, args.effects
    )
    if not paths:
        return _stop("no flight is left to calibrate with")
    flights, holdout = (reading.flights(map(str, some)) for some in (paths, judges))
    known = [flight.truth is not None for flight in flights + holdout]
    if any(known) and not all(known):
        raise InputError(
            f"{(flights + holdout)[known.index(False)].name}: holds no ground truth, and "
            "others do; leave it out, or give --no-truth."
        )
    if all(known):
        because = "says how well anchors are known, and ground truth is there to tell"
        options.refuse(args, options.OF_TAPE, f"{because}; give --no-truth, too")
    if args.stream:
        return _stream(args, flights, StreamCalibration(flights[0].anchors, tape, base, config))
    if args.quick:
        with cli.Progress("calibrate") as progress:
            looking = partial(progress, "looking at a part of the flights")
            if all(known):
                sentences = forecast(flights, base, config, looking).sentences()
            else:
                sentences = prospect(flights, tape, base, config, looking).sentences()
        cli.show(*sentences)
        return 0
    if not holdout and len(flights) > 1:
        flights, holdout = flights[:-1], flights[-1:]
        judges = paths[-1:]
    *_, over = parallel.workers_for(args, len(flights))
    with cli.Progress("calibrate") as progress:
        if all(known):
            made = with_truth(flights, holdout, base, config, progress, over)
        else:
            made = without_truth(flights, holdout, tape, base, config, progress, over)
    cli.show(made.text, made.as_text())
    out = args.out  # only --quick does without
    out.mkdir(parents=True, exist_ok=True)
    cli.write_json(
        out / "calibration.json", {"flights": [flight.name for flight in flights], **made.as_dict()}
    )
    more = options.words_of_reading(args)
    if made.why_not is not None:
        cli.show(f"wrote calibration.json, the figures of this, to {out}")
        cli.show(
            *command_lines.lines_without_use(paths, args.survey, args.effects, all(known), more)
        )
        return _stop(made.why_not)
    files = made.save(out, config, has_imu([*flights, *holdout]))
    written = ", ".join(file.name for file in files)
    cli.show(f"wrote {written} and calibration.json to {out}")
    judging = command_lines.evaluate_line(judges or paths, *files, all(known), more)
    cli.show(f"judge it:   {judging}")
    cli.show("start the nodes with it:", *command_lines.node_lines(*files))
    return 0


def _stream(args: Namespace, flights: Sequence[Flight], calibration: StreamCalibration) -> int:
    """Calibrate from flights as from one stream, write what is in use, and return the exit code."""
    from ..calibrating import in_pieces
    from ..diagnosis.self_calibration.solve import same_anchors
    from ..surveying.stream import in_place

    same_anchors(flights)
    steps = []
    for flight in flights:
        for piece in in_pieces(flight):
            step = calibration.take(piece)
            cli.show(step.as_text(flight.start))
            steps.append(cli.as_json(vars(step)))
    out = args.out
    out.mkdir(parents=True, exist_ok=True)
    cli.write_json(out / "calibration.json", {"offered": calibration.number > 0, "steps": steps})
    if not calibration.number:
        return _stop("no piece has led to a calibration that the next one confirmed")
    anchors, effects = in_place(calibration.given, calibration.effects)
    anchors.to_yaml(out / "anchors.yaml")
    effects.to_yaml(out / "effects.yaml")
    cli.show(f"wrote anchors.yaml, effects.yaml and calibration.json to {out}")
    files = out / "anchors.yaml", out / "effects.yaml"
    cli.show("start the nodes with it:", *command_lines.node_lines(*files))
    return 0


def _stop(why: str) -> int:
    cli.say("calibrate", f"stopped, and nothing to use is written: {why}.")
    return 1


main = cli.executable(_calibrate, parser)
