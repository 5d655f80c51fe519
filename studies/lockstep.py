# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""lockstep: compare replays that wait for the nodes with the off-line run, by rate and load."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
import subprocess
import sys
import tempfile

import known_answer
import numpy as np
from test_lockstep import replayed

from studies.monitor import cut
from uwb_tdoa_bias.common.flight import Truth
from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.scoring.metrics import Score


def add_options(add):
    """The options of the study."""
    add("flight", metavar="LOG", help="recording")
    add("survey", metavar="SURVEY", help="its survey")
    begin = "s after the first TDOA (default: %(default)s)"
    add("--from", dest="begin", metavar="S", type=float, default=0.0, help=begin)
    add("--seconds", metavar="S", type=float, default=np.inf, help="of the flight (default: all)")
    add("--runs", metavar="N", type=int, default=3, help="of each rate and load (default: 3)")
    add("--rates", metavar="R", type=float, nargs="+", default=[1, 2, 4, 8], help="of the replay")
    loads = "busy processes beside it (default: %(default)s)"
    add("--loads", metavar="N", type=int, nargs="+", default=[0, 1, 3], help=loads)


def run(args):
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "flight.bag"
        flight = cut(read_flight(args.flight, args.survey), args.begin, args.begin + args.seconds)
        judged = (flight.truth.t >= flight.tdoa.t[0]) & (flight.truth.t <= flight.tdoa.t[-1])
        write_bag(
            replace(
                flight, truth=Truth(*(column[judged] for column in vars(flight.truth).values()))
            ),
            bag,
        )
        flight = read_bag(bag)
        score, offline = evaluate(flight, network=load_network(known_answer.write(Path(folder))))
        rmse = score.row()["rmse_3d"]
        print(
            f"offline {rmse:.4f} m, {len(offline.odometry)} poses; of all runs the largest "
            "figure, of the times the median"
        )
        print(
            "| rate | load | runs | exit code not 0 | late | 3D RMSE - offline, mm | poses "
            "not recorded | others apart by, mm | s |"
        )
        print("|---|---|---|---|---|---|---|---|---|")
        for load in args.loads:
            for rate in args.rates:
                rows = np.array(
                    [
                        replayed_once(bag, flight, rate, load, rmse, offline.odometry)
                        for _ in range(args.runs)
                    ]
                )
                codes, late, rmse_apart, missing, apart = np.abs(rows).max(axis=0)[:5]
                cells = (
                    f"{np.count_nonzero(rows[:, 0])} | {late:.0f} | {rmse_apart:.2f} | "
                    f"{missing:.0f} | {apart:.3f} | {np.median(rows[:, 5]):.1f}"
                )
                print(f"| {rate:g} | {load} | {args.runs} | {cells} |", flush=True)


def replayed_once(bag, flight, rate, load, rmse, offline):
    """Replay a bag once, and compare it with the off-line run.

    Returns (exit code, late TDOAs, difference of the RMSE mm, missing poses, largest distance of
    recorded from off-line poses mm, duration of the replay s).
    """
    with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        for _ in range(load):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(process.wait)
            stack.callback(process.kill)
        code, said, told, recorded = replayed(bag, Path(folder), "--rate", rate)
        if code:
            print(said, file=sys.stderr)
        live = read_odometry(recorded)
        error = Score("live", live, flight.truth).row()["rmse_3d"]
        took = float(said.rpartition(" messages in ")[2].partition(" s")[0])
        nearest = np.clip(np.searchsorted(offline.t, live.t - 1e-6), 0, len(offline) - 1)
        apart = np.linalg.norm(live.p - offline.p[nearest], axis=1).max()
        missing = len(offline) - len(np.unique(nearest))
        return code, int(told["ekf_node"]["late"]), 1e3 * (error - rmse), missing, 1e3 * apart, took
