"""Kinds of measurement: each with its residual, its rows in a fit, and what it may depend on. One channel, one file."""

from uwb_tdoa_bias.foundation.sensors import DIAGNOSED

from .accel import Accel
from .aid import Aid
from .base import Channel, ChannelResidual, Comparison, Rows
from .gyro import Gyro
from .tdoa import Tdoa

CHANNELS = {channel.name: channel for channel in (Tdoa(), Gyro(), Accel(), *map(Aid, DIAGNOSED))}

__all__ = ["CHANNELS", "Channel", "ChannelResidual", "Comparison", "Rows", "residuals"]


def residuals(flight, reference, effects):
    """{name of a channel: ChannelResidual} of a Flight that the Reference has prepared, under the model `effects`, an
    EffectSet. Channels that the flight or the reference does not show are not among them. Raises InputError where the
    flight is too short."""
    comparison = Comparison.of(flight, reference, effects)
    parts = {name: channel.residual(comparison) for name, channel in CHANNELS.items()}
    return {name: part for name, part in parts.items() if part is not None}
