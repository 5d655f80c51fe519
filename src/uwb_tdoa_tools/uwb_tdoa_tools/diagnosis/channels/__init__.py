"""Kinds of measurement: each with its residual, its rows in a fit, and what it may depend on.

One channel, one file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.foundation.sensors import BY_POSE, DIAGNOSED

from .accel import Accel
from .aid import Aid
from .base import Channel, ChannelResidual, ChannelResiduals, Comparison, Rows
from .gyro import Gyro
from .radio import RadioResidual
from .ranging import Ranging
from .tdoa import Tdoa, TdoaResidual

if TYPE_CHECKING:
    from collections.abc import Iterable

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_bias.foundation.flight import Flight

    from ..references import Reference

_ALL: tuple[Channel[Any], ...] = (
    Tdoa(),
    Gyro(),
    Accel(),
    *(Aid(name) if name in BY_POSE else Ranging(name) for name in DIAGNOSED),
)
CHANNELS = {channel.name: channel for channel in _ALL}

__all__ = [
    "CHANNELS",
    "Channel",
    "ChannelResidual",
    "ChannelResiduals",
    "Comparison",
    "RadioResidual",
    "Rows",
    "TdoaResidual",
    "residuals",
    "tdoa_parts",
]


def residuals(flight: Flight, reference: Reference, effects: EffectSet) -> ChannelResiduals:
    """{name of a channel: ChannelResidual} of a Flight that the Reference has prepared, under the
    model `effects`, an EffectSet. Channels that the flight or the reference does not show are not
    among them. Raises InputError where the flight is too short.
    """
    comparison = Comparison.of(flight, reference, effects)
    parts = {name: channel.residual(comparison) for name, channel in CHANNELS.items()}
    return {name: part for name, part in parts.items() if part is not None}


def tdoa_parts(residuals: Iterable[ChannelResiduals]) -> list[TdoaResidual]:
    """The TdoaResiduals among the residuals of flights, of those that have one."""
    return [
        part
        for of_flight in residuals
        for part in of_flight.values()
        if isinstance(part, TdoaResidual)
    ]
