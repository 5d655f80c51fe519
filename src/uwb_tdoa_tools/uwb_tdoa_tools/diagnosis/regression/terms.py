"""What a fit gives values: parameters of effects."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from uwb_tdoa_bias.effects import Effect


class Column(NamedTuple):
    """A parameter of an effect, as a regressor. effect : identity of the Effect; key : name of the parameter; typical :
    plausible size, in its unit: standard deviation of its prior."""

    effect: tuple
    key: str
    typical: float


@dataclass(frozen=True, eq=False)
class Term:
    """An Effect and those of its parameters, `keys`, that a fit gives values. Values that it has already are fixed."""

    effect: Effect
    keys: tuple

    @cached_property
    def columns(self):
        """A Column for each of the keys."""
        effect = self.effect
        return tuple(Column(effect.identity, key, effect.typical_of(key)) for key in self.keys)


@dataclass(frozen=True, eq=False)
class Candidate:
    """Terms that come into a model together. price : of the search that found them, twice a log-likelihood."""

    terms: tuple
    price: float = 0.0

    @cached_property
    def columns(self):
        """The Columns of all terms."""
        return tuple(column for term in self.terms for column in term.columns)

    @property
    def channels(self):
        """Names of the channels where it acts."""
        return tuple(dict.fromkeys(name for term in self.terms for name in term.effect.channels))

    @property
    def name(self):
        """Name of its effect."""
        return self.terms[0].effect.name

    @property
    def title(self):
        """Name of its effect, or what a function without a name depends on."""
        return self.name if self.declared else self.label

    @property
    def declared(self):
        """Whether it is in the catalogue, not a function without a name."""
        return not self.terms[0].effect.settings

    @property
    def label(self):
        """How it is called in reports."""
        labels = [term.effect.label_of(term.keys) for term in self.terms]
        return labels[0] + "".join(f" + {term.effect.covariate}" for term in self.terms[1:])

    def plausible(self, beta):
        """Whether values of its columns, (k,), could be."""
        values = dict(zip(((column.effect, column.key) for column in self.columns), beta.tolist()))
        return all(
            term.effect.plausible({key: values[term.effect.identity, key] for key in term.keys}) for term in self.terms
        )

    def sizable(self, beta):
        """Whether at least half of the values of its columns, (k,), are worth having; a smaller group says as much."""
        limits = [term.effect.negligible for term in self.terms for _ in term.keys]
        return sum(abs(value) >= limit for value, limit in zip(beta.tolist(), limits)) >= 0.5 * len(limits)


def candidates_of(effect, anchors, pairs):
    """A Candidate for every set of parameters of an Effect that makes sense, the full set first. anchors : Anchors;
    pairs : (m, 2) ids of the pairs that were heard."""
    sets = [keys for keys in effect.groups(anchors, pairs) if keys]
    return [Candidate((Term(effect, tuple(keys)),), effect.price) for keys in sets]


def columns_of(candidates):
    """All Columns of some Candidates, each once: list."""
    return list(dict.fromkeys(column for candidate in candidates for column in candidate.columns))
