# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""soak: run both nodes for hours at 1 kHz IMU and 400 Hz TDOAs.

The study prints their memory, and checks that their counters contain all published messages.
"""

import math
from pathlib import Path
import tempfile
import time

from uwb_tdoa_tools.live.session import DiagnosticsListener, wait

from . import nodes
from .flights import make_flight
from .source import Source
from .usage import memory

# which ends where it begins
LAP = dict(trajectory="circle", radius=1.5, speed=1.0, start_in_air=True)
LAPS = 6  # of a flight, which is played again and again
EVERY = 60.0  # s from one figure of the memory to the next


def soak(minutes, starts, folder):
    """Prints the memory of each process, MB, and what became of the messages. starts : of
    nodes.pairs or nodes.pool.
    """
    flight = make_flight(LAPS * 2.0 * math.pi * LAP["radius"] / LAP["speed"], **LAP)
    rounds = math.ceil(60.0 * minutes / (flight.imu.t[-1] - flight.imu.t[0]))
    nodes.start(folder)  # whoever compiles the filter keeps the memory that took
    with nodes.surroundings(folder) as (node, processes):
        diagnostics, source, began = DiagnosticsListener(node), Source(node, [""]), time.monotonic()
        for title, (name, arguments) in starts.items():
            nodes._start(processes, node, title, name, arguments)
        matched = lambda: nodes._matched(node, source, diagnostics, nodes.NODES)  # noqa: E731
        wait(nodes.MATCH_LIMIT, "all to find each other", processes, node, matched)

        def say():
            used = "  ".join(
                f"{title} {1e-6 * memory(processes.pid(title)):.1f} MB" for title in starts
            )
            print(f"{(time.monotonic() - began) / 60.0:6.1f} min  {used}", flush=True)
            source.received[0].clear()  # the odometry, which is not used

        source.play(flight, EVERY, say, rounds)
        diagnostics.forget()
        settled = lambda: source.take() or diagnostics.is_settled()  # noqa: E731
        wait(nodes.SETTLE_LIMIT, "the nodes to finish", processes, node, settled)
        say()
        print(
            f"published: {rounds * len(flight.tdoa)} TDOAs, {rounds * len(flight.imu)} IMU samples"
        )
        for name in nodes.NODES:
            print(name, diagnostics.newest(name))


def add_options(add):
    """The options of the study."""
    add("--minutes", type=float, default=60.0, help="how long (default %(default)s)")
    add("--together", action="store_true", help="in one localization_node")


def run(args):
    """Play, and print the memory."""
    starts = nodes.pool([""], 1) if args.together else nodes.pairs([""])
    with tempfile.TemporaryDirectory() as folder:
        soak(args.minutes, starts, Path(folder))
