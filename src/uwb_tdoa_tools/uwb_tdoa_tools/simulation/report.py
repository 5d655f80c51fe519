# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a simulated flight holds, and what can be simulated: figures, words, a picture."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_picture
from uwb_tdoa_bias.common.flight import Flight

from .config import CONSTELLATIONS, constellation
from .vehicles import TRAJECTORIES

SUFFIXES = (".png", ".pdf", ".svg")


def summary(flight: Flight) -> dict[str, Any]:
    """Return plain values for JSON: counts, sizes of the TDOA errors (m), config, true parameters."""
    assert flight.imu is not None and flight.truth is not None
    parts = flight.extra["tdoa_truth"]
    return {
        "flight": flight.name,
        "tdoas": len(flight.tdoa),
        "imu_samples": len(flight.imu),
        "poses": len(flight.truth),
        "outliers": int(np.count_nonzero(parts["outlier"])),
        **{f"{name}_std": float(np.std(parts[name])) for name in ("bias", "multipath", "noise")},
        "config": flight.meta["config"],
        "parameters": flight.meta["parameters"],
    }


def catalogue() -> str:
    """List all trajectories and constellations with a line on each, as text."""
    lines = ["trajectories:"]
    for name, family in TRAJECTORIES.items():
        described = (inspect.getdoc(family) or name).splitlines()[0]
        text = "Stay at the place, the yaw rotating." if name == "spin" else described
        lines.append(f"  {name:<14} {text}")
    lines.append("constellations:")
    for name in CONSTELLATIONS:
        anchors = constellation(name)
        x, y, z = np.ptp(anchors.positions, axis=0)
        lines.append(f"  {name:<14} {len(anchors)} anchors, {x:.1f} x {y:.1f} x {z:.1f} m apart")
    lines.append("  random-SEED[-COUNT]: COUNT anchors (4 - 64, default 8) in a seeded room")
    return "\n".join(lines)


def check_image(path: Path | None) -> None:
    """Raise InputError for a path that is not an image file; None is accepted."""
    if path is not None and path.suffix.lower() not in SUFFIXES:
        raise InputError(f"plot: {path} is no image file; choose one of {', '.join(SUFFIXES)}.")


def plot(flight: Flight, path: str | Path) -> None:
    """Draw path and anchors from above, height, bias and error of the TDOAs, to an image file."""
    from matplotlib.figure import Figure  # takes a second to import

    from ..scoring.plots import labels

    parts, truth, tdoa = flight.extra["tdoa_truth"], flight.known_truth, flight.tdoa
    figure = Figure(figsize=(12, 7), layout="constrained")
    figure.suptitle(flight.name)
    (above, height), (bias, error) = figure.subplots(2, 2)
    above.plot(truth.p[:, 0], truth.p[:, 1])
    above.plot(*flight.anchors.positions[:, :2].T, "k^")
    for text, at in labels(flight.anchors.ids.tolist(), flight.anchors.positions[:, :2]):
        above.annotate(text, (at[0], at[1]), xytext=(4, 4), textcoords="offset points")
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
    write_picture(path, figure, 120)
