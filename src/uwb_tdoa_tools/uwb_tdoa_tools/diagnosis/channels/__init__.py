# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Channels, kinds of measurement: their residuals, rows of a fit, covariates and health."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import BY_POSE, DIAGNOSED
from uwb_tdoa_bias.effects import EffectSet

from ...scoring.metrics import Score
from ..references import Reference
from .base import Channel, ChannelResidual, ChannelResiduals, Comparison, Figures, Rows
from .inertial import Accel, Gyro
from .radio import RadioResidual, Ranging, Tdoa, TdoaResidual
from .sensor import Sensor

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
    "health",
    "of_comparison",
    "residuals",
    "tdoa_parts",
]


def residuals(flight: Flight, reference: Reference, effects: EffectSet) -> ChannelResiduals:
    """Return {name of a channel: ChannelResidual} of a prepared Flight under a model of effects.

    Channels that the flight or the reference lacks are left out. Raises InputError if the flight is
    too short.
    """
    return of_comparison(Comparison.of(flight, reference, effects))


def of_comparison(comparison: Comparison) -> ChannelResiduals:
    """Return {name of a channel: ChannelResidual} of a Comparison."""
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


def health(residuals: Sequence[ChannelResiduals], scores: Sequence[Score] = ()) -> Figures:
    """Return figures of residuals and of the filter, each a list of dicts.

    The keys are "pairs", "anchors", "axes" and "filter".

    residuals : [{channel: ChannelResidual}], one per flight
    scores : Score of each flight, for NIS (expected 1) and NEES (expected 3)
    """
    out: Figures = {key: [] for key in ("pairs", "anchors", "axes")}
    for name, channel in CHANNELS.items():
        parts = [flight[name] for flight in residuals if name in flight]
        for key, items in channel.health(parts).items() if parts else ():
            out[key] += items
    of_filter = [
        {
            "flight": score.name,
            "nis_mean": float(score.nis.mean()),
            "nis_below_3.84": float(np.mean(score.nis < 3.84)),  # 95 % if the filter is consistent
            "nees_mean": float(np.mean(score.nees)),
            "nees_below_7.81": float(np.mean(score.nees < 7.81)),
        }
        for score in scores
    ]
    return {**out, "filter": of_filter}
