# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Map the bias of estimated positions, remove it, and show the gain."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, options, parallel
from ..cli import OutputFile, option

DESCRIPTION = """Map the bias of estimated positions in x and y, after Grasso et al. (Sensors 2022, 22, 9136), and
take it out.

  fit       make a map from flights with ground truth, or from places where a tag stood still
  judge     errors of flights before and after a map

A map belongs to one room, one anchor constellation and one estimator: other anchors are refused. A map that does harm to
flights that took no part is not written. Exit code 1: harm. debias_node applies a map on line."""


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "debias",
        DESCRIPTION,
        (
            "debias fit 0425-traj1 0425-traj2 --survey anchor_0425.txt --holdout 0425-traj3 --out "
            "map.npz"
        ),
        ("debias fit --static points.csv --survey anchors.yaml --step 0.5 --out map.npz"),
        "debias judge map.npz 0426-traj1 --survey surveys/ --json errors.json",
    )
    shared = (
        *options.filtering(),
        options.align(),
        option("--json", metavar="FILE", type=OutputFile, help="write all figures"),
        options.JOBS,
    )
    fitting = (
        *options.recordings("*"),
        *shared,
        option(
            "--static",
            nargs="+",
            default=[],
            metavar="FILE",
            help=(
                "of a tag that stood still: CSV with true_x, true_y, x, y in metres, or "
                "recordings with truth"
            ),
        ),
        options.HOLDOUT,
        option(
            "--out",
            metavar="FILE",
            type=OutputFile,
            required=True,
            help="the map to write (.npz)",
        ),
        option(
            "--step",
            metavar="M",
            type=float,
            default=0.35,
            help="of the grid of markers, m (default: 0.35)",
        ),
    )
    judging = (
        option("map", metavar="MAP", type=Path, help="file that `debias fit` wrote"),
        *options.recordings(),
        *shared,
    )
    commands = made.add_subparsers(dest="command", required=True, metavar="COMMAND")
    cli.add(commands.add_parser("fit", help="make a map"), fitting)
    cli.add(commands.add_parser("judge", help="errors before and after a map"), judging)
    return made


def _fit(args: Namespace) -> int:
    from .. import debiasing

    if not (args.flights or args.static):
        raise InputError(
            "FLIGHT: there is none; give flights with ground truth, or --static points."
        )
    if not 0.01 <= args.step <= 10.0:
        raise InputError(f"--step: {args.step!r} is outside 0.01 ... 10 m.")
    estimator = debiasing.PositionEstimator(
        options.reading_of(args), *options.filter_of(args), args.align
    )
    recordings, held = (estimator.reading.find(paths) for paths in (args.flights, args.holdout))
    options.check_holdout(
        (path.resolve() for path, _ in recordings), (path.resolve() for path, _ in held)
    )
    fitted = list(parallel.over(estimator, recordings, args.jobs))
    shrinkage = debiasing.cross_validated(fitted, args.static, estimator, args.step)
    made = debiasing.fit_map(fitted, args.static, estimator, args.step)
    made = made.scaled(shrinkage.share) if shrinkage else made
    cli.show(debiasing.map_summary(made))
    cli.show(
        shrinkage.as_text()
        if shrinkage
        else "how much of it flights to come bear out is not known: give several flights"
    )
    figures: dict[str, Any] = {
        "map": debiasing.map_figures(made),
        "fitted": debiasing.comparison_rows(fitted, made, estimator.effects),
        "borne_out": shrinkage.as_dict() if shrinkage else None,
    }
    debiasing.print_rows("in sample", figures["fitted"])
    refusals = []
    if shrinkage and not shrinkage.gains.mean() >= debiasing.SMALLEST_GAIN:
        refusals.append(debiasing.verdict(float(shrinkage.gains.mean()), "flights left out"))
    if held:
        flown = parallel.over(estimator, held, args.jobs)
        figures["held out"] = debiasing.comparison_rows(flown, made, estimator.effects)
        debiasing.print_rows("held out", figures["held out"])
        gained = debiasing.mean_gain(figures["held out"])
        cli.show(debiasing.verdict(gained, "flights held out"))
        refusals += [debiasing.verdict(gained, "flights held out")] * debiasing.does_harm(gained)
    figures["written"] = not refusals
    cli.write_json(args.json, figures)
    if refusals:
        cli.show(f"{args.out} is not written: {refusals[0]}")
        return 1
    made.save(args.out)
    cli.show(f"wrote {args.out}")
    return 0


def _judge(args: Namespace) -> int:
    from uwb_tdoa_ekf.debias import BiasMap

    from .. import debiasing

    estimator = debiasing.PositionEstimator(
        options.reading_of(args), *options.filter_of(args), args.align
    )
    made = BiasMap.load(args.map)
    found = estimator.reading.find(args.flights)
    flown = parallel.over(estimator, found, args.jobs)
    rows = debiasing.comparison_rows(flown, made, estimator.effects)
    debiasing.print_rows("flight", rows)
    gained = debiasing.mean_gain(rows)
    cli.show(debiasing.verdict(gained, "these flights"))
    cli.write_json(args.json, {"map": debiasing.map_figures(made), "runs": rows, "gain": gained})
    return int(debiasing.does_harm(gained))


main = cli.executable(lambda args: {"fit": _fit, "judge": _judge}[args.command](args), parser)
