# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a simulated flight holds, and what can be simulated: figures and words."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.flight import Flight

from .config import CONSTELLATIONS, constellation
from .vehicles import TRAJECTORIES


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
