# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""moved-anchors-live: recordings of the study moved-anchors, played to bias_node and ekf_node.

Both nodes run as processes and get the calibration of last week, and so does the monitor offline.
The table compares the anchors that `ekf_node` names with those that the monitor names.
"""

from dataclasses import replace
import json
from pathlib import Path
import tempfile

from studies.moved_anchors import KINDS, TAPE, _about, _ids, live, recorded
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.parallel import whole_number

RATE = 4.0  # times as fast as recorded, at most: the replay waits for the nodes


def add_options(add):
    """Add the options of the study. add : add_argument of a parser."""
    add("--draws", type=whole_number, default=1, metavar="N", help="of each kind (default 1)")
    words = "of the first draw (default 1000; limits were set on draws below 100)"
    add("--first", type=int, default=1000, metavar="SEED", help=words)
    add("--only", nargs="+", choices=KINDS, default=KINDS, metavar="KIND", help="(default: all)")
    add("--json", metavar="FILE", type=OutputFile, help="write what was named of each")


def run(args):
    """Print a row for each recording, and in how many the node and the monitor agree."""
    print("| change | draw | changed | the monitor names | ekf_node names | lost TDOAs |")
    print("|---|---:|---|---|---|---:|")
    rows = []
    for kind in args.only:
        for seed in range(args.first, args.first + args.draws):
            rows.append(named(kind, seed))
            print(line(rows[-1]), flush=True)
            if args.json:
                write_text(args.json, json.dumps(rows, indent=1))
    alike = sum(row["offline"] == row["node"] for row in rows)
    print(
        f"\nIn {alike} of {len(rows)} recordings the node names the anchors that the monitor names."
    )


def line(row):
    """Return a row of the table."""
    names = [", ".join(map(str, row[key])) or "none" for key in ("ids", "offline", "node")]
    return f"| {row['kind']} | {row['seed']} | {' | '.join(names)} | {row['lost']} |"


def named(kind, seed):
    """Return the ids that were changed, and those that the monitor and ekf_node name at the end."""
    from uwb_tdoa_tools.live.run import accounts, run_live

    week, _, flight, ids, _, _ = recorded(kind, seed)
    last = self_calibrate([replace(week, truth=None)], Tape(std=TAPE))
    flight = replace(flight, anchors=last.anchors, truth=None)
    offline = _ids(live(flight, FlightEstimator(None, last.effects)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        last.effects.to_yaml(folder / "effects.yaml")
        write_bag(flight, folder / "flight.bag")
        given = {"effects_file": str(folder / "effects.yaml")}
        said = run_live(folder / "flight.bag", folder, RATE, given, given, lambda text: None)
    return {
        "kind": kind,
        "seed": seed,
        "ids": ids,
        "offline": offline,
        "node": ids_of(said.ekf["changed since the start"]),
        "said": said.ekf["changed since the start"],
        "lost": accounts(said.bias, said.ekf, flight)["lost"],
    }


def ids_of(text):
    """Return the ids of changed anchors in the diagnostics of ekf_node, "changed since the start"."""
    beginnings = map(_about, text.split("; "))
    return _ids(filter(None, beginnings))
