"""bench: what the suite costs on this machine, in one run."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from .. import cli
from ..benchmark.figures import as_json, table
from ..benchmark.peer import Peer
from ..benchmark.suite import PARTS, measure
from ..outputs import OutputFile, OutputFolder

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace

DESCRIPTION = """Measure on this machine, in this run: the compiled core, whole recordings, both nodes live, several
tags, replays, and what else nodes answer. Figures are medians with their quartiles, beside their targets.

  core    us per IMU prediction and per robust TDOA update, by anchors and kind of robustness
  offline seconds for a recording of 45 s, with correction, network and smoother
  nodes   time to ready, CPU, memory, latency and losses of both nodes at 1 kHz IMU + 400 Hz TDOA
  tags    the same for 1 to 8 tags, and for 30 and 60 at 100 Hz, in localization_nodes; all tags hear the same streams
  hall    the same for a tag that hears 8 of 8, 1000 and 10 000 installed anchors
  replay  how fast a bag goes through both nodes without loss
  graph   how long parameters, a told pose and a clock that stops wait while streams, /clock and /tf flow; idle CPU

With --peer, another filter, e.g. that of a firmware, runs over the same events in turn with ours, and the ratio is printed.

Real nodes run in a ROS domain of their own. Whatever else the machine does shows in the figures, above all in the
latencies: what others used is printed. The last example keeps them away.
"""


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "bench",
        DESCRIPTION,
        "bench",
        "bench --json bench.json",
        "bench --quick --only core offline",
        "bench --only core --peer libpeer.so",
        "bench --only offline --model network.onnx",
        "sudo -E env PATH=$PATH chrt --fifo 10 bench --only nodes tags",
    )
    add = made.add_argument
    add("--quick", action="store_true", help="fewer repetitions, shorter flights, fewer cases")
    add(
        "--only",
        nargs="+",
        choices=PARTS,
        default=PARTS,
        metavar="PART",
        help=f"of {', '.join(PARTS)} (default: all)",
    )
    add("--model", metavar="FILE", help="ONNX bias network whose figures offline prints, too")
    add(
        "--peer",
        metavar="LIBRARY",
        help=(
            "measure this shared library of another filter beside ours, event by event (what it "
            "exports: docs/speed.md)"
        ),
    )
    add(
        "--out",
        metavar="DIR",
        type=OutputFolder,
        default="out/bench",
        help="for the bags and the output of the nodes (default: out/bench)",
    )
    add("--json", metavar="FILE", type=OutputFile, help="write the machine and all figures")
    return made


def _bench(args: Namespace) -> None:
    other = None if args.peer is None else Peer(args.peer)
    machine, figures = measure(args.only, args.out, args.quick, args.model, other)
    cli.show(
        f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, numpy "
        f"{machine['numpy']}"
    )
    cli.show(
        f"meanwhile others used {machine['others']:.0%} of its CPU time, its host "
        f"{machine['stolen']:.0%}"
    )
    cli.show("\n".join(table(figures)))
    if args.json is not None:
        cli.write_json(args.json, {"machine": machine, "figures": as_json(figures)})


main = cli.executable(_bench, parser)

if __name__ == "__main__":
    sys.exit(main())
