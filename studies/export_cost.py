# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""export-cost: time per TDOA of an exported file and of compiled effects, in one thread."""

import time

from exported_states import anchors_of, exportable, network_of, rows_of, states
import onnx

from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.exporting.onnx_file import write_onnx

ANCHORS = anchors_of()
FOUND = "anchor_delay", "anchor_position", "tag_lever_arm"
TEN = (
    *FOUND,
    "pair_offset",
    "range_scale",
    "range_bias",
    "received_power_bias",
    "antenna_pattern",
    "anchor_clock_drift",
    "nlos",
)
MAPS = "range anchor", "elevation_in_tag anchor"
SETS = {  # name: (effects, whether with the network)
    "three effects": (FOUND, False),
    "ten effects": (TEN, False),
    "two functions for each anchor": (MAPS, False),
    "network of 14 inputs": ((), True),
    "three effects and the network": (FOUND, True),
}
BATCHES = 1, 4, 30  # TDOAs of one call
RATE = 400  # TDOAs a second of a tag


def add_options(add):
    """add : add_argument of a parser."""
    add("--calls", metavar="N", type=int, default=400, help="of each kind (default: %(default)s)")


def run(args):
    """Print the table."""
    head = " | ".join(f"{kind}, {n} a call" for n in BATCHES for kind in ("ONNX", "compiled"))
    print(f"| correction | operators | {head} |")
    print("|---|---:|" + "---:|" * 2 * len(BATCHES))
    with temporary_folder() as folder:
        for name, (names, learned) in SETS.items():
            cells = costs(folder, names, learned, args.calls)
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


def costs(folder, names, learned, calls):
    """Cells of a row: number of operators, then us of processor time for a TDOA."""
    known, path = exportable(ANCHORS), folder / "bias.onnx"
    effects = EffectSet(tuple(known[name] for name in names))
    network = network_of(folder) if learned else None
    write_onnx(path, ANCHORS, effects, network)
    operators = len(onnx.load(path).graph.node)
    both = Corrector(ANCHORS, None, load_network(path)), Corrector(ANCHORS, effects, network)
    times = [microseconds(one, n, calls) for n in BATCHES for one in both]
    return [str(operators), *(f"{one:.1f}" for one in times)]


def microseconds(corrector, n, calls):
    """us of processor time for a TDOA, n in a call, at random states."""
    samples = states(ANCHORS, 64 * n)
    batches = [rows_of(samples, slice(first, first + n)) for first in range(0, 64 * n, n)]
    for batch in batches[:4]:
        corrector.prediction(batch)
    began = time.process_time()
    for call in range(calls):
        corrector.prediction(batches[call % len(batches)])
    return 1e6 * (time.process_time() - began) / (calls * n)
