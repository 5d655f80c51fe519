# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""diagnosis: the figures of docs/notebook/diagnosis.md.

Every part prints its figures, and writes all its cases to PART.json in the output folder.
"""

from functools import partial
import json
from pathlib import Path
import time

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_tools.cli import OutputFolder
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.references import Heights, Nothing
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.surveying.report import with_blocked

from .. import table
from . import bank, blind, hand_eye, measured, splits, unlisted


def add_options(add):
    """The options of the study."""
    add("part", choices=tuple(PARTS), help="what to run")
    add("--out", metavar="DIR", type=OutputFolder, required=True, help="where to write")
    add("--data", metavar="DIR", type=Path, help="the measured flights: flights/, util/, surveys/")
    table.add_options(add, draws=5, first=blind.DEVELOPED_ON)


def run(args):
    """Run a part, and write and print its figures."""
    if args.data is None and args.part in ON_DATA:
        raise InputError(f"--data: {args.part} needs it.")
    args.out.mkdir(parents=True, exist_ok=True)
    args.json = args.json or args.out / f"{args.part}.json"
    print(json.dumps(PARTS[args.part](args), indent=1, default=float))


def _bank(args, aided=False):
    cases = bank.cases(args.draws, aided)
    return bank.figures(list(table.results(partial(bank.diagnosed, aided=aided), cases, args)))


def _blind(args):
    """In measured flights if there are any, else in simulated flights, and in those without effects."""
    source = blind.Simulated() if args.data is None else blind.Measured(args.data, args.out)
    figures = blind.figures(_costly(args, partial(blind.run, source)))
    if args.data is None:
        clean = list(blind.false_alarms(args.draws, args.first))
        figures["false alarms"] = bank.share(bool(r["said"]) for r in clean)
    return figures


def _unlisted(args):
    cases = [(kind, seed) for kind in unlisted.KINDS for seed in table.seeds(args)]
    return unlisted.figures(list(table.results(unlisted.run, cases, args)))


def _arms(args):
    return hand_eye.figures(list(table.results(hand_eye.run, table.seeds(args), args)))


def _costly(args, function):
    """The results of the first seeds whose effect costs enough: those that are not None."""
    found, seed = [], args.first
    while len(found) < args.draws:
        more = range(seed, seed + args.draws - len(found))
        found += [one for one in table.results(function, more, args) if one is not None]
        seed = more.stop
    table.keep(args, found)
    return found


def _measured(args, names=tuple(measured.SPLITS), sensors=()):
    judge = partial(measured.run, args.data, out=args.out, sensors=sensors)
    return {r["split"]: r["summary"] for r in table.results(judge, names, args)}


def _rows(args):
    """The first table of docs/diagnosis.md, and flights that hear other pairs."""
    named = splits.ROWS | splits.OTHER_PAIRS
    results = table.results(partial(splits.judged, args.data), named.values(), args)
    return {name: splits.row(result) for name, result in zip(named, results)}


def _few(args):
    """Diagnoses of one flight and of two, by the number of flights and the day."""
    kinds = {}
    results = table.results(partial(splits.judged, args.data), splits.FEW.values(), args)
    for name, result in zip(splits.FEW, results):
        kinds.setdefault(name.partition(":")[0], []).append(result)
    return {kind: splits.figures(several) for kind, several in kinds.items()}


def _splits(args):
    drawn = partial(splits.run, args.data)
    return splits.figures(list(table.results(drawn, table.seeds(args), args)))


def _speed(args):
    """Seconds of one core: 120 s of one flight with its ground truth, and two flights of a minute
    with less.
    """
    effect = bank.effect_of("anchor_delay", True, 1)
    flight = effect.inject(bank.clean_flight(500, 126.0))
    two = [effect.inject(bank.clean_flight(seed, 60.0, aided=True)) for seed in (502, 503)]
    bare = [one.without(*SENSOR_NAMES) for one in two]
    calls = {
        "120 s of flight": lambda: diagnose([flight]),
        "survey, two of a minute": lambda: with_blocked(self_calibrate(bare, Tape()), bare),
        "diagnose --no-truth, two of a minute": lambda: diagnose(bare, reference=Nothing()),
        "diagnose --reference heights, two of a minute": lambda: diagnose(two, reference=Heights()),
    }
    short = bank.clean_flight(501, 40.0, aided=True)
    diagnose([short], reference=Heights())  # compiles
    self_calibrate([short.without(*SENSOR_NAMES)], Tape())
    figures = {}
    for name, call in calls.items():
        started = time.process_time()
        call()
        figures[name] = round(time.process_time() - started, 1)
    table.keep(args, figures)
    return figures


PARTS = {
    "bank": _bank,
    "sensors": partial(_bank, aided=True),
    "blind": _blind,
    "unlisted": _unlisted,
    "arms": _arms,
    "measured": _measured,
    "measured-sensors": partial(_measured, names=measured.AIDED, sensors=SENSOR_NAMES),
    "rows": _rows,
    "few": _few,
    "splits": _splits,
    "speed": _speed,
}
ON_DATA = {"measured", "measured-sensors", "rows", "few", "splits"}
