# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a parameter file for ekf_node with the measured noise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
import json
from pathlib import Path

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig

DECIMALS = 3  # of tdoa_std, m, in the file
HEAD = "/**:\n  ros__parameters:\n"
NO_IMU = "no recording has inertial samples; with an IMU on the tag, delete this line"
MEASURED = "m; measured: as many TDOAs count as independent as there are"


def write_parameters(
    path: Path, tdoa_std: float | None, config: FilterConfig | None = None, has_imu: bool = True
) -> Path:
    """Write parameters of ekf_node, and return the path.

    The file holds tdoa_std, and every parameter that differs from the default, so that it alone makes the
    nodes and `evaluate` run the filter that was judged.

    path : of the file; tdoa_std : m, measured, or None
    config : FilterConfig with which tdoa_std was measured
    has_imu : whether a recording has inertial samples; without, the file sets use_imu to false
    """
    default = FilterConfig()
    given = {one.name: getattr(config or default, one.name) for one in fields(FilterConfig)}
    lines = {
        name: f"{json.dumps(value)}  # as given"
        for name, value in given.items()
        if value != getattr(default, name)
    }
    if tdoa_std is not None:
        lines["tdoa_std"] = f"{tdoa_std:.{DECIMALS}f}  # {MEASURED}"
    lines.setdefault("tdoa_std", f"{default.tdoa_std}  # m; the default")
    if not has_imu:
        lines["use_imu"] = f"false  # {NO_IMU}"
    write_text(path, HEAD + "".join(f"    {name}: {line}\n" for name, line in lines.items()))
    return path


def has_imu(flights: Iterable[Flight]) -> bool:
    """Return whether a recording has inertial samples."""
    return any(flight.imu is not None and len(flight.imu) for flight in flights)
