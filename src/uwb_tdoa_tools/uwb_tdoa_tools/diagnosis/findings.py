"""What a diagnosis says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from uwb_tdoa_bias.effects import Effect, EffectSet, SmoothTerm

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable

    from .over_flights import Share
    from .regression.confounding import Alternative
    from .regression.terms import Candidate


LEAST_WORTH = 0.005  # m that a finding may be worth, to come before one that is surer


@dataclass(frozen=True, eq=False)
class EffectFinding:
    """An effect that was found.

    effect : Effect with values and std; channel : where it shows most; evidence : {figure: number};
        explained : share of
    the channel's variance on held-out rows; alternatives : (Alternative, ...); candidates : the
    (Candidate, ...) it was, () for what a detector found in what is left; added : is in the model
    that is written; worth : m by which the filter's 3D RMSE is larger without it, None if nobody
    tried; together_with : covariates of the same candidate; shares : (Share, ...) of
    `over_flights`, how much of it each flight shows; flight : name of the only flight that shows
    it, None for what was fitted to all; on_floor : was found near the floor, beside all that was
    found in the air.
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
    on_floor: bool = False

    @property
    def declared(self) -> bool:
        """Whether it is in the catalogue, not a function without a name."""
        return self.function is None

    @property
    def function(self) -> SmoothTerm | None:
        """Its Effect, if that is a function without a name."""
        return self.effect if isinstance(self.effect, SmoothTerm) else None

    @property
    def prominence(self) -> float:
        """How sure and how large it is, to put findings in order: what it gains in likelihood,
        times what it is worth.
        """
        return self.evidence.get("criterion", 1.0) * (max(self.worth or 0.0, 0.0) + LEAST_WORTH)

    @property
    def key(self) -> tuple[Hashable, str | None]:
        """Hashable: equal for findings of one effect."""
        return (self.effect.name if self.declared else self.effect.merge_key), self.flight


@dataclass(frozen=True)
class Refused:
    """Something that was looked at and is not in the model: what, and why not."""

    what: str
    why: str


def usable(effects: Iterable[Effect]) -> EffectSet:
    """EffectSet of those of some Effects that nodes can take out."""
    return EffectSet(tuple(effect for effect in effects if effect.usable))
