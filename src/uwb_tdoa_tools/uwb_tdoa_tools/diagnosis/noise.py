"""Write a parameter file for ekf_node with the measured noise."""

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
    """Write parameters of ekf_node, and return the path, or None.

    Parameters of the filter that differ from the default are written too.

    path : of the file; tdoa_std : m, None removes the file
    config : FilterConfig with which tdoa_std was measured
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
