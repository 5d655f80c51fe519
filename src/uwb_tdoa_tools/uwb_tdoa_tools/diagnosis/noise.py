"""What noise the filter should assume beside a calibration: a parameter file for ekf_node."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uwb_tdoa_bias.foundation.files import write_text

if TYPE_CHECKING:
    from pathlib import Path

PARAMETERS = """/**:
  ros__parameters:
    tdoa_std: {:.3f}  # m; measured: as many TDOAs count as independent as there are
"""


def write_parameters(path: Path, tdoa_std: float | None) -> Path | None:
    """Write the parameters of ekf_node, and return the path. tdoa_std : m; where that is None
    nothing is written, and what was there is removed.
    """
    if tdoa_std is None:
        path.unlink(missing_ok=True)
        return None
    write_text(path, PARAMETERS.format(tdoa_std))
    return path
