"""What positions and delays of anchors do not explain: regions, or times, in which something makes
one of them late.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from uwb_tdoa_bias.effects import EffectSet

from ..diagnosis.attribution import attribute
from ..diagnosis.references import Nothing

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from uwb_tdoa_bias.effects import Effect
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ..diagnosis.self_calibration import SelfCalibration

LEAST = 0.2  # m by which an anchor must be late there; antennas alone make up to that


def with_blocked(
    result: SelfCalibration,
    flights: Sequence[Flight],
    config: FilterConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> SelfCalibration:
    """The SelfCalibration of Flights with what blocks its anchors, looked for in TDOAs beside all
    that was found.
    """
    flights = [flight for flight in flights if len(flight.tdoa)]
    if not flights:
        return result
    reference = Nothing(config)
    moved = [reference.prepare(replace(flight, anchors=result.surveyed)) for flight in flights]
    base = EffectSet((*result.base.effects, result.found(result.shifts)[1]))
    effects = attribute(
        moved, reference, base, ("nlos",), undeclared=False, progress=progress
    ).effects
    return replace(
        result, blocked=tuple(sentence for effect in effects for sentence in large(effect).advice())
    )


def large(effect: Effect) -> Effect:
    """The effect nlos with those of its anchors alone that are late by LEAST."""
    late = {
        key.partition(".")[0]
        for key, value in effect.values.items()
        if key.endswith(".delay") and value >= LEAST
    }
    values, std = (
        {key: some[key] for key in some if key.partition(".")[0] in late}
        for some in (effect.values, effect.std)
    )
    return replace(effect, values=values, std=std)
