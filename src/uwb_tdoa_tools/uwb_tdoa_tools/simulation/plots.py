"""Pictures of simulated flights."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.files import write_filled

if TYPE_CHECKING:
    from pathlib import Path

    from uwb_tdoa_bias.foundation.flight import Flight

SUFFIXES = (".png", ".pdf", ".svg")


def check_image(path: Path | None) -> None:
    """Raises InputError for a path that is no image file; None is none."""
    if path is not None and path.suffix.lower() not in SUFFIXES:
        raise InputError(f"plot: {path} is no image file; choose one of {', '.join(SUFFIXES)}.")


def plot(flight: Flight, path: str | Path) -> None:
    """Draw path and anchors from above, height, and the bias and full error of the TDOAs, to an
    image file.
    """
    assert flight.truth is not None
    from matplotlib.figure import Figure  # takes a second to import

    parts, truth, tdoa = flight.extra["tdoa_truth"], flight.truth, flight.tdoa
    figure = Figure(figsize=(12, 7), layout="constrained")
    figure.suptitle(flight.name)
    (above, height), (bias, error) = figure.subplots(2, 2)
    above.plot(truth.p[:, 0], truth.p[:, 1])
    above.plot(*flight.anchors.positions[:, :2].T, "k^")
    feet, foot = np.unique(flight.anchors.positions[:, :2], axis=0, return_inverse=True)
    for k, at in enumerate(feet):
        ids = ", ".join(str(anchor) for anchor in flight.anchors.ids[foot.ravel() == k])
        above.annotate(ids, at, xytext=(4, 4), textcoords="offset points")
    above.margins(0.15)
    above.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    height.plot(truth.t, truth.p[:, 2])
    height.set(xlabel="t, s", ylabel="height, m")
    pairs, count = np.unique(np.column_stack([tdoa.a, tdoa.b]), axis=0, return_counts=True)
    for a, b in pairs[np.sort(np.argsort(-count, kind="stable")[:6])]:
        rows = (tdoa.a == a) & (tdoa.b == b)
        bias.plot(parts["t"][rows], parts["bias"][rows], label=f"{a} - {b}")
    bias.legend(ncols=3, fontsize="small")
    bias.set(xlabel="t, s", ylabel="bias, m")
    total = parts["bias"] + parts["multipath"] + parts["noise"] + parts["outlier"]
    error.plot(parts["t"], total, ".", markersize=1)
    error.set(xlabel="t, s", ylabel="error of TDOA, m", ylim=(-1, 1))
    write_filled(path, partial(figure.savefig, dpi=120))
