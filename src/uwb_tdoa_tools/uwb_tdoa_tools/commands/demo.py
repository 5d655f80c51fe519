# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Trace a hidden effect and fly with its correction, or send a measured flight through both nodes."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from functools import partial
import textwrap
import time

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, options, parallel
from ..cli import OutputFile, OutputFolder, option, positive

DESCRIPTION = """Find a systematic error of the measurements, write its correction, and fly with it.

A simulated hall has an effect that no file declares; --seed draws its kind and size. Three flights are recorded, with
the true path of the simulation as a motion capture system gives it. `diagnose` traces the residuals of the first two.
What it adds is written as bias.onnx. The third flight goes through bias_node and ekf_node over ROS topics, without
bias.onnx and with it. At the end the demo says what was really in the simulation.

With --flight a measured flight goes through both nodes. It is corrected with what --effects and --model give, and with
nothing else: what helped other flights may harm it. "raw" is the same filter without any correction, run without ROS.
The exit code is 1 if the estimate diverged, or messages were lost or late. Then no error is printed.
"""
WIDTH, INDENT = 120, 11  # characters of a line, and before its text
SEED, RATES = 1, {"simulated": 20.0, "measured": 1.0}  # times as fast as flown


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "demo",
        DESCRIPTION,
        "demo",
        "demo --seed 7 --json demo.json",
        "demo --flight 0607/tdoa2-obs-log1 --survey anchor_0607.txt --rate 4",
        "demo --flight flight_bag --effects effects.yaml --out out/corrected",
        options=[
            option(
                "--flight",
                metavar="LOG",
                help="a recording: micro-SD log, UTIL CSV or bag (default: simulate three)",
            ),
            option(
                "--seed",
                metavar="N",
                type=parallel.whole_number,
                help=f"of the simulated hall and its hidden effect (default {SEED})",
            ),
            *options.READING,
            option(
                "--rate",
                metavar="R",
                type=positive,
                help=(
                    "replay R times as fast as flown (default 1; 20 of a simulated flight, or as fast as "
                    "this machine can)"
                ),
            ),
            option(
                "--out",
                metavar="DIR",
                type=OutputFolder,
                default="out/demo",
                help="for all files (default out/demo)",
            ),
            option("--effects", metavar="FILE", help="effects.yaml to correct with"),
            options.MODEL,
            option(
                "--json",
                metavar="FILE",
                type=OutputFile,
                help="write all figures of the simulated hall",
            ),
        ],
    )


def _demo(args: Namespace) -> int:
    if args.rate is None:
        args.rate = RATES["measured" if args.flight else "simulated"]
    if args.survey and not args.flight:
        raise InputError("--survey: needs --flight; a simulated flight has its own anchors.")
    if args.flight:
        options.refuse(args, ("seed", "json"), "belongs to the simulated hall")
    else:
        options.refuse(args, ("effects", "model"), "needs --flight: the demo writes its own")
    args.out.mkdir(parents=True, exist_ok=True)
    return _measured(args) if args.flight else _loop(args)


def _loop(args: Namespace) -> int:
    """Close the loop in a simulated hall."""
    from ..flying import demo

    result, figures = demo.close_loop(
        args.seed or SEED, args.out, args.rate, _show, partial(cli.say, "demo")
    )
    cli.write_json(args.json, figures)
    _show("next", demo.next_steps(args.out / "flight-3_bag"), keep=True)
    return int(result.failed)


def _show(title: str, lines: Sequence[str], keep: bool = False) -> None:
    """Print lines with a title before the first; `keep` those that are to be copied as they are."""
    for number, line in enumerate(lines):
        begin = f"{'' if number else title:{INDENT}s}"
        width = len(line) + INDENT if keep else WIDTH
        cli.show(textwrap.fill(line, width, initial_indent=begin, subsequent_indent=" " * INDENT))


def _measured(args: Namespace) -> int:
    """Take a measured flight through both nodes."""
    from ..evaluating import lines_of_errors
    from ..flying import demo
    from ..scoring.evaluation import require_truth
    from ..scoring.pairs import residuals_of

    started = time.monotonic()
    flight = options.reading_of(args).one(args.flight)
    require_truth(flight)
    correction = demo.corrector_of(flight, args.effects, args.model)
    length = flight.known_truth.t[-1] - flight.known_truth.t[0]
    cli.show(
        f"flight     {flight.name}: {length:.1f} s, {len(flight.tdoa)} TDOAs, "
        f"{len(flight.anchors)} anchors"
    )
    cli.show(f"correction {demo.correction_in_words(correction, args.effects, args.model)}")
    files = {"effects_file": args.effects, "model_file": args.model}
    live, scores = demo.fly(
        flight,
        correction,
        files,
        args.out,
        args.rate,
        lambda text: cli.show(f"nodes      {text}"),
    )
    _show("nodes", demo.arrivals_in_words(flight, live.outcome))
    if live.missing:
        _show("error", [demo.too_slow_in_words(live.missing, args.rate)])
        return 1
    cli.show(*lines_of_errors(scores), demo.change_of_scores(scores))
    residuals = [residuals_of(flight, by) for by in (None, correction)[: len(scores) - 1]]
    demo.draw(args.out / "error.png", flight, residuals, scores[:-1])
    cli.show(f"plot       {args.out / 'error.png'}")
    cli.show(f"took {time.monotonic() - started:.0f} s")
    _show("next", demo.next_steps(args.flight, args.survey), keep=True)
    return int(scores[-2].row()["diverged"])  # of the nodes


main = cli.executable(_demo, parser)
