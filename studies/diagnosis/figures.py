# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""diagnosis: the figures of docs/notebook/diagnosis.md.

Every part prints its figures and writes them, with all cases, to PART.json in the output folder.
The parts bank, blind and injected also draw a confusion matrix: the effect put in against the first
effect found.
"""

from functools import partial
import importlib.util
import json
from pathlib import Path
import time

import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_filled, write_text
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.references import Heights, Nothing
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.outputs import OutputFolder
from uwb_tdoa_tools.parallel import over, whole_number
from uwb_tdoa_tools.surveying.report import with_blocked

from . import bank, blind, faults, floor, measured, processes, referenced, splits, undeclared

PARTS = (
    "bank",
    "sensors",
    "no-truth",
    "undeclared",
    "blind",
    "processes",
    "several",
    "faults",
    "injected",
    "measured",
    "measured-sensors",
    "floor",
    "references",
    "rows",
    "few",
    "splits",
    "speed",
)
# flights with the same effect: no measured group of one protocol has more
SEVERAL_MEASURED, SEVERAL_SIMULATED = (3, 4)


def add_options(add):
    """The options of the study."""
    add("part", choices=PARTS, help="what to run")
    add("--out", metavar="DIR", type=OutputFolder, required=True, help="where to write")
    add(
        "--seeds",
        metavar="N",
        type=int,
        default=5,
        help=(
            "flights for each effect and size, cases of blind, processes, several and splits, or "
            "costly draws of each of the faults (default: 5)"
        ),
    )
    add(
        "--first",
        metavar="SEED",
        type=int,
        default=blind.DEVELOPED_ON,
        help=(
            "first seed of blind, processes, several, splits, faults and no-truth "
            "(default: %(default)s)"
        ),
    )
    add("--data", metavar="DIR", type=Path, help="the measured flights: flights/, util/, surveys/")
    add(
        "--jobs",
        metavar="N",
        type=whole_number,
        default=1,
        help="cases of blind, processes, several, rows, few and splits at once (default: %(default)s)",
    )
    add(
        "--cases",
        metavar="FILE.py",
        type=Path,
        help="effects that exist nowhere else, for undeclared",
    )


def run(args):
    """Run a part, and write and print its figures."""
    args.out.mkdir(parents=True, exist_ok=True)
    on_data = dict.fromkeys(
        (
            "faults",
            "injected",
            "measured",
            "measured-sensors",
            "floor",
            "references",
            "rows",
            "few",
            "splits",
        ),
        ("data",),
    )
    for option in {"undeclared": ("cases",), **on_data}.get(args.part, ()):
        if getattr(args, option) is None:
            raise InputError(f"--{option}: {args.part} needs it.")
    started = time.monotonic()
    result = {
        "bank": _bank,
        "sensors": _sensors,
        "no-truth": _no_truth,
        "undeclared": _undeclared,
        "blind": _blind,
        "processes": _processes,
        "several": _several,
        "faults": _faults,
        "injected": _injected,
        "measured": _measured,
        "measured-sensors": _measured_sensors,
        "floor": _floor,
        "references": _references,
        "rows": _rows,
        "few": _few,
        "splits": _splits,
        "speed": _speed,
    }[args.part](args)
    result["seconds"] = round(time.monotonic() - started, 1)
    write_text(args.out / f"{args.part}.json", json.dumps(result, indent=1, default=float))
    print(json.dumps(result["figures"], indent=1, default=float))


def _each(cases, function):
    out = []
    for case in tqdm(cases, unit="case", disable=None):
        out.append(function(*case))
    return out


def _bank(args):
    results = _each(
        bank.cases(args.seeds),
        lambda kind, effects, seed: {"kind": kind, **bank.diagnose_case(effects, seed)},
    )
    _confusion(results, args.out / "confusion.png")
    return {"figures": bank.figures(results), "cases": results}


def _sensors(args):
    results = _each(
        bank.cases(args.seeds, aided=True),
        lambda kind, effects, seed: {"kind": kind, **bank.diagnose_case(effects, seed, aided=True)},
    )
    return {"figures": bank.figures(results), "cases": results}


def _no_truth(args):
    cases = [
        case for case in bank.cases(min(args.seeds, 2), first=args.first) if case[0] == "large"
    ]
    cases += [case for case in bank.cases(args.seeds, first=args.first) if case[0] == "clean"]
    results = _each(
        cases, lambda kind, effects, seed: {"kind": kind, **bank.case_without_truth(effects, seed)}
    )
    return {"figures": bank.figures_without_truth(results), "cases": results}


def _undeclared(args):
    spec = importlib.util.spec_from_file_location("undeclared_cases", args.cases)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    results = _each(
        [
            (name, case, seed)
            for name, case in module.CASES.items()
            for seed in range(400, 400 + args.seeds)
        ],
        undeclared.run,
    )
    return {"figures": undeclared.figures(results), "cases": results}


def _blind(args):
    """In measured flights if there are any, else in simulated ones and in those with nothing."""
    results = _drawn(args, partial(blind.run, _source(args)))
    figures = blind.figures(results)
    if args.data is None:
        clean = list(blind.false_alarms(args.seeds, args.first))
        figures["false alarms"] = bank.share(bool(r["said"]) for r in clean)
    _confusions(results, args.out / "blind.png")
    return {"figures": figures, "cases": results}


def _processes(args):
    """As blind, of two flights, with the effects of the second generator, which have no shape that a
    word names.
    """
    results = _drawn(args, partial(blind.run, _source(args), draw=processes.draw, count=2))
    figures = blind.figures(results)
    del figures["shape right"]
    kinds = {r["shape"] for r in results}
    figures["first, by kind"] = {
        kind: bank.share(r["place"] == 0 for r in results if r["shape"] == kind)
        for kind in sorted(kinds)
    }
    return {"figures": figures, "cases": results}


def _several(args):
    """One, two and, where there are enough, three of the flights with the same effect, judged on
    one more.
    """
    number = SEVERAL_SIMULATED if args.data is None else SEVERAL_MEASURED
    results = _drawn(args, partial(blind.several, _source(args), number))
    figures = {
        f"flights diagnosed: {k + 1}": blind.figures([case[k] for case in results])
        for k in range(number - 1)
    }
    return {"figures": figures, "cases": results}


def _source(args):
    return blind.Simulated() if args.data is None else blind.Measured(args.data, args.out)


def _drawn(args, function):
    """What a function of a seed returns, of the first seeds for which that is not None."""
    results, seed = [], args.first
    while len(results) < args.seeds:
        seeds = range(seed, seed + args.seeds - len(results))
        made = over(function, seeds, args.jobs, unit="case")
        results += [result for result in made if result is not None]
        seed = seeds.stop
    return results


def _faults(args):
    results = list(tqdm(faults.cases(args.data, args.seeds, args.first), unit="draw", disable=None))
    named = {"named in the flights as they are": faults.as_they_are(args.data)}
    return {"figures": {**faults.figures(results), **named}, "cases": results}


def _injected(args):
    results = measured.injected(args.data, lambda cases, function: _each(cases, function))
    _confusion(results, args.out / "injected.png")
    figures = {
        "cases": len(results),
        "found on top": bank.share(r["hit"] for r in results),
        "found, or named as an alternative": bank.share(
            r["hit"] or r["put_in"][0] in r["ambiguous"] for r in results
        ),
        "found, or named at all": bank.share(
            r["hit"] or r["put_in"][0] in r["ambiguous"] + r["imitators"] for r in results
        ),
        "effects named at all, mean": float(
            np.mean([len({*r["found"], *r["ambiguous"], *r["imitators"]}) for r in results])
        ),
    }
    return {"figures": figures, "cases": results}


def _measured(args):
    results = _each(
        [(name,) for name in measured.SPLITS], lambda name: measured.run(args.data, name, args.out)
    )
    return {"figures": {r["split"]: r["summary"] for r in results}, "cases": results}


def _measured_sensors(args):
    results = _each(
        [(name,) for name in measured.AIDED],
        lambda name: measured.run(args.data, name, args.out, SENSOR_NAMES),
    )
    return {"figures": {r["split"]: r["summary"] for r in results}, "cases": results}


def _floor(args):
    return {"figures": floor.figures(args.data), "cases": []}


def _references(args):
    results = _each(referenced.cases(), lambda *case: referenced.run(args.data, *case))
    return {"figures": referenced.figures(results), "cases": results}


def _rows(args):
    """The first table of docs/diagnosis.md, and flights that hear other pairs."""
    results = _judged(args, {**splits.ROWS, **splits.OTHER_PAIRS})
    figures = {name: splits.row(result) for name, result in results.items()}
    return {"figures": figures, "cases": results}


def _few(args):
    """Diagnoses of one flight and of two, by the number of flights and the day."""
    results = _judged(args, splits.FEW)
    kinds = {name.partition(":")[0]: [] for name in results}
    for name, result in results.items():
        kinds[name.partition(":")[0]].append(result)
    figures = {kind: splits.figures(several) for kind, several in kinds.items()}
    return {"figures": figures, "cases": results}


def _judged(args, tables):
    """{name: result of `splits.judged`} of splits."""
    made = over(partial(splits.judged, args.data), tables.values(), args.jobs, unit="row")
    return dict(zip(tables, made))


def _splits(args):
    results = _drawn(args, partial(splits.run, args.data))
    return {"figures": splits.figures(results), "cases": results}


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
    # compiles
    (diagnose([short], reference=Heights()), self_calibrate([short.without(*SENSOR_NAMES)], Tape()))
    figures = {}
    for name, call in calls.items():
        started = time.process_time()
        call()
        figures[name] = round(time.process_time() - started, 1)
    return {"figures": figures, "cases": []}


def _confusions(results, path):
    """Draw confusion matrices of the effect put in and the first claim.

    There is one each for stream, subset, covariate and shape.
    """
    figure, axes = plt.subplots(2, 2, figsize=(14, 13), layout="constrained")
    for k, (ax, key) in enumerate(zip(axes.ravel(), ("stream", "subset", "covariate", "shape"))):
        pairs = [
            (r[key], (r["first"][k] or "none said") if r["first"] else "nothing") for r in results
        ]
        rows, columns = (sorted({pair[side] for pair in pairs}) for side in range(2))
        count = np.zeros((len(rows), len(columns)))
        for one, other in pairs:
            count[rows.index(one), columns.index(other)] += 1
        _matrix(ax, count, rows, columns)
        ax.set_title(key)
    write_filled(path, partial(figure.savefig, dpi=80))
    plt.close(figure)


def _matrix(ax, count, rows, columns):
    """Counts, coloured by their share of the row."""
    share = count / np.maximum(count.sum(axis=1, keepdims=True), 1)
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for row, column in zip(*np.nonzero(count)):
        colour = "w" if share[row, column] > 0.5 else "k"
        ax.text(column, row, int(count[row, column]), ha="center", va="center", color=colour)
    ax.set(
        xticks=range(len(columns)), yticks=range(len(rows)), xlabel="found first", ylabel="put in"
    )
    ax.set_xticklabels(columns, rotation=90)
    ax.set_yticklabels(rows)


def _confusion(results, path):
    """Draw a confusion matrix of small and large effects.

    Rows: effect put in; columns: first effect found.
    """
    names = [name for name in bank.SIZES if name not in (*bank.AIDED, *bank.RANGED)]
    columns = [*names, "something without a name", "nothing"]
    count = np.zeros((len(names) + 1, len(columns)))
    for r in results:
        if r["kind"] == "pair":
            continue
        row = names.index(r["put_in"][0]) if r["put_in"] else len(names)
        first = (r["found"] or ["nothing"])[0]
        count[row, columns.index(first) if first in columns else len(names)] += 1
    figure, ax = plt.subplots(figsize=(11, 10), layout="constrained")
    _matrix(ax, count, [*names, "nothing"], columns)
    write_filled(path, partial(figure.savefig, dpi=80))
    plt.close(figure)
