"""What a diagnosis says."""

from dataclasses import dataclass

from uwb_tdoa_bias.effects import Effect, EffectSet


LEAST_WORTH = 0.005  # m that a finding may be worth, to come before one that is surer


@dataclass(frozen=True, eq=False)
class Finding:
    """An effect that was found.

    effect : Effect with values and std; channel : where it shows most; evidence : {figure: number}; explained : share of
    the channel's variance on held-out rows; alternatives : (Alternative, ...); candidates : the (Candidate, ...) it was, ()
    for what a detector found in what is left; added : is in the model that is written; worth : m by which the filter's 3D
    RMSE is larger without it, None if nobody tried; together_with : covariates of the same candidate; shares : (Share, ...) of
    `over_flights`, how much of it each flight shows; flight : name of the only flight that shows it, None for what was fitted to
    all; on_floor : was found near the floor, beside all that was found in the air.
    """

    effect: Effect
    channel: str
    evidence: dict
    explained: float
    alternatives: tuple = ()
    candidates: tuple = ()
    added: bool = True
    worth: float | None = None
    together_with: tuple = ()
    shares: tuple = ()
    flight: str | None = None
    on_floor: bool = False

    @property
    def declared(self):
        """Whether it is in the catalogue, not a function without a name."""
        return not self.effect.settings

    @property
    def prominence(self):
        """How sure and how large it is, to put findings in order: what it gains in likelihood, times what it is worth."""
        return self.evidence.get("criterion", 1.0) * (max(self.worth or 0.0, 0.0) + LEAST_WORTH)

    @property
    def key(self):
        """Hashable: equal for findings of one effect."""
        return (self.effect.name if self.declared else self.effect.identity), self.flight


@dataclass(frozen=True)
class Refused:
    """Something that was looked at and is not in the model: what, and why not."""

    what: str
    why: str


def usable(effects):
    """EffectSet of those of some Effects that nodes can take out."""
    return EffectSet(tuple(effect for effect in effects if effect.usable))
