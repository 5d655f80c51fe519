"""compare_models: train every kind of bias model on the same flights, and one table of what they reach on others."""

from functools import partial
import json
from pathlib import Path
import sys

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.correction.network import Network

from .. import cli
from ..readers import inputs
from ..scoring.evaluation import evaluate
from ..scoring.metrics import pooled
from ..training import labels as labelling, models, physics, simulated
from ..studies.training import study
from ..training.plots import plot_bars, plot_histograms

BOUNDS = {"oracle 0.5 s": 0.5, "oracle 1 s": 1.0, "oracle 2 s": 2.0}


def main(argv=None):
    """The executable. Returns the exit code."""
    parser = cli.parser(
        "compare_models",
        "Train bias models on some flights, run the filter with each of them, and with none, on others, and print\n"
        "the 3D RMSE, in metres. With --bound beside them: the filter with the true errors, smoothed, a bound for\n"
        "any model of the pose. With --simulated N both are simulated: N flights in each of three constellations,\n"
        "and of three others.\n"
        "Writes to --out: table.md, comparison.json, histograms.png, rmse.png, and each model in a folder of its own.",
        "compare_models --train DATA/0425 --test 'another day' DATA/0426 --survey DATA/surveys --out out/",
        "compare_models --simulated 20 --out out/",
        "compare_models --train a b c --test same d e --test other f --survey s.txt --models structured --out out/",
    )
    parser.add_argument("--train", nargs="+", metavar="FLIGHT", help=inputs.HELP)
    parser.add_argument(
        "--test", nargs="+", action="append", default=[], metavar="GROUP FLIGHT",
        help="a name for a group of flights, and the flights; may be repeated",
    )  # fmt: skip
    parser.add_argument("--simulated", type=int, metavar="N", help="simulate the flights, N in each constellation")
    parser.add_argument("--survey", metavar="S", help=inputs.SURVEY_HELP)
    parser.add_argument("--models", nargs="+", choices=models.KINDS, default=list(models.KINDS), help="(default: all)")
    parser.add_argument("--validation", metavar="NAME", nargs="+", help="flights to validate on (default: one in five)")
    parser.add_argument("--bound", action="store_true", help="with bounds, and how alike flights are, place by place")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="where to write")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of everything random (default: 0)")
    return cli.run(_compare, parser, argv)


def _compare(args):
    train, tests = _simulated(args) if args.simulated is not None else _measured(args)
    report = compare(train, tests, args.models, args.out, args.seed, args.validation, args.bound)
    table = markdown(report)
    print(table)
    (args.out / "table.md").write_text(table)
    (args.out / "comparison.json").write_text(json.dumps(report, indent=1) + "\n")
    return 0


def _simulated(args):
    """(flights to train on, {constellation: flights})."""
    if args.train or args.test or args.simulated < 1:
        raise InputError("--simulated: needs a number above 0, and neither --train nor --test.")
    bar = partial(tqdm, desc="simulating", unit="flight", disable=None, leave=False)
    first = 1000 * args.seed
    train = simulated.flights(simulated.TRAINING, args.simulated, first + 100, bar)
    return sum(train.values(), []), simulated.flights(simulated.UNSEEN, args.simulated, first + 500, bar)


def _measured(args):
    """(flights to train on, {group: flights})."""
    if not (args.train and args.test):
        raise InputError("--train, --test: both are needed, or --simulated N.")
    tests = {}
    for name, *paths in args.test:
        if not paths:
            raise InputError(f"--test: {name} names no flight; write --test NAME FLIGHT...")
        tests[name] = inputs.read_flights(paths, args.survey)
    train = inputs.read_flights(args.train, args.survey)
    both = {flight.name for flight in train} & {flight.name for group in tests.values() for flight in group}
    if both:
        raise InputError(f"--test: {sorted(both)[0]} is among the flights to train on; test on others.")
    return train, tests


def compare(train, tests, kinds, out, seed=0, validation=None, bound=False):
    """Train, run, and draw. Returns a dict of plain values.

    train : list of Flight; tests : {group: list of Flight}; kinds : of models.KINDS; out : folder, Path; validation :
    names or None; bound : with oracles and repeatability. Raises InputError.
    """
    known = {flight.name: flight for flight in train}
    names, held = labelling.split(list(known), seed, validation)
    correctors, skipped = {"none": (None, None)}, {}
    out.mkdir(parents=True, exist_ok=True)
    parts = [[known[name] for name in group] for group in (names, held)]
    found = physics.find(sum(parts, [])) if any(kind.startswith("physics") for kind in kinds) else None
    for kind in kinds:
        say = lambda text, kind=kind: tqdm.write(f"{kind}: {text}")
        try:
            trained = models.train(kind, *parts, seed, kind, progress=say, found=found)
        except InputError as error:
            skipped[kind] = str(error)
            tqdm.write(f"{kind}: left out: {error}")
            continue
        folder = out / kind.replace("+", "_")
        folder.mkdir(exist_ok=True)
        model, effects = models.save(trained, folder)
        correctors[kind] = (EffectSet.from_yaml(effects) if effects else None, Network(model) if model else None)
    rows, before, honest = [], {kind: [] for kind in correctors}, {kind: [] for kind in correctors}
    scores = {group: {kind: [] for kind in correctors} for group in tests}
    for group, flights in tests.items():
        for flight in tqdm(flights, desc=group, unit="flight", disable=None, leave=False):
            labels = labelling.labels(flight)
            row = {"group": group, "flight": flight.name}
            for kind, (effects, network) in correctors.items():
                score = evaluate(flight, None, effects, network)[0]
                scores[group][kind].append(score)
                row[kind] = score.row()["rmse_3d"]
                left, std = remaining(labels, effects, network)
                before[kind].append(left)
                if network:
                    honest[kind].append(left**2 / (std**2 + labelling.white_noise([labels]) ** 2))
            if bound:
                row |= {name: study.rmse(flight, study.oracle(flight, window)) for name, window in BOUNDS.items()}
            rows.append(row)
    errors = {kind: np.concatenate(parts) for kind, parts in before.items()}
    plot_histograms(errors, out / "histograms.png")
    report = {"training": names, "validation": held, "skipped": skipped, "runs": rows, "seed": seed}
    report["tdoa_rms"] = {kind: float(np.sqrt(np.mean(values**2))) for kind, values in errors.items()}
    honest = {kind: np.concatenate(parts) for kind, parts in honest.items() if parts}
    report["normalised_variance"] = {kind: float(np.mean(values)) for kind, values in honest.items()}
    report["consistency"] = {
        group: {kind: _consistency(some) for kind, some in parts.items()} for group, parts in scores.items()
    }
    report["groups"] = {group: _means([row for row in rows if row["group"] == group]) for group in tests}
    bars = {group: {kind: means[kind] for kind in correctors} for group, means in report["groups"].items()}
    plot_bars(bars, out / "rmse.png")
    if bound:
        report["repeatability"] = _repeatability([labelling.labels(flight) for flight in train], tests)
    return report


def remaining(labels, effects, network):
    """Errors of the TDOAs of Labels after correction at the true poses, and the deviation predicted: (n,), (n,) m."""
    samples, left, std = labels.samples, labels.error.copy(), np.zeros(len(labels))
    if effects:
        left -= effects.bias(samples)
    if network:
        bias, std, _ = network.predict(samples)
        left -= np.nan_to_num(bias)
    return left, std


def markdown(report):
    """The table, runs and means of groups, with the reduction of the error against none."""
    kinds = [key for key in report["runs"][0] if key not in ("group", "flight")]
    lines = [["group", "flight", *kinds], ["---", "---"] + ["---:"] * len(kinds)]
    for group, means in report["groups"].items():
        runs = [row for row in report["runs"] if row["group"] == group]
        lines += [[group, row["flight"], *(f"{row[kind]:.3f}" for kind in kinds)] for row in runs]
        cells = [f"**{means[kind]:.3f}** ({means[kind] / means['none'] - 1.0:+.0%})" for kind in kinds]
        lines.append([group, "**mean**", *cells])
    text = "".join("| " + " | ".join(cells) + " |\n" for cells in lines)
    text += "\nTDOAs, RMS after correction at the true pose, m: "
    text += ", ".join(f"{kind} {value:.3f}" for kind, value in report["tdoa_rms"].items())
    text += "\nmean squared error of a TDOA over its predicted variance: "
    text += ", ".join(f"{kind} {value:.2f}" for kind, value in report["normalised_variance"].items()) + "\n"
    text += "position, NEES (3 is honest) and share of the time inside three standard deviations, worst axis:\n"
    for group, kinds in report["consistency"].items():
        text += f"  {group}: " + ", ".join(f"{kind} {a:.1f} {b:.1%}" for kind, (a, b) in kinds.items()) + "\n"
    for name, (mean, pairs) in report.get("repeatability", {}).items():
        text += f"residuals of two flights at one place, {name}: correlation {mean:.2f} ({pairs} pairs of flights)\n"
    return text


def _repeatability(known, tests):
    """{which pairs: (mean correlation, number of pairs)} of training flights with each other and with each group."""
    found = {"training with training": [(one, other) for k, one in enumerate(known) for other in known[:k]]}
    for group, flights in tests.items():
        found[f"training with {group}"] = [(labelling.labels(flight), one) for flight in flights for one in known]
    out = {}
    for name, pairs in found.items():
        values = np.array([study.repeatability(one, other)[0] for one, other in pairs])
        values = values[np.isfinite(values)]
        out[name] = (float(values.mean()) if len(values) else float("nan"), len(values))
    return out


def _consistency(scores):
    """(NEES of the position, share of the time inside three standard deviations on the worst axis), runs pooled."""
    together = pooled(scores)
    return together["nees_mean"], min(together[f"coverage_3sigma_{axis}"] for axis in "xyz")


def _means(rows):
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key not in ("group", "flight")}


if __name__ == "__main__":
    sys.exit(main())
