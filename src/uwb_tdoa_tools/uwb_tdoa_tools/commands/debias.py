"""debias: map the bias of estimated positions, take it out, and say what that is worth."""

import json
from pathlib import Path
import sys
from functools import partial

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.debias import INTERPOLATORS, BiasMap, fit

from .. import cli
from ..readers import inputs
from .. import parallel
from ..studies.debiasing import measured, set_up
from ..debiasing import report
from ..debiasing.judge import fly
from ..debiasing.parts import LEAST, part_of, static_parts

DESCRIPTION = """Map the bias of estimated positions over the room, after Grasso et al. (Sensors 2022, 22, 9136), and
take it out.

  fit       make a map from flights with ground truth, or from places where a tag stood still
  judge     errors of flights before and after a map
  set-up    the tables of docs/debiasing.md: a simulated copy of the paper's set-up
  measured  the tables of docs/debiasing.md: measured flights

A map belongs to one room, one anchor constellation and one estimator. debias_node applies it on line."""


def main(argv=None):
    """The executable."""
    parser = cli.parser(
        "debias",
        DESCRIPTION,
        "debias fit 0425-traj1 0425-traj2 --survey anchor_0425.txt --holdout 0425-traj3 --out map.npz",
        "debias fit --static points.csv --planar --step 0.5 --interpolator network --out map.npz",
        "debias judge map.npz 0426-traj1 --survey surveys/ --json errors.json",
        "debias set-up --out set_up/",
        "debias measured --data DATA --diagnosed bench/ --out measured/",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    fitting = commands.add_parser("fit", help="make a map")
    fitting.add_argument("flights", nargs="*", metavar="FLIGHT", help=inputs.HELP)
    fitting.add_argument(
        "--static", nargs="+", default=[], metavar="FILE",
        help="of a tag that stood still: CSV with true_x, true_y, true_z, x, y, z in metres, or recordings with truth",
    )  # fmt: skip
    fitting.add_argument("--holdout", nargs="+", default=[], metavar="FLIGHT", help="flights to judge on, not to fit")
    fitting.add_argument("--out", metavar="FILE", type=Path, required=True, help="the map to write (.npz)")
    fitting.add_argument(
        "--step", metavar="M", type=float, default=0.35, help="of the grid of markers, m (default: 0.35)"
    )
    fitting.add_argument("--planar", action="store_true", help="map x and y only, whatever the height")
    fitting.add_argument("--interpolator", choices=INTERPOLATORS, default="thin_plate", help="(default: thin_plate)")
    judging = commands.add_parser("judge", help="errors before and after a map")
    judging.add_argument("map", metavar="MAP", type=Path, help="file that `debias fit` wrote")
    judging.add_argument("flights", nargs="+", metavar="FLIGHT", help=inputs.HELP)
    for one in (fitting, judging):
        one.add_argument("--survey", metavar="S", help=inputs.SURVEY_HELP)
        one.add_argument("--effects", metavar="FILE", help="effects.yaml to correct the TDOAs with, before the filter")
        one.add_argument("--config", metavar="FILE", help="filter parameters, as for ekf_node (ekf_node.yaml)")
        one.add_argument("--namespace", default="", help="of the topics in the bags, e.g. tag1")
        one.add_argument("--json", metavar="FILE", type=Path, help="write all figures")
        parallel.add_options(one)
    copying = commands.add_parser("set-up", help="simulate the paper's set-up")
    copying.add_argument("--seed", metavar="N", type=int, default=0, help="of everything random (default: 0)")
    flying = commands.add_parser("measured", help="measured flights")
    flying.add_argument(
        "--data", metavar="DIR", type=Path, required=True, help="the measured flights: flights/, util/, surveys/"
    )
    flying.add_argument(
        "--diagnosed",
        metavar="DIR",
        type=Path,
        help="what `diagnose_bench measured` wrote: compare with its effects too",
    )
    for one in (copying, flying):
        one.add_argument(
            "--out", metavar="DIR", type=Path, required=True, help="where to write tables, figures and pictures"
        )
        one.add_argument("--jobs", metavar="N", type=int, help="runs at once (default: as many as there are cores)")
    return cli.run(_debias, parser, argv)


def _debias(args):
    {"fit": _fit, "judge": _judge, "set-up": _set_up, "measured": _measured}[args.command](args)


def _fit(args):
    if not (args.flights or args.static):
        raise InputError("FLIGHT: there is none; give flights with ground truth, or --static points.")
    if not 0.01 <= args.step <= 10.0:
        raise InputError(f"--step: {args.step!r} is outside 0.01 ... 10 m.")
    config, effects = _estimator(args)
    recordings, held = (_found(args, paths) for paths in (args.flights, args.holdout))
    shared = {path.resolve() for path, _ in recordings} & {path.resolve() for path, _ in held}
    if shared:
        raise InputError(f"--holdout: {sorted(shared)[0]} is also a FLIGHT to fit; leave it out of one of them.")
    parts = [part for path in args.static for part in static_parts(path, args.survey, config, effects, args.planar)]
    flown = parallel.over(partial(_fly, args=args, config=config, effects=effects), recordings, args.jobs, args.dask)
    fitted = list(flown)
    parts += [part_of(score, odometry) for _, score, odometry in fitted]
    frames = {flight.anchors.frame for flight, _, _ in fitted} or {"map"}
    if len(frames) > 1:
        raise InputError(
            f"FLIGHT: the flights are in different frames, {', '.join(sorted(frames))}; map them one by one."
        )
    source = ", ".join([flight.name for flight, _, _ in fitted] + [Path(path).name for path in args.static])
    least = LEAST if recordings else 1
    found = fit(parts, args.step, least, args.planar, args.interpolator, frames.pop(), source)
    found.save(args.out)
    print(f"wrote {args.out}: {report.about(found)}")
    figures = {"map": report.about_figures(found), "fitted": report.rows(fitted, found, effects)}
    report.say_rows("in sample", figures["fitted"])
    if held:
        figures["held out"] = _judged(args, held, found, config, effects)
        report.say_rows("held out", figures["held out"])
    _write(args.json, figures)


def _judge(args):
    config, effects = _estimator(args)
    found = BiasMap.load(args.map)
    rows = _judged(args, _found(args, args.flights), found, config, effects)
    report.say_rows("flight", rows)
    _write(args.json, {"map": report.about_figures(found), "runs": rows})


def _judged(args, recordings, found, config, effects):
    flown = parallel.over(partial(_fly, args=args, config=config, effects=effects), recordings, args.jobs, args.dask)
    return report.rows(flown, found, effects)


def _fly(recording, args, config, effects):
    return fly(recording, config, effects, args.namespace)


def _found(args, paths):
    return inputs.find_flights(paths, args.survey, absolute=bool(args.dask)) if paths else []


def _estimator(args):
    config = FilterConfig.from_yaml(args.config) if args.config else FilterConfig()
    return config, EffectSet.from_yaml(args.effects) if args.effects else None


def _set_up(args):
    args.out.mkdir(parents=True, exist_ok=True)
    figures, found, maps = set_up.run(args.seed, args.jobs)
    (args.out / "set_up.md").write_text(report.set_up_tables(figures))
    report.plot_set_up(found, maps, args.out / "set_up.png")
    _write(args.out / "set_up.json", figures)
    print(report.set_up_tables(figures))


def _measured(args):
    args.out.mkdir(parents=True, exist_ok=True)
    figures = measured.run(args.data, args.diagnosed, args.jobs)
    (args.out / "measured.md").write_text(report.measured_tables(figures))
    _write(args.out / "measured.json", figures)
    print(report.measured_tables(figures))


def _write(path, figures):
    if path is not None:
        path.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    sys.exit(main())
