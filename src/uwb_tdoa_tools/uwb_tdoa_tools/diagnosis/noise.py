"""What the filter should assume beside a calibration: a parameter file for ekf_node."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TYPE_CHECKING

from ..checking.tag_delay import TAG_DELAY_STD

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

HEAD = "/**:\n  ros__parameters:\n"
LINES = {
    "tdoa_std": "    tdoa_std: {:.3f}  # m; measured: as many TDOAs count as independent as there are\n",
    "range_offset_std": "    range_offset_std: {:.1f}  # m; every tag has an antenna delay of its own: the filter finds what differs\n",
}


def parameters_of(flights: Iterable[Flight], tdoa_std: float | None) -> dict[str, Any]:
    """{name: value} of parameters of ekf_node: tdoa_std, m, unless it is None, and range_offset_std, m, where one of some Flights has
    ranges."""
    ranged = any(flight.range is not None for flight in flights)
    return ({} if tdoa_std is None else {"tdoa_std": round(tdoa_std, 3)}) | ({"range_offset_std": TAG_DELAY_STD} if ranged else {})


def with_offset(config: FilterConfig) -> FilterConfig:
    """The FilterConfig that looks for an offset of all ranges, if it does not yet."""
    changed: dict[str, Any] = {"range_offset_std": TAG_DELAY_STD}
    return config if config.range_offset_std > 0.0 else replace(config, **changed)  # type: ignore[attr-defined]  # as of SENSORS


def write_parameters(path: Path, parameters: Mapping[str, float]) -> Path | None:
    """Write what `parameters_of` gives, and return the path; where that is nothing, nothing is written, and what was there is removed."""
    if not parameters:
        path.unlink(missing_ok=True)
        return None
    path.write_text(HEAD + "".join(LINES[name].format(value) for name, value in parameters.items()))
    return path
