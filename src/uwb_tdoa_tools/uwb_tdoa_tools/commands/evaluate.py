"""How good is the estimate? Errors against ground truth, of the filter run here or of a recorded odometry."""

import csv
from dataclasses import fields, replace
from functools import partial
import json
from pathlib import Path

from tqdm import tqdm
import yaml

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_ekf.core.config import RENAMED, FilterConfig, current_names
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.smoother import smooth

from .. import cli
from ..readers import inputs
from .. import parallel
from ..bags.bag import read_odometry
from ..scoring.evaluation import evaluate, need_truth
from ..scoring.metrics import Score, as_json, pooled
from ..scoring.plots import plot_error
from ..readers import read_flight
from ..scoring.tum import write_tum

COLUMNS = {
    "rmse_x": "x", "rmse_y": "y", "rmse_z": "z", "rmse_3d": "3D", "median_3d": "median", "max_3d": "max",
    "frac_gt_1m": ">1 m", "nees_mean": "NEES", "nis_mean": "NIS", "start_delay": "delay",
}  # fmt: skip


def main(argv=None):
    """The executable."""
    parser = cli.parser(
        "evaluate",
        "Errors of the estimate against ground truth over the airborne part (truth z > 0.3 m), in metres.\n"
        "Runs bias correction and filter here, as the nodes would, or takes a recorded odometry.",
        "evaluate flight.bag",
        "evaluate 0425-traj2 --survey anchor_0425.txt --plot error.png",
        "evaluate flights/ --survey surveys/ --no-bias --json errors.json",
        "evaluate flight.bag --odometry recorded.bag --tum out/",
        "evaluate flights/ --survey surveys/ -p adapt_noise:=false -p loss:=huber",
        "evaluate flights/ --survey surveys/ --dask tcp://10.0.0.1:8786",
    )
    parser.add_argument("flights", nargs="+", metavar="FLIGHT", help=inputs.HELP)
    parser.add_argument("--survey", metavar="S", help=inputs.SURVEY_HELP)
    parser.add_argument("--effects", metavar="FILE", help="effects.yaml: systematic effects to correct for")
    parser.add_argument("--model", metavar="FILE", help='ONNX bias network to correct with; "default" is the one shipped')
    parser.add_argument("--no-bias", action="store_true", help="correct for nothing, whatever else is given")
    parser.add_argument("--config", metavar="FILE", help="filter parameters, as for ekf_node (ekf_node.yaml)")
    parser.add_argument(
        "-p", dest="parameters", metavar="NAME:=VALUE", action="append", default=[], help="one filter parameter, before --config"
    )
    parser.add_argument("--smooth", action="store_true", help="smooth: use what came after each estimate too")
    parser.add_argument("--odometry", metavar="BAG", help="judge the odometry of this bag; needs exactly one FLIGHT")
    parser.add_argument("--namespace", default="", help="of the topics in the bags, e.g. tag1")
    parser.add_argument("--json", metavar="FILE", help="write all figures: runs, pooled")
    parser.add_argument("--markdown", metavar="FILE", help="write the table as Markdown")
    parser.add_argument(
        "--beside", metavar="CSV", help="add the 3D RMSE that others reach to that table: columns flight, peer, mode, rmse_3d, diverged"
    )
    parser.add_argument("--plot", metavar="FILE", help="picture of the errors over time (one FLIGHT)")
    parser.add_argument("--tum", metavar="DIR", help="write estimates and truths as TUM trajectories, e.g. for evo")
    parallel.add_options(parser)
    return cli.run(_evaluate, parser, argv)


def _evaluate(args):
    config = FilterConfig.from_yaml(args.config) if args.config else FilterConfig()
    config = replace(config, **current_names(dict(map(_parameter, args.parameters))))
    effects = EffectSet.from_yaml(args.effects) if args.effects and not args.no_bias else None
    network = None if args.no_bias else load_network(args.model)
    found = inputs.find_flights(args.flights, args.survey, absolute=bool(args.dask))
    for option in ("odometry", "plot"):
        if getattr(args, option) and len(found) != 1:
            raise InputError(f"--{option}: needs exactly one flight, got {len(found)}.")
    if args.tum:
        args.tum = Path(args.tum).absolute()
    scores = []
    print(_line("flight", COLUMNS.values()))
    judge = partial(_judge, args=args, config=config, effects=effects, network=network)
    for score in parallel.over(judge, found, args.jobs, args.dask):
        scores.append(score)
        tqdm.write(_row(score.row()))
    together = pooled(scores)
    if len(scores) > 1:
        print(_row(together))
        print(f"mean 3D RMSE of the runs {together['rmse_3d_mean_of_runs']:.3f} m, largest "
              f"{together['rmse_3d_max_of_runs']:.3f} m, diverged {together['diverged']}")  # fmt: skip
    if args.json:
        report = {"runs": [as_json(score.row()) for score in scores], "pooled": as_json(together)}
        Path(args.json).write_text(json.dumps(report, indent=1, allow_nan=False))
    if args.markdown:
        rows = [score.row() for score in scores] + [together] * (len(scores) > 1)
        Path(args.markdown).write_text(_markdown(rows, _others(args.beside) if args.beside else {}))
    return 0


def _parameter(text):
    """(name, value) of "name:=value". Raises InputError."""
    name, assigned, value = text.partition(":=")
    names = [field.name for field in fields(FilterConfig)]
    if not assigned or name not in (*names, *RENAMED):
        raise InputError(f"-p {text}: write NAME:=VALUE, where NAME is one of {', '.join(names)}.")
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError:
        raise InputError(f"-p {text}: {value!r} is no value.") from None


def _judge(recording, args, config, effects, network):
    """Score of one (path, survey), after writing its picture and trajectories."""
    flight = read_flight(*recording, args.namespace)
    need_truth(flight)
    if args.odometry:
        odometry = read_odometry(args.odometry, namespace=args.namespace)
        score = Score(flight.name, odometry, flight.truth)
    else:
        score, result = evaluate(flight, config, effects, network, smooth if args.smooth else run_offline)
        odometry = result.odometry
    if args.plot:
        plot_error(score, odometry, flight.truth, args.plot)
    if args.tum:
        write_tum(args.tum / f"{flight.name}.tum", odometry.t, odometry.p, odometry.q)
        write_tum(args.tum / f"{flight.name}_truth.tum", flight.truth.t, flight.truth.p, flight.truth.q)
    return score


def _others(path):
    """{peer and mode: {flight: 3D RMSE as text, or "diverged"}} of a CSV file. Raises InputError."""
    others = {}
    with open(path, newline="") as file:
        for line in csv.DictReader(file):
            try:
                cell = "diverged" if line["diverged"] == "True" else f"{float(line['rmse_3d']):.3f}"
                others.setdefault(f"{line['peer']} {line['mode']}", {})[line["flight"]] = cell
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(f"{path}: needs columns flight, peer, mode, rmse_3d, diverged ({error!r}).") from error
    return others


def _markdown(rows, others):
    """The table of all runs, in metres, with one column per other estimator."""
    table = [["flight", *COLUMNS.values(), *others]]
    table.append(["---"] + ["---:"] * (len(table[0]) - 1))
    for row in rows:
        cells = [f"{row[key]:.3f}" for key in COLUMNS] + [peer.get(row["flight"], "") for peer in others.values()]
        table.append([row["flight"], *cells])
    return "".join("| " + " | ".join(cells) + " |\n" for cells in table)


def _row(row):
    return _line(row["flight"], (f"{row[key]:.3f}" for key in COLUMNS)) + ("  DIVERGED" if row["diverged"] else "")


def _line(first, cells):
    return f"{first:20s}" + "".join(f"{cell:>9s}" for cell in cells)
