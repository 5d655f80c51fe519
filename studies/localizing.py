# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""localizing: compare the verdicts of localize with ground truth, on unchanged recordings and on
recordings with mistakes.

A flight is within the stated error if its position error is below twice the stated standard
deviation for 95 % of the time. Time in which the tag was lost does not count.
"""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

from mistakes import MISTAKES
import numpy as np

from uwb_tdoa_tools import cli, options
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.localizing.localize import GOOD, assess
from uwb_tdoa_tools.scoring.metrics import position_errors

from . import table

NOTHING, ALIKE = "nothing", 0.95  # no mistake; share of the time


def add_options(add):
    """add : add_argument of a parser."""
    cli.add(SimpleNamespace(add_argument=add), options.recordings())
    add("--mistakes", action="store_true", help="with the mistakes of `study checking`, too")
    table.add_options(add)


def run(args):
    """Print a table: a row for recordings as they are, and one for those with mistakes."""
    reading = options.reading_of(args)
    judged = partial(judge, reading=reading, mistakes=args.mistakes)
    found = table.results(judged, reading.find(args.flights), args, unit="flight")
    rows = [row for several in found for row in several]
    within = "of these within what is stated"
    cli.show(table.head("recordings", "number", "good", within, "not good", within))
    for what, some in (
        ("as they are", [row for row in rows if row["mistake"] == NOTHING]),
        ("with a mistake", [row for row in rows if row["mistake"] != NOTHING]),
    ):
        if some:
            cli.show(table.line([what, len(some), *summary(some)]))
    for row in rows:
        if row["verdict"] == GOOD and not row["within"]:
            cli.show(
                f"{row['flight']}, {row['mistake']}: called good, off by {row['rmse']:.2f} m "
                f"at a stated {row['std']:.2f} m"
            )


def summary(rows):
    """Numbers of the table: recordings that are called good and are within, and the same of others."""
    sides = ([row for row in rows if (row["verdict"] == GOOD) is good] for good in (True, False))
    return [number for some in sides for number in (len(some), sum(row["within"] for row in some))]


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
