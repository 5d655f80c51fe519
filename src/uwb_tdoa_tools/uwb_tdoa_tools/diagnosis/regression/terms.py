"""What a fit gives values: parameters of effects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

from uwb_tdoa_bias.effects import Effect, SmoothTerm

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable

    import numpy as np

    from uwb_tdoa_bias.common.anchors import Anchors


class Column(NamedTuple):
    """A parameter of an effect, as a regressor. effect : identity of the Effect; key : name of the
    parameter; typical : plausible size, in its unit: standard deviation of its prior.
    """

    effect: tuple[Hashable, ...]
    key: str
    typical: float


@dataclass(frozen=True, eq=False)
class Term:
    """An Effect and those of its parameters, `keys`, that a fit gives values.

    Values that it has already are fixed.
    """

    effect: Effect
    keys: tuple[str, ...]

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """A Column for each of the keys."""
        effect = self.effect
        return tuple(Column(effect.merge_key, key, effect.prior_std_of(key)) for key in self.keys)

    @property
    def function(self) -> SmoothTerm | None:
        """Its Effect, if that is a function without a name."""
        return self.effect if isinstance(self.effect, SmoothTerm) else None


@dataclass(frozen=True, eq=False)
class Candidate:
    """Terms that come into a model together. price : of the search that found them, twice a
    log-likelihood.
    """

    terms: tuple[Term, ...]
    price: float = 0.0

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """The Columns of all terms."""
        return tuple(column for term in self.terms for column in term.columns)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels where it acts."""
        return tuple(dict.fromkeys(name for term in self.terms for name in term.effect.channels))

    @property
    def name(self) -> str:
        """Name of its effect."""
        return self.terms[0].effect.name

    @property
    def title(self) -> str:
        """Name of its effect, or what a function without a name depends on."""
        return self.name if self.declared else self.label

    @property
    def declared(self) -> bool:
        """Whether it is in the catalogue, not a function without a name."""
        return self.terms[0].function is None

    @property
    def label(self) -> str:
        """How it is called in reports."""
        more = (f" + {term.function.covariate}" for term in self.terms[1:] if term.function)
        return "".join((self.terms[0].effect.label_of(self.terms[0].keys), *more))

    def where(self, keeps: Callable[[Effect], bool]) -> Candidate | None:
        """The Candidate with those of its terms alone whose Effects a function keeps; None if that
        is none.
        """
        terms = tuple(term for term in self.terms if keeps(term.effect))
        return self if terms == self.terms else Candidate(terms, self.price) if terms else None

    def plausible(self, beta: np.ndarray) -> bool:
        """Whether values of its columns, (k,), could be."""
        values = dict(zip(((column.effect, column.key) for column in self.columns), beta.tolist()))
        return all(
            term.effect.within_bounds(
                {key: values[term.effect.merge_key, key] for key in term.keys}
            )
            for term in self.terms
        )

    def sizable(self, beta: np.ndarray) -> bool:
        """Whether the share of its effects of the values of its columns, (k,), is worth having; a
        smaller group says as much.
        """
        effects = [term.effect for term in self.terms for _ in term.keys]
        worth = [abs(value) >= one.negligible for value, one in zip(beta.tolist(), effects)]
        return sum(worth) >= sum(one.sizable_share for one in effects)


def candidates_of(effect: Effect, anchors: Anchors, pairs: np.ndarray) -> list[Candidate]:
    """A Candidate for every set of parameters of an Effect that makes sense, the full set first.
    anchors : Anchors;
    pairs : (m, 2) ids of the pairs that were heard.
    """
    sets = [keys for keys in effect.groups(anchors, pairs) if keys]
    return [Candidate((Term(effect, tuple(keys)),), effect.penalty) for keys in sets]


def columns_of(candidates: Iterable[Candidate]) -> list[Column]:
    """All Columns of some Candidates, each once: list."""
    return list(dict.fromkeys(column for candidate in candidates for column in candidate.columns))
