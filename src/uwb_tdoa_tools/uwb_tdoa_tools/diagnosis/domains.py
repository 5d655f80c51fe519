"""Domains of effects: where the fitted flights observed them.

The domain of an effect holds the range of its covariates. The domain of a function without a name
also holds the range of the places: the function may depend on the place in a way that one path does
not show.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import RADIO, SmoothTerm

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from uwb_tdoa_bias.effects import Effect

    from .channels import ChannelResiduals


PLACE = ("x", "y", "height")
# m, half of the least range of a place; estimates of a level path have errors of this size
REACH = 0.3
# Share of the samples beyond each end of a range. Take-off and landing pass many values once.
BEYOND = 0.02


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
        on_radio = isinstance(effect, SmoothTerm) and effect.channel in RADIO
        for covariate in dict.fromkeys((*effect.covariates, *(PLACE if on_radio else ()))):
            asked = [
                self._range(number, channel, covariate)
                for number in numbers
                for channel in effect.channels
            ]
            ranges = [one for one in asked if one is not None]
            if ranges:
                low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
                grow = max(REACH - 0.5 * (high - low), 0.0) if covariate in PLACE else 0.0
                out[covariate] = low - grow, high + grow
        return out

    def _range(self, number: int, channel: str, covariate: str) -> tuple[float, float] | None:
        """Return the range of a covariate in a channel of a flight; None if unknown."""
        key = number, channel, covariate
        if key not in self._ranges:
            part = self._residuals[number].get(channel)
            beyond = 0.0 if covariate == "time" else BEYOND
            self._ranges[key] = None if part is None else _range(part.covariate(covariate), beyond)
        return self._ranges[key]


def _range(values: np.ndarray | None, beyond: float) -> tuple[float, float] | None:
    """Return the values with a share `beyond` of all values below and above them."""
    known = np.empty(0) if values is None else values[np.isfinite(values)]
    if not len(known):
        return None
    low, high = np.quantile(known, [beyond, 1.0 - beyond])
    return float(f"{low:.6g}"), float(f"{high:.6g}")
