# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""random-splits: train every kind of bias model on random flights, and judge it on all others.

The rows of all splits go to --out.
"""

from collections import defaultdict
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_tools import choices
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.gains import best_share
from uwb_tdoa_tools.training import models, physics, shrinking

WORSE = 1.05  # ratio of errors beyond which a judged flight counts as harmed


def add_options(add):
    """The options of the study."""
    add("flights", nargs="+", metavar="FLIGHT", help=choices.RECORDINGS)
    add("--survey", metavar="S", help=choices.SURVEY)
    add(
        "--out",
        metavar="FILE",
        type=OutputFile,
        required=True,
        help="JSON, a row for each split and kind",
    )
    add(
        "--models",
        nargs="+",
        choices=choices.MODELS,
        default=list(choices.MODELS),
        help="(default: all)",
    )
    add("--splits", type=int, default=20, metavar="N", help="(default: 20)")
    add("--first", type=int, default=0, metavar="SEED", help="of the first split (default: 0)")
    add("--fit", type=int, default=4, metavar="N", help="flights to train on (default: 4)")


def run(args):
    """Do all splits, write their rows, and print the table."""
    flights = [
        flight.without(*SENSOR_NAMES)
        for flight in inputs.Reading(args.survey).flights(args.flights)
    ]
    seeds, uncorrected_errors = (
        range(args.first, args.first + args.splits),
        shrinking.uncorrected(flights),
    )
    made = {}
    for seed in tqdm(seeds, unit="split", disable=None):
        for row in split(flights, uncorrected_errors, seed, args.fit, args.models):
            made[row["kind"], seed] = row
    rows = [made[kind, seed] for kind in args.models for seed in seeds]
    write_text(args.out, json.dumps(rows))
    print(table(rows, shrunk=False) + "\n" + table(rows, shrunk=True))


def split(flights, uncorrected_errors, seed, fit, kinds):
    """Yield, for each kind, a dict of one split.

    It has the 3D RMSE of every left-out flight by share of the correction. For every judged flight,
    it has the 3D RMSE with the share that the left-out flights support, and with the full
    correction.
    uncorrected_errors : of `shrinking.uncorrected`
    """
    order = np.random.default_rng([seed, fit]).permutation(len(flights))
    chosen, others = ([flights[k] for k in part] for part in (order[:fit], order[fit:]))
    found = (
        physics.find_effects(chosen) if any(kind.startswith("physics") for kind in kinds) else None
    )
    for kind in kinds:
        known = found if kind.startswith("physics") else None
        borne_out = shrinking.cross_validated(
            models.Recipe(kind, seed), chosen, uncorrected_errors, known
        )
        with TemporaryDirectory() as folder:
            trained = models.train(
                models.Recipe(kind, seed), chosen[:-1], chosen[-1:], kind, found=known, curve=False
            )
            model, _ = models.save(trained, Path(folder))
            network = Network(model) if model else None
            shares = sorted({borne_out.share, 1.0})
            errors = {
                flight.name: shrinking.errors_by_share(
                    flight, uncorrected_errors, trained.effects, network, shares
                )
                for flight in others
            }
        yield {
            "seed": seed,
            "kind": kind,
            "left_out": borne_out.as_dict()["left_out"],
            "judged": _text(errors),
        }


def table(rows, shrunk):
    """Markdown: a row for each kind. shrunk : scale the correction by the share that the left-out
    flights support, instead of the full correction.
    """
    title = "as much as is borne out" if shrunk else "all of it"
    lines = [
        (
            f"| {title} | splits | gain | spread | worst split | largest ratio | flights worse by "
            "5 % | expected | share |"
        )
    ]
    lines.append("|---|" + 8 * "---:|")
    by_kind = defaultdict(list)
    for row in rows:
        by_kind[row["kind"]].append(row)
    for kind, some in by_kind.items():
        shares = [best_share(_numbers(row["left_out"])) if shrunk else 1.0 for row in some]
        ratios = [_ratios(row["judged"], share) for row, share in zip(some, shares)]
        expected = np.mean(
            [1.0 - _ratios(row["left_out"], share).mean() for row, share in zip(some, shares)]
        )
        gains, every = np.array([1.0 - each.mean() for each in ratios]), np.concatenate(ratios)
        lines.append(
            f"| {kind} | {len(some)} | {gains.mean():.1%} | "
            f"{gains.std(ddof=1) if len(some) > 1 else 0.0:.1%} | {gains.min():.1%} "
            f"| {every.max():.2f} | {int((every > WORSE).sum())} of {len(every)} | "
            f"{expected:.1%} | {np.mean(shares):.2f} |"
        )
    return "\n".join(lines) + "\n"


def _ratios(errors, share):
    """(n,) error with a share over that without correction, of errors as they are written."""
    return np.array([of[str(share)] / of["None"] for of in errors.values()])


def _text(errors):
    return {name: {str(share): error for share, error in of.items()} for name, of in errors.items()}


def _numbers(errors):
    return {
        name: {None if share == "None" else float(share): error for share, error in of.items()}
        for name, of in errors.items()
    }
