# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Channels, kinds of measurement: their residuals, rows of a fit, covariates and health."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.common.sensors import BY_POSE, DIAGNOSED

from .base import Channel, ChannelResidual, ChannelResiduals, Comparison, Rows
from .inertial import Accel, Gyro
from .radio import RadioResidual, Ranging, Tdoa, TdoaResidual
from .sensor import Sensor

if TYPE_CHECKING:
    from collections.abc import Iterable

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.effects import EffectSet

    from ..references import Reference

_ALL: tuple[Channel[Any], ...] = (
    Tdoa(),
    Gyro(),
    Accel(),
    *(Sensor(name) if name in BY_POSE else Ranging(name) for name in DIAGNOSED),
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
    """Return {name of a channel: ChannelResidual} of a prepared Flight under a model of effects.

    Channels that the flight or the reference lacks are left out. Raises InputError if the flight is
    too short.
    """
    comparison = Comparison.of(flight, reference, effects)
    parts = {name: channel.residual(comparison) for name, channel in CHANNELS.items()}
    return {name: part for name, part in parts.items() if part is not None}


def tdoa_parts(residuals: Iterable[ChannelResiduals]) -> list[TdoaResidual]:
    """Return the TdoaResiduals among the residuals of flights."""
    return [
        part
        for of_flight in residuals
        for part in of_flight.values()
        if isinstance(part, TdoaResidual)
    ]
