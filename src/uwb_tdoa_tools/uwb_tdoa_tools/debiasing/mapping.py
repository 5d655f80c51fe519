"""A bias map from flights and from places where a tag stood still."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.debias import fit

from .parts import LEAST, part_of, static_parts

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from uwb_tdoa_ekf.debias import BiasMap
    from .evaluation import Estimator, Scored


def fit_map(
    flown: Iterable[Scored], static: Sequence[str | Path], estimator: Estimator, step: float = 0.35,
    planar: bool = False, interpolator: str = "thin_plate",
) -> BiasMap:  # fmt: skip
    """BiasMap of flights, as an Estimator gave them, and of files of a tag that stood still. Raises InputError.

    static : paths, see `static_parts`; step : m; planar, interpolator : see `uwb_tdoa_ekf.debias.fit`.
    """
    parts = [part for path in static for part in static_parts(path, estimator, planar)]
    flown = list(flown)
    parts += [part_of(score, odometry) for _, score, odometry in flown]
    frames = {flight.anchors.frame for flight, _, _ in flown} or {"map"}
    if len(frames) > 1:
        raise InputError(
            f"FLIGHT: the flights are in different frames, {', '.join(sorted(frames))}; map them one by one."
        )
    source = ", ".join([flight.name for flight, _, _ in flown] + [Path(path).name for path in static])
    return fit(parts, step, LEAST if flown else 1, planar, interpolator, frames.pop(), source)
