"""Makes the table of replays in step in docs/reliability.md, in a shell with the workspace sourced (./dev shell):

    python src/uwb_tdoa_tools/test/lockstep_table.py LOG SURVEY --runs 3
"""

import argparse
from contextlib import ExitStack
from pathlib import Path
import subprocess
import sys
import tempfile

sys.path.insert(0, str(Path(__file__).resolve().parent))

from test_lockstep import replayed  # noqa: E402
from uwb_tdoa_bias.correction.network import SHIPPED, load_network  # noqa: E402
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag  # noqa: E402
from uwb_tdoa_tools.readers import read_flight  # noqa: E402
from uwb_tdoa_tools.scoring.evaluation import evaluate  # noqa: E402
from uwb_tdoa_tools.scoring.metrics import Score  # noqa: E402


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log")
    parser.add_argument("survey")
    parser.add_argument("--runs", type=int, default=3, help="of each rate and load (default 3)")
    parser.add_argument("--rates", type=float, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--loads", type=int, nargs="+", default=[0, 1, 3], help="busy processes beside it")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "flight.bag"
        write_bag(read_flight(args.log, args.survey), bag)
        flight = read_bag(bag)
        offline = evaluate(flight, network=load_network(SHIPPED))[0].row()["rmse_3d"]
        print(f"offline {offline:.4f} m\n| rate | load | exit codes | late | 3D RMSE - offline, mm | s |\n|---|---|---|---|---|---|")
        for load in args.loads:
            for rate in args.rates:
                rows = [run(bag, flight, rate, load, offline) for _ in range(args.runs)]
                codes, late, apart, took = (", ".join(str(row[k]) for row in rows) for k in range(4))
                print(f"| {rate:g} | {load} | {codes} | {late} | {apart} | {took} |", flush=True)


def run(bag, flight, rate, load, offline):
    """(exit code, TDOAs late, mm from the offline result, s that the replay took) of one replay."""
    with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        for _ in range(load):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(process.wait)
            stack.callback(process.kill)
        code, said, told, recorded = replayed(bag, Path(folder), "--rate", rate)
        error = Score("live", read_odometry(recorded), flight.truth).row()["rmse_3d"]
        took = said.rpartition(" messages in ")[2].partition(" s")[0]
        return code, told["ekf_node"]["late"], f"{1e3 * (error - offline):+.2f}", took


if __name__ == "__main__":
    main()
