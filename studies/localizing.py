# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""localizing: compare the verdicts of localize with ground truth, on unchanged recordings and on
recordings with mistakes.

A flight is within the stated error if its position error is below twice the stated standard
deviation for 95 % of the time. Time in which the tag was lost does not count.
"""

from dataclasses import replace
from functools import partial
import json
from types import SimpleNamespace

from mistakes import MISTAKES
import numpy as np

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_tools import cli, options, parallel
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.localizing.localize import GOOD, assess
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.scoring.metrics import position_errors

NOTHING, ALIKE = "nothing", 0.95  # no mistake; share of the time


def add_options(add):
    """add : add_argument of a parser."""
    cli.add(SimpleNamespace(add_argument=add), options.recordings())
    add("--mistakes", action="store_true", help="with the mistakes of `study checking`, too")
    add("--json", metavar="FILE", type=OutputFile, help="write what was said of each")
    add("--jobs", type=int, metavar="N", help="flights at once")


def run(args):
    """Print a table: a row for recordings as they are, and one for those with mistakes."""
    reading, rows = options.reading_of(args), []
    for told in parallel.over(
        partial(judge, reading=reading, mistakes=args.mistakes),
        reading.find(args.flights),
        args.jobs,
    ):
        rows += told
        if args.json:
            write_text(args.json, json.dumps(rows, indent=1))
    print(
        (
            "| recordings | number | good | of these within what is stated | not good | of these "
            "within |\n|---|"
        )
        + 5 * "---:|"
    )
    for what, some in (
        ("as they are", [r for r in rows if r["mistake"] == NOTHING]),
        ("with a mistake", [r for r in rows if r["mistake"] != NOTHING]),
    ):
        if some:
            print(f"| {what} | {len(some)} | {summary(some)} |")
    for row in rows:
        if row["verdict"] == GOOD and not row["within"]:
            print(
                f"{row['flight']}, {row['mistake']}: called good, off by {row['rmse']:.2f} m "
                f"at a stated {row['std']:.2f} m"
            )


def summary(rows):
    """Cells of the table."""
    good, others = (
        [row for row in rows if (row["verdict"] == GOOD) is what] for what in (True, False)
    )
    return " | ".join(
        str(number)
        for some in (good, others)
        for number in (len(some), sum(row["within"] for row in some))
    )


def judge(recording, reading, mistakes=False):
    """[{"flight", "mistake", "verdict", "within", "rmse", "std"}] of a recording (path, survey); m."""
    flight, rows = reading.read(recording), []
    for name in (NOTHING, *(MISTAKES if mistakes else ())):
        changed = _with(flight, name)
        if changed is not None:
            rows.append({"flight": flight.name, "mistake": name, **_judged(changed)})
    return rows


def _with(flight, name):
    """The Flight with a mistake of that name; None where it cannot be made."""
    if name == NOTHING:
        return flight
    mistake = MISTAKES[name]
    if mistake.needs == "rooms" or (mistake.needs == "imu" and flight.imu is None):
        return None
    try:
        made = mistake.make(of_flight(flight), np.random.default_rng(1), None)
    except AttributeError:  # needs another recording, or a sensor that is not there
        return None
    return replace(flight, tdoa=made.tdoa, imu=made.imu, anchors=made.anchors)


def _judged(flight):
    """dict of the verdict on a Flight without its ground truth, and of its true errors."""
    run = FlightEstimator()(flight)
    told = assess(replace(flight, truth=None), run)
    t, error, _ = position_errors(run.odometry, flight.truth, flight.truth.t[0], flight.truth.t[-1])
    known = ~np.any(
        [(t >= begin) & (t <= end) for begin, end in told.lost] or [np.zeros(len(t), bool)], axis=0
    )
    off = np.linalg.norm(error[known], axis=1)
    if not len(off):
        return {"verdict": told.level, "within": False, "rmse": None, "std": None}
    within = bool(np.mean(off <= told.figures["within"]) >= ALIKE)
    return {
        "verdict": told.level,
        "within": within,
        "rmse": float(np.sqrt(np.mean(off**2))),
        "std": told.figures["std"],
    }
