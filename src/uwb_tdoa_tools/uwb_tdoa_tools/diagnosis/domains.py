# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Domains of effects: the ranges of their covariates in the fitted flights."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from uwb_tdoa_bias.effects import Effect

    from .channels import ChannelResiduals


# m, smallest width of a domain of heights of a function of something else: errors of the place
# change over such a distance
HEIGHTS = 1.0


class Seen:
    """Ranges of covariates in the residuals of some flights, computed on demand."""

    def __init__(self, residuals: Sequence[ChannelResiduals]) -> None:
        """Take [{channel: ChannelResidual}], one dict per flight."""
        self._residuals = residuals
        self._ranges: dict[tuple[int, str, str], tuple[float, float] | None] = {}

    def limited(
        self, effects: Iterable[Effect], flights: Sequence[int] | None = None
    ) -> list[Effect]:
        """Return Effects with their domain: the range of each covariate in some flights.

        Effects without covariates, and effects with a domain, stay unchanged.

        flights : their numbers; all by default
        """
        numbers = range(len(self._residuals)) if flights is None else flights
        return [
            effect if effect.domain else replace(effect, domain=self._domain(effect, numbers))
            for effect in effects
        ]

    def _domain(self, effect: Effect, numbers: Sequence[int]) -> dict[str, tuple[float, float]]:
        out = {}
        for covariate in effect.covariates:
            asked = [
                self._range(number, channel, covariate)
                for number in numbers
                for channel in effect.channels
            ]
            ranges = [one for one in asked if one is not None]
            if not ranges:
                continue
            low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
            if covariate == "height" and effect.covariates[0] != covariate:
                more = max(0.5 * (HEIGHTS - (high - low)), 0.0)
                low, high = float(f"{low - more:.6g}"), float(f"{high + more:.6g}")
            out[covariate] = low, high
        return out

    def _range(self, number: int, channel: str, covariate: str) -> tuple[float, float] | None:
        """Return (least, largest) of a covariate in a channel of a flight; None if unknown."""
        key = number, channel, covariate
        if key not in self._ranges:
            part = self._residuals[number].get(channel)
            self._ranges[key] = None if part is None else _range(part.covariate(covariate))
        return self._ranges[key]


def _range(values: np.ndarray | None) -> tuple[float, float] | None:
    known = np.empty(0) if values is None else values[np.isfinite(values)]
    return (float(f"{known.min():.6g}"), float(f"{known.max():.6g}")) if len(known) else None
