"""What noise the filter should assume beside a calibration: a parameter file for ekf_node."""

from __future__ import annotations

from dataclasses import fields
import json
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_ekf.core.config import FilterConfig

if TYPE_CHECKING:
    from pathlib import Path

PARAMETERS = """/**:
  ros__parameters:
    tdoa_std: {:.3f}  # m; measured: as many TDOAs count as independent as there are
"""


def write_parameters(
    path: Path, tdoa_std: float | None, config: FilterConfig | None = None
) -> Path | None:
    """Write the parameters of ekf_node, and return the path. tdoa_std : m; where that is None
    nothing is written, and what was there is removed; config : of the filter that it was measured
    with, whose parameters that are not the default are written too.
    """
    if tdoa_std is None:
        path.unlink(missing_ok=True)
        return None
    default = FilterConfig()
    given = {one.name: getattr(config or default, one.name) for one in fields(FilterConfig)}
    given.pop("tdoa_std")
    lines = [
        f"    {name}: {json.dumps(value)}  # as given\n"
        for name, value in given.items()
        if value != getattr(default, name)
    ]
    write_text(path, "".join([PARAMETERS.format(tdoa_std), *lines]))
    return path
