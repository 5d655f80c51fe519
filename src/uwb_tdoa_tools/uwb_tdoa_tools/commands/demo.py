"""Send a flight through both nodes over ROS topics, and compare the estimate with ground truth."""

from __future__ import annotations

from functools import partial
import sys
import time
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, options
from ..evaluating import lines_of_errors
from ..flying import demo
from ..outputs import OutputFolder

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.flight import Flight

    from ..scoring.metrics import Score

DESCRIPTION = """Take a flight, write it as a bag, replay the bag through bias_node and ekf_node over ROS topics, and
compare the estimate with ground truth.

Without --flight a simulated vehicle first takes off, flies and lands by nothing but the estimate (as in `fly`), among
anchors that have delays of 0.1 m (standard deviation). It and the nodes correct for them with an effects.yaml that holds
their true values, as a calibration would find them. A measured flight is corrected with what --effects and --model give,
and with nothing else: what helped other flights may harm it. "raw" is the same filter without any correction, run
without ROS. The exit code is 1 if the estimate diverged, or messages were lost or late.
"""


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "demo",
        DESCRIPTION,
        "demo",
        "demo --flight 0607/tdoa2-obs-log1 --survey anchor_0607.txt --rate 4",
        "demo --rerun out/flight.rrd",
        "demo --flight flight.bag --effects effects.yaml --out out/corrected",
    )
    add = made.add_argument
    add(
        "--flight",
        metavar="LOG",
        help="a recording: micro-SD log, UTIL CSV or bag (default: simulate one)",
    )
    options.add_reading(made)
    add(
        "--rate",
        metavar="R",
        type=float,
        default=1.0,
        help="replay R times as fast as flown (default 1)",
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
    return made


def _demo(args: Namespace) -> int:
    if not 0.0 < args.rate < float("inf"):
        raise InputError(f"--rate: {args.rate:g} is not a speed; give a number above 0.")
    if args.survey and not args.flight:
        raise InputError("--survey: needs --flight; a simulated flight has its own anchors.")
    rerun = options.rerun_of(args, 1, partial(cli.say, "demo"))
    started = time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.flight:
        chosen = demo.measured(args.flight, options.reading_of(args), args.effects, args.model)
    else:
        cli.show("flying     a simulated vehicle")
        chosen = demo.simulated(args.out, args.effects, args.model)
    flight = chosen.flight
    assert flight.truth is not None
    length = flight.truth.t[-1] - flight.truth.t[0]
    cli.show(
        f"flight     {flight.name}: {length:.1f} s, {len(flight.tdoa)} TDOAs, "
        f"{len(flight.anchors)} anchors"
    )
    if chosen.outcome:
        cli.show(f"flown      by the estimate: {chosen.outcome}")
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
    if rerun is not None:
        flown.show(rerun, flight, [chosen.outcome, _change_in_words(scores)])
        cli.show(f"rerun      {rerun}")
    cli.show(f"took {time.monotonic() - started:.0f} s")
    cli.show(
        "next       "
        + "\n           ".join(demo.next_steps(args.flight or args.out / "flight.bag", args.survey))
    )
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
    return not any(outcome[name] for name in ("lost", "late", "imu_late", "imu_lost"))


main = cli.executable(_demo, parser)

if __name__ == "__main__":
    sys.exit(main())
