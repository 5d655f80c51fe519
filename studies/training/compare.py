# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""compare-models: train bias models on some flights, and compare the filter with each model and
without any on other flights.

Prints the 3D RMSE, in metres. With --bound, it adds the filter with the true errors, smoothed: a
bound for any model of the pose. With --simulated N, both sets of flights are simulated: N flights
in each of three constellations to train, and of three other constellations to test. Writes to
--out: table.md, comparison.json, histograms.png, rmse.png, and each model in a separate folder.
"""

from functools import partial
import json

from tqdm import tqdm

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_tools import choices
from uwb_tdoa_tools.outputs import OutputFolder
from uwb_tdoa_tools.readers import inputs

from . import simulated
from .comparison import compare
from .table import markdown


def add_options(add):
    """The options of the study."""
    add("--train", nargs="+", metavar="FLIGHT", help=choices.RECORDINGS)
    add(
        "--test",
        nargs="+",
        action="append",
        default=[],
        metavar="GROUP FLIGHT",
        help="a name for a group of flights, and the flights; may be repeated",
    )
    add("--simulated", type=int, metavar="N", help="simulate the flights, N in each constellation")
    add("--survey", metavar="S", help=choices.SURVEY)
    add(
        "--models",
        nargs="+",
        choices=choices.MODELS,
        default=list(choices.MODELS),
        help="(default: all)",
    )
    add(
        "--validation",
        metavar="NAME",
        nargs="+",
        help="flights to validate on (default: one in five)",
    )
    add(
        "--bound",
        action="store_true",
        help="with bounds, and how alike flights are, place by place",
    )
    add("--out", metavar="DIR", type=OutputFolder, required=True, help="where to write")
    add("--seed", metavar="N", type=int, default=0, help="of everything random (default: 0)")


def run(args):
    """Compare as the options say, write, and print the table."""
    train, tests = _simulated(args) if args.simulated is not None else _measured(args)
    report = compare(train, tests, args.models, args.out, args.seed, args.validation, args.bound)
    table = markdown(report)
    print(table)
    write_text(args.out / "table.md", table)
    write_text(args.out / "comparison.json", json.dumps(report, indent=1) + "\n")


def _simulated(args):
    """(flights to train on, {constellation: flights})."""
    if args.train or args.test or args.simulated < 1:
        raise InputError("--simulated: needs a number above 0, and neither --train nor --test.")
    bar = partial(tqdm, desc="simulating", unit="flight", disable=None, leave=False)
    first = 1000 * args.seed
    train = simulated.flights(simulated.TRAINING, args.simulated, first + 100, bar)
    return sum(train.values(), []), simulated.flights(
        simulated.UNSEEN, args.simulated, first + 500, bar
    )


def _measured(args):
    """(flights to train on, {group: flights})."""
    if not (args.train and args.test):
        raise InputError("--train, --test: both are needed, or --simulated N.")
    tests = {}
    for name, *paths in args.test:
        if not paths:
            raise InputError(f"--test: {name} names no flight; write --test NAME FLIGHT...")
        tests[name] = _read(paths, args.survey)
    train = _read(args.train, args.survey)
    both = {flight.name for flight in train} & {
        flight.name for group in tests.values() for flight in group
    }
    if both:
        raise InputError(
            f"--test: {sorted(both)[0]} is among the flights to train on; test on others."
        )
    return train, tests


def _read(paths, survey):
    """Flights without height, pressure and velocity: models are of TDOAs alone."""
    return [flight.without(*SENSOR_NAMES) for flight in inputs.Reading(survey).flights(paths)]
