# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""bench: measure processor time, memory and latency of the suite on this machine.

Figures are medians with their quartiles and targets.

core : us per IMU prediction and per robust TDOA update, by anchors and kind of robustness.
offline : s for a recording of 45 s, with correction, network and smoother.
nodes : time to ready, CPU, memory, latency and losses of both nodes at 1 kHz IMU + 400 Hz TDOA.
tags : the same for 1 to 8 tags, and for 30 and 60 at 100 Hz, in localization_nodes; all tags hear
the same streams.
hall : the same for a tag that hears 8 of 8, 1000 and 10 000 installed anchors.
peer : another filter compared with ours; needs --peer.
replay : how fast a bag goes through both nodes without loss.
graph : time to answer a parameter request, to apply an initial pose and to report a stopped clock,
while streams, /clock and /tf flow; idle CPU.

With --peer, another filter runs over the same events in turn with ours, and the ratio is printed.
Real nodes run in a separate ROS domain. Other work on the machine changes the figures, above all
the latencies; the study prints the processor time of other processes. To get priority over them:
sudo -E env PATH=$PATH chrt --fifo 10 ./dev study bench --only nodes tags
"""

from __future__ import annotations

from functools import partial
import os
from pathlib import Path
import platform
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from uwb_tdoa_tools import cli
from uwb_tdoa_tools.cli import OutputFile, OutputFolder

from . import core, graph, nodes, peer, rates, recordings
from .figures import as_json, table
from .usage import used_by_all, used_by_others

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable, Iterator, Sequence

    from .figures import Figure

PARTS = ("core", "offline", "nodes", "tags", "hall", "replay", "graph", "peer")


def add_options(add: Callable[..., object]) -> None:
    """The options of the study."""
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
    peer_help = "measure this shared library of another filter beside ours (docs/notebook/speed.md)"
    add("--peer", metavar="LIBRARY", help=peer_help)
    out_help = "for the bags and the output of the nodes (default: out/bench)"
    add("--out", metavar="DIR", type=OutputFolder, default="out/bench", help=out_help)
    add("--json", metavar="FILE", type=OutputFile, help="write the machine and all figures")


def run(args: Namespace) -> None:
    """Measure, and print the table."""
    other = None if args.peer is None else peer.Peer(args.peer)
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


def measure(
    parts: Sequence[str],
    folder: Path,
    quick: bool = False,
    model: str | Path | None = None,
    other: peer.Peer | None = None,
) -> tuple[dict[str, Any], list[Figure]]:
    """Measure some of PARTS. Returns (machine, list of Figure).

    folder : for bags and the output of the nodes
    quick : fewer repetitions and cases
    model : ONNX file for "offline"
    other : Peer, to compare with the core

    machine is a dict of properties that the figures depend on. Raises InputError, LiveError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before, figures = used_by_all(), []
    with tqdm(bar_format="{desc}: {n} figures, {elapsed}", disable=None, leave=False) as progress:
        say = progress.set_description
        # recordings first: their first call is to be the first of this process
        measurements: dict[str, Callable[[], Iterator[Figure]]] = {
            "offline": lambda: recordings.measure(say, quick, model),
            "core": lambda: core.measure(say, quick),
            **({"peer": partial(peer.measure, say, other, quick)} if other is not None else {}),
            "nodes": lambda: nodes.measure(say, folder, quick),
            "tags": lambda: nodes.measure_tags(say, folder, quick),
            "hall": lambda: nodes.measure_hall(say, folder, quick),
            "graph": lambda: graph.measure(say, folder, quick),
            "replay": lambda: rates.measure(say, folder, quick),
        }
        for part, measurement in measurements.items():
            for figure in measurement() if part in (*parts, "peer") else ():
                figures.append(figure)
                progress.update()
    return _machine() | used_by_others(before), figures


def _machine() -> dict[str, Any]:
    names = [
        line
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    return {
        "cpu": names[0].partition(":")[2].strip() if names else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
