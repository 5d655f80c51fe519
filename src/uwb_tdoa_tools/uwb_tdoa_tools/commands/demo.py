"""demo: a flight through both nodes over ROS topics, and how far the estimate is from ground truth."""

import sys
import time
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.correction.network import SHIPPED, load_network
from uwb_tdoa_ekf.offline import run_offline

from .. import cli
from ..readers import inputs
from ..bags.bag import read_odometry, write_bag
from ..scoring.metrics import Score, airborne, position_at
from ..scoring.plots import plt
from ..readers import read_flight
from ..simulation import SimulationConfig, simulate

DESCRIPTION = """Take a flight, write it as a bag, replay the bag through bias_node and ekf_node over ROS topics, and
compare the estimate with ground truth.

Without --flight it is a simulated one whose anchors have delays of 0.1 m (standard deviation); the nodes correct for
them with an effects.yaml that holds their true values, as a calibration would find them. A measured flight is corrected
with what --effects and --model give, or else with the model that bias_node ships. "raw" is the same filter without any correction, run without ROS.
"""
SIMULATED = SimulationConfig(anchor_delay_std=0.1, duration=40.0, seed=1)
FIGURES = {"rmse_x": "x", "rmse_y": "y", "rmse_z": "z", "rmse_3d": "3D", "median_3d": "median", "max_3d": "max"}


def main(argv=None):
    """The executable."""
    parser = cli.parser(
        "demo",
        DESCRIPTION,
        "demo",
        "demo --flight 0607/tdoa2-obs-log1 --survey anchor_0607.txt --rate 4",
        "demo --flight flight.bag --effects effects.yaml --out out/corrected",
    )
    add = parser.add_argument
    add("--flight", metavar="LOG", help="a recording: micro-SD log, UTIL CSV or bag (default: simulate one)")
    add("--survey", metavar="S", help=inputs.SURVEY_HELP)
    add("--rate", metavar="R", type=float, default=1.0, help="replay R times as fast as flown (default 1)")
    add("--out", metavar="DIR", type=Path, default=Path("out/demo"), help="for all files (default out/demo)")
    add("--effects", metavar="FILE", help="effects.yaml to correct with")
    add("--model", metavar="FILE", help='ONNX bias network to correct with; "default" is the one shipped')
    return cli.run(demo, parser, argv)


def demo(args):
    """Do as the parsed arguments say; returns the exit code."""
    try:
        from ..live.run import accounts, run_live  # here, because --help needs no ROS
        from ..live.processes import LiveError
    except ImportError as error:
        raise InputError(f"ROS: {error}; build and source the workspace, or use ./dev demo.") from error
    if not 0.0 < args.rate < float("inf"):
        raise InputError(f"--rate: {args.rate:g} is not a speed; give a number above 0.")
    started = time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)

    flight, effects_file, model = _flight(args)
    effects = EffectSet.from_yaml(effects_file) if effects_file else EffectSet()
    network = load_network(model)
    correction = Corrector(flight.anchors, effects, network)
    length = flight.truth.t[-1] - flight.truth.t[0]
    print(f"flight     {flight.name}: {length:.1f} s, {len(flight.tdoa)} TDOAs, {len(flight.anchors)} anchors")
    sources = ["shipped with bias_node" if path == SHIPPED else str(path) for path in (effects_file, model) if path]
    print(f"correction {correction.model} ({', '.join(sources)})")

    bag = args.out / "flight.bag"
    write_bag(flight, bag, force=True)
    try:
        live = run_live(
            bag, args.out, args.rate,
            {"effects_file": _absolute(effects_file), "model_file": SHIPPED if model == SHIPPED else _absolute(model)},
            {"use_imu": flight.imu is not None},
            lambda text: print(f"nodes      {text}", flush=True),
        )  # fmt: skip
    except LiveError as error:
        print(f"demo: error: {error}", file=sys.stderr)
        return 1

    if not _print_accounts(flight, accounts(live.ekf, flight)):
        print(f"demo: messages lost or late: too much load for --rate {args.rate:g}; try less.", file=sys.stderr)
    raw = Score("raw", run_offline(flight).odometry, flight.truth)
    corrected = Score("corrected", read_odometry(live.recorded), flight.truth)
    without_ros = Score("corrected, without ROS", run_offline(flight, corrector=correction).odometry, flight.truth)
    _print_errors(raw, corrected, without_ros)
    _plot([raw, corrected], flight, args.out / "error.png")
    print(f"plot       {args.out / 'error.png'}")
    print(f"took {time.monotonic() - started:.0f} s")
    return int(corrected.row()["diverged"])


def _flight(args):
    """(Flight, path of effects.yaml or None, model or None)."""
    if args.flight:
        flight = read_flight(args.flight, inputs.survey_for(args.flight, args.survey))
        if flight.truth is None:
            raise InputError(f"{args.flight}: holds no ground truth to compare with; take a flight that has it.")
        airborne(flight.truth)
        return flight, args.effects, args.model or (None if args.effects else SHIPPED)
    if args.survey:
        raise InputError("--survey: needs --flight; a simulated flight has its own anchors.")
    flight = simulate(SIMULATED)
    if args.effects or args.model:
        return flight, args.effects, args.model
    true_delays = AnchorDelay(flight.meta["parameters"]["anchor_delays"], source="the simulation's own values")
    effects_file = args.out / "effects.yaml"
    EffectSet((true_delays,)).to_yaml(effects_file)
    return flight, effects_file, None


def _absolute(path):
    """For a node, which runs elsewhere; "" for none."""
    return str(Path(path).resolve()) if path else ""


def _print_accounts(flight, became):
    """Print what became of every message, as live.accounts says. Returns whether all were there in time."""
    told = ", ".join(f"{count} {name}" for name, count in became.items() if not name.startswith("imu_"))
    print(f"nodes      TDOAs {len(flight.tdoa)}: {told}")
    samples = 0 if flight.imu is None else len(flight.imu)
    print(f"nodes      IMU samples {samples}: {became['imu_late']} late, {became['imu_lost']} lost")
    return not any(became[name] for name in ("lost", "late", "imu_late", "imu_lost"))


def _print_errors(raw, corrected, *others):
    print(f"{'error, m':28s}" + "".join(f"{title:>9s}" for title in FIGURES.values()))
    for score in (raw, corrected, *others):
        print(f"{score.name:28s}" + "".join(f"{score.row()[key]:9.3f}" for key in FIGURES))
    before, after = raw.row()["rmse_3d"], corrected.row()["rmse_3d"]
    print(f"3D RMSE raw {before:.3f} m, corrected {after:.3f} m: {round(100.0 * (after - before) / before):+d} %")


def _plot(scores, flight, path):
    """3D error of several Scores of one flight over time, and the paths they tell from above; to an image file."""
    figure, (over_time, above) = plt.subplots(1, 2, figsize=(13, 5), width_ratios=(3, 2), layout="constrained")
    flown = (flight.truth.t >= scores[0].first) & (flight.truth.t <= scores[0].last)
    above.plot(*flight.truth.p[flown, :2].T, "k", lw=1.2, label="ground truth")
    for score in scores:
        name = f"{score.name}: RMSE {score.row()['rmse_3d']:.3f} m"
        over_time.plot(score.t - score.first, np.linalg.norm(score.error, axis=1), lw=0.8, label=name)
        above.plot(*(position_at(score.t, flight.truth) + score.error)[:, :2].T, lw=0.8, label=score.name)
    over_time.set(xlabel="time in the air [s]", ylabel="3D position error [m]", ylim=(0, None))
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    for axes in (over_time, above):
        axes.grid(alpha=0.3)
        axes.legend()
    figure.suptitle(flight.name)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
