"""bench: what the suite costs on this machine, in one run."""

import json
import os
import platform
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli

DESCRIPTION = """Measure on this machine, in this run: the compiled core, whole recordings, both nodes live, several
tags, and replays. Figures are medians with their quartiles, beside their targets.

  core    us per IMU prediction and per robust TDOA update, by anchors and kind of robustness
  offline seconds for a recording of 45 s, with correction, network and smoother
  nodes   time to ready, CPU, memory, latency and losses of both nodes at 1 kHz IMU + 400 Hz TDOA
  tags    the same for 1, 2, 4 and 8 tags, all of which hear the same streams
  replay  how fast a bag goes through both nodes without loss

Real nodes run in a ROS domain of their own. Whatever else the machine does shows in the figures, above all in the
latencies: what others used is printed. The last example keeps them away.
"""
PARTS = ("core", "offline", "nodes", "tags", "replay")


def main(argv=None):
    """The executable. Returns the exit code."""
    parser = cli.parser(
        "bench",
        DESCRIPTION,
        "bench",
        "bench --json bench.json",
        "bench --quick --only core offline",
        "bench --only offline --model network.onnx",
        "sudo -E env PATH=$PATH chrt --fifo 10 bench --only nodes tags",
    )
    parser.add_argument("--quick", action="store_true", help="fewer repetitions, shorter flights, fewer cases")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=f"of {', '.join(PARTS)} (default: all)"
    )
    parser.add_argument("--model", metavar="FILE", help="ONNX bias network for offline (default: the one shipped)")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("out/bench"),
        help="for the bags and the output of the nodes (default: out/bench)",
    )  # fmt: skip
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the machine and all figures")
    return cli.run(_bench, parser, argv)


def _bench(args):
    try:
        from ..benchmark import core, nodes, rates, recordings  # here, because --help needs no ROS
        from ..benchmark.figures import as_json, table
        from ..benchmark.usage import used_by_all, used_by_others
        from ..live.processes import LiveError
    except ImportError as error:
        raise InputError(f"ROS: {error}; build and source the workspace, or use ./dev run.") from error
    if args.json is not None and not args.json.absolute().parent.is_dir():
        raise InputError(f"{args.json}: its directory does not exist; make it first.")
    args.out.mkdir(parents=True, exist_ok=True)
    machine, figures, before = _machine(), [], used_by_all()
    with tqdm(bar_format="{desc}: {n} figures, {elapsed}", disable=None, leave=False) as progress:
        folder, quick, say = args.out, args.quick, progress.set_description
        parts = {  # recordings first: their first call is to be the first of this process
            "offline": lambda: recordings.measure(say, quick, args.model),
            "core": lambda: core.measure(say, quick),
            "nodes": lambda: nodes.measure(say, folder, quick),
            "tags": lambda: nodes.measure_tags(say, folder, quick),
            "replay": lambda: rates.measure(say, folder, quick),
        }
        try:
            for part in parts:
                if part in args.only:
                    for figure in parts[part]():
                        figures.append(figure)
                        progress.update()
        except LiveError as error:
            progress.close()
            print(f"bench: error: {error}", file=sys.stderr)
            return 1
    machine |= used_by_others(before)
    print(f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, numpy {machine['numpy']}")
    print(f"meanwhile others used {machine['others']:.0%} of its CPU time, its host {machine['stolen']:.0%}")
    print("\n".join(table(figures)))
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine, "figures": as_json(figures)}, indent=1) + "\n")
    return 0


def _machine():
    """What the figures depend on."""
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "cpu": names[0].partition(":")[2].strip() if names else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


if __name__ == "__main__":
    sys.exit(main())
