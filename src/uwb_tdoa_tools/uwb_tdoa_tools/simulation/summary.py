"""What a simulated flight holds, and what can be simulated, in words and figures."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import numpy as np

from .constellations import CONSTELLATIONS, constellation
from .trajectories import TRAJECTORIES

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.flight import Flight


def summary(flight: Flight) -> dict[str, Any]:
    """Plain values for JSON: name, counts, sizes of the parts of the TDOA errors (m),
    configuration, true parameters.
    """
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
    """All trajectories and constellations with a line on each, text."""
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
