"""All parts of the benchmark in one run, and the machine they ran on."""

import os
from pathlib import Path
import platform

import numpy as np
from tqdm import tqdm

from . import core, graph, nodes, peer, rates, recordings
from .usage import used_by_all, used_by_others

PARTS = ("core", "offline", "nodes", "tags", "replay", "graph")


def measure(parts, folder, quick=False, model=None, other=None):
    """Measure some of PARTS. Returns (machine, list of Figure).

    folder : for bags and the output of the nodes; quick : fewer repetitions and cases; model : ONNX file for "offline",
    default the one shipped; other : Peer, to measure beside the core. machine : what the figures depend on, dict. Raises
    InputError, LiveError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before, figures = used_by_all(), []
    with tqdm(bar_format="{desc}: {n} figures, {elapsed}", disable=None, leave=False) as progress:
        say = progress.set_description
        measurements = {  # recordings first: their first call is to be the first of this process
            "offline": lambda: recordings.measure(say, quick, model),
            "core": lambda: core.measure(say, quick),
            "peer": lambda: peer.measure(say, other, quick),
            "nodes": lambda: nodes.measure(say, folder, quick),
            "tags": lambda: nodes.measure_tags(say, folder, quick),
            "graph": lambda: graph.measure(say, folder, quick),
            "replay": lambda: rates.measure(say, folder, quick),
        }
        for part, measurement in measurements.items():
            for figure in measurement() if part in (*parts, "peer" if other else None) else ():
                figures.append(figure)
                progress.update()
    return _machine() | used_by_others(before), figures


def _machine():
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "cpu": names[0].partition(":")[2].strip() if names else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
