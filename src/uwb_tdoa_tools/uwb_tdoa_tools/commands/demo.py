"""Trace a hidden effect and fly with its correction, or send a measured flight through both nodes."""

from __future__ import annotations

from functools import partial
import sys
import textwrap
import time
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, options, parallel
from ..diagnosis import diagnose
from ..evaluating import lines_of_errors
from ..flying import demo, loop
from ..outputs import OutputFile, OutputFolder
from ..parallel import Progress

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.flight import Flight

    from ..scoring.metrics import Score

DESCRIPTION = """Find a systematic error of the measurements, write its correction, and fly with it.

A simulated hall has an effect that no file declares; --seed draws its kind and size. Three flights are recorded, with
the true path of the simulation as a motion capture system gives it. `diagnose` traces the residuals of the first two.
What it adds is written as bias.onnx. The third flight goes through bias_node and ekf_node over ROS topics, without
bias.onnx and with it. At the end the demo says what was really in the simulation.

With --flight a measured flight goes through both nodes. It is corrected with what --effects and --model give, and with
nothing else: what helped other flights may harm it. "raw" is the same filter without any correction, run without ROS.
The exit code is 1 if the estimate diverged, or messages were lost or late.
"""
WIDTH = 120  # characters of a line
SEED, RATES = 1, {"simulated": 20.0, "measured": 1.0}  # times as fast as flown


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "demo",
        DESCRIPTION,
        "demo",
        "demo --seed 7 --json demo.json",
        "demo --flight 0607/tdoa2-obs-log1 --survey anchor_0607.txt --rate 4",
        "demo --flight flight.bag --rerun out/flight.rrd",
        "demo --flight flight.bag --effects effects.yaml --out out/corrected",
    )
    add = made.add_argument
    add(
        "--flight",
        metavar="LOG",
        help="a recording: micro-SD log, UTIL CSV or bag (default: simulate three)",
    )
    add(
        "--seed",
        metavar="N",
        type=parallel.whole_number,
        help=f"of the simulated hall and its hidden effect (default {SEED})",
    )
    options.add_reading(made)
    add(
        "--rate",
        metavar="R",
        type=float,
        help="replay R times as fast as flown (default 1; 20 of a simulated flight, or as fast as "
        "this machine can)",
    )
    add(
        "--out",
        metavar="DIR",
        type=OutputFolder,
        default="out/demo",
        help="for all files (default out/demo)",
    )
    add("--effects", metavar="FILE", help="effects.yaml to correct with")
    options.add_model(made)
    options.add_rerun(made)
    add("--json", metavar="FILE", type=OutputFile, help="write all figures of the simulated hall")
    return made


def _demo(args: Namespace) -> int:
    if args.rate is None:
        args.rate = RATES["measured" if args.flight else "simulated"]
    if not 0.0 < args.rate < float("inf"):
        raise InputError(f"--rate: {args.rate:g} is not a speed; give a number above 0.")
    if args.survey and not args.flight:
        raise InputError("--survey: needs --flight; a simulated flight has its own anchors.")
    if args.flight:
        options.refuse(args, ("seed", "json"), "belongs to the simulated hall")
    else:
        options.refuse(args, ("effects", "model"), "needs --flight: the demo writes its own")
    args.rerun = options.rerun_of(args, 1, partial(cli.say, "demo"))
    args.out.mkdir(parents=True, exist_ok=True)
    return _measured(args) if args.flight else _loop(args)


def _loop(args: Namespace) -> int:
    """Close the loop in a simulated hall."""
    seed, clock = args.seed or SEED, demo.Stopwatch()
    onnx, picture = args.out / "bias.onnx", args.out / "demo.png"
    with Progress("demo") as progress:
        progress("flying")
        bags = loop.record(seed, args.out)
        flights = loop.read(bags[:2])
        _several("recorded", [loop.recordings_in_words(flights, seed)])
        _several("residual", loop.residuals_of(flights[0]).sentences())
        clock.lap("flying")
        diagnosis = diagnose(flights, progress=progress)
        _several("traced to", loop.found_in_words(diagnosis))
        clock.lap("tracing")
        correction = loop.write_correction(onnx, diagnosis)
        _several("added", loop.added_in_words(onnx, correction, diagnosis))
        clock.lap("writing")
    say = partial(cli.say, "demo")
    result = demo.fly_both(bags[2], onnx if correction else None, args.rate, say)
    clock.lap("both nodes, twice" if correction else "both nodes")
    _several("flown", [result.arrived_in_words()])
    _several("error", [result.error_in_words()])
    from ..flying.demo_picture import draw  # takes a second to import

    draw(result, picture)
    clock.lap("picture")
    _several("really", [loop.truth_in_words(seed, result.flight)])
    cli.show(f"picture    {picture}")
    cli.show(f"took       {clock.in_words()}")
    if args.rerun is not None:
        result.show(args.rerun)
        cli.show(f"rerun      {args.rerun}")
    if args.json is not None:
        cli.write_json(args.json, result.figures(seed, diagnosis, clock))
    cli.show("next       " + "\n           ".join(demo.next_steps(bags[2])))
    return int(result.failed)


def _several(title: str, lines: Sequence[str]) -> None:
    """Print sentences with a title before the first."""
    for number, line in enumerate(lines):
        begin = f"{'' if number else title:11s}"
        cli.show(textwrap.fill(line, WIDTH, initial_indent=begin, subsequent_indent=" " * 11))


def _measured(args: Namespace) -> int:
    """Take a measured flight through both nodes."""
    started = time.monotonic()
    chosen = demo.measured(args.flight, options.reading_of(args), args.effects, args.model)
    flight = chosen.flight
    assert flight.truth is not None
    length = flight.truth.t[-1] - flight.truth.t[0]
    cli.show(
        f"flight     {flight.name}: {length:.1f} s, {len(flight.tdoa)} TDOAs, "
        f"{len(flight.anchors)} anchors"
    )
    cli.show(f"correction {chosen.correction()}")
    flown = demo.fly(chosen, args.out, args.rate, lambda text: cli.show(f"nodes      {text}"))
    scores, in_time = flown.scores, _all_in_time(flight, flown.outcome)
    if not in_time:
        cli.say("demo", f"messages lost or late: too much load for --rate {args.rate:g}; try less.")
    cli.show(*lines_of_errors(scores))
    cli.show(_change_in_words(scores))
    from ..scoring.plots import plot_comparison  # takes a second to import

    plot_comparison(flight, scores[:-1], args.out / "error.png")
    cli.show(f"plot       {args.out / 'error.png'}")
    if args.rerun is not None:
        flown.show(args.rerun, flight, [_change_in_words(scores)])
        cli.show(f"rerun      {args.rerun}")
    cli.show(f"took {time.monotonic() - started:.0f} s")
    cli.show("next       " + "\n           ".join(demo.next_steps(args.flight, args.survey)))
    return int(scores[-2].row()["diverged"] or not in_time)  # of the nodes


def _change_in_words(scores: Sequence[Score]) -> str:
    """State in words how correction changes the error."""
    before, after = (score.row()["rmse_3d"] for score in scores[:2])
    if len(scores) == 2:
        return (
            f"3D RMSE {before:.3f} m, with nothing corrected: diagnose finds what is wrong with "
            "this flight, and what that is worth on others"
        )
    change = (
        f"3D RMSE raw {before:.3f} m, corrected {after:.3f} m: "
        f"{round(100.0 * (after - before) / before):+d} %"
    )
    worse = (
        "; this correction does not fit this flight: other anchors, another day, another IMU. Do "
        "not fly with it; diagnose finds one that fits"
    )
    return change + (worse if after > before else "")


def _all_in_time(flight: Flight, outcome: dict[str, int]) -> bool:
    """Print what became of every message. Returns whether all were there in time."""
    counts = ", ".join(
        f"{count} {name}" for name, count in outcome.items() if not name.startswith("imu_")
    )
    cli.show(f"nodes      TDOAs {len(flight.tdoa)}: {counts}")
    samples = 0 if flight.imu is None else len(flight.imu)
    cli.show(
        f"nodes      IMU samples {samples}: {outcome['imu_late']} late, {outcome['imu_lost']} lost"
    )
    return not any(outcome[name] for name in demo.MISSING)


main = cli.executable(_demo, parser)

if __name__ == "__main__":
    sys.exit(main())
