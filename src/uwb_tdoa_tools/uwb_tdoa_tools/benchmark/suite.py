"""All parts of the benchmark in one run, and the machine they ran on."""

from __future__ import annotations

from functools import partial
import os
from pathlib import Path
import platform
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from . import core, graph, nodes, peer, rates, recordings
from .usage import used_by_all, used_by_others

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from .figures import Figure

PARTS = ("core", "offline", "nodes", "tags", "hall", "replay", "graph")


def measure(
    parts: Sequence[str],
    folder: Path,
    quick: bool = False,
    model: str | Path | None = None,
    other: peer.Peer | None = None,
) -> tuple[dict[str, Any], list[Figure]]:
    """Measure some of PARTS. Returns (machine, list of Figure).

    folder : for bags and the output of the nodes; quick : fewer repetitions and cases; model : ONNX
        file for "offline"; other : Peer, to measure beside the core. machine : what the figures
    depend on, dict. Raises InputError, LiveError.
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
