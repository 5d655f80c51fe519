# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Findings of a diagnosis."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field

from uwb_tdoa_bias.effects import Effect, EffectSet, SmoothTerm

from .over_flights import Share
from .regression.confounding import Alternative, Level
from .regression.terms import Candidate

# m, added to the worth of a finding, so that a certain finding precedes an uncertain worthless one
LEAST_WORTH = 0.005


@dataclass(frozen=True, eq=False)
class EffectFinding:
    """An effect that the diagnosis found.

    effect : Effect with values and standard deviations; channel : the channel that shows it most
    evidence : {figure: number}; explained : explained share of the variance of hold-out rows of the
        channel
    alternatives : (Alternative, ...); candidates : its (Candidate, ...), () for a detector's
        finding
    added : whether the written model contains it
    worth : m, increase of the filter's 3D RMSE without it; None if not tried
    together_with : covariates of the same candidate; shares : (Share, ...), amount in each flight
    flight : name of the only flight with it; None for a fit to all flights
    levels : {anchor: Level}, of the first function without a name of each anchor
    on_floor : whether it was found near the floor, beyond effects in the air
    """

    effect: Effect
    channel: str
    evidence: dict[str, float]
    explained: float
    alternatives: tuple[Alternative, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    added: bool = True
    worth: float | None = None
    together_with: tuple[str, ...] = ()
    shares: tuple[Share, ...] = ()
    flight: str | None = None
    levels: dict[str, Level] = field(default_factory=dict)
    on_floor: bool = False

    @property
    def declared(self) -> bool:
        """Return whether it is in the catalogue, not a function without a name."""
        return self.function is None

    @property
    def function(self) -> SmoothTerm | None:
        """Return its Effect if that is a function without a name, else None."""
        return self.effect if isinstance(self.effect, SmoothTerm) else None

    @property
    def prominence(self) -> float:
        """Return the key that orders findings: gain in likelihood times worth."""
        return self.evidence.get("criterion", 1.0) * (max(self.worth or 0.0, 0.0) + LEAST_WORTH)

    @property
    def key(self) -> tuple[Hashable, str | None]:
        """Return a key that is equal for findings of one effect."""
        return (self.effect.name if self.declared else self.effect.merge_key), self.flight


@dataclass(frozen=True)
class Refused:
    """A candidate that is not in the model, and the reason."""

    what: str
    why: str


def prefixes_of(term: SmoothTerm) -> list[str]:
    """Return the prefixes of the parameters of each curve: "" or an anchor or pair with a dot."""
    return sorted({key.rpartition("c")[0] for key in term.values})


def usable(effects: Iterable[Effect]) -> EffectSet:
    """Return the EffectSet of the Effects that nodes can correct."""
    return EffectSet(tuple(effect for effect in effects if effect.usable))
