"""A bias map from flights and from places where a tag stood still."""

from dataclasses import dataclass
from pathlib import Path

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.debias import fit

from ..readers import read_flight
from .judge import fly
from .parts import LEAST, part_of, static_parts


@dataclass(frozen=True)
class Estimator:
    """What positions are estimated with; estimator((path, survey)) is what `judge.fly` gives. Can be pickled.

    config : FilterConfig; effects : EffectSet or None, of the TDOAs before the filter; namespace : of topics in bags.
    """

    config: FilterConfig | None = None
    effects: EffectSet | None = None
    namespace: str = ""

    def __call__(self, recording):
        return fly(read_flight(*recording, self.namespace), self.config, self.effects)


def fit_map(flown, static, estimator, survey=None, step=0.35, planar=False, interpolator="thin_plate"):
    """BiasMap of flights, as an Estimator gave them, and of files of a tag that stood still. Raises InputError.

    static : paths, see `static_parts`; step : m; planar, interpolator : see `uwb_tdoa_ekf.debias.fit`.
    """
    config, effects = estimator.config, estimator.effects
    parts = [part for path in static for part in static_parts(path, survey, config, effects, planar)]
    flown = list(flown)
    parts += [part_of(score, odometry) for _, score, odometry in flown]
    frames = {flight.anchors.frame for flight, _, _ in flown} or {"map"}
    if len(frames) > 1:
        raise InputError(
            f"FLIGHT: the flights are in different frames, {', '.join(sorted(frames))}; map them one by one."
        )
    source = ", ".join([flight.name for flight, _, _ in flown] + [Path(path).name for path in static])
    return fit(parts, step, LEAST if flown else 1, planar, interpolator, frames.pop(), source)
