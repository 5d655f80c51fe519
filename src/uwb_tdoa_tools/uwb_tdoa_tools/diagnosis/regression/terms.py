# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of effects as regressors: Column, Term and Candidate."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects import Effect, SmoothTerm


class Column(NamedTuple):
    """A parameter of an effect, as a regressor.

    effect : identity of the Effect; key : name of the parameter
    typical : standard deviation of its prior, in its unit
    """

    effect: tuple[Hashable, ...]
    key: str
    typical: float


@dataclass(frozen=True, eq=False)
class Term:
    """An Effect and the parameters `keys` that a fit estimates.

    Other values of the Effect are fixed.
    """

    effect: Effect
    keys: tuple[str, ...]

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """Return one Column per key."""
        effect = self.effect
        return tuple(Column(effect.merge_key, key, effect.prior_std_of(key)) for key in self.keys)

    @property
    def function(self) -> SmoothTerm | None:
        """Return the Effect if it is a function without a name, else None."""
        return self.effect if isinstance(self.effect, SmoothTerm) else None


@dataclass(frozen=True, eq=False)
class Candidate:
    """Terms that enter a model together.

    price : cost of the search that found them, twice a log-likelihood
    """

    terms: tuple[Term, ...]
    price: float = 0.0

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """Return the Columns of all terms."""
        return tuple(column for term in self.terms for column in term.columns)

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the names of the channels on which it acts."""
        return tuple(dict.fromkeys(name for term in self.terms for name in term.effect.channels))

    @property
    def name(self) -> str:
        """Return the name of its effect."""
        return self.terms[0].effect.name

    @property
    def title(self) -> str:
        """Return the name of its effect, or the covariate of a function without a name."""
        return self.name if self.declared else self.label

    @property
    def declared(self) -> bool:
        """Return whether the effect is in the catalogue, not a function without a name."""
        return self.terms[0].function is None

    @property
    def subject(self) -> set[tuple[str, str]]:
        """Return (form, anchor or pair) of its functions without a name."""
        functions = [(term.function, key) for term in self.terms for key in term.keys]
        return {(one.form, key.rpartition(".")[0]) for one, key in functions if one}

    @property
    def label(self) -> str:
        """Return its name in reports."""
        more = (f" + {term.function.covariate}" for term in self.terms[1:] if term.function)
        return "".join((self.terms[0].effect.label_of(self.terms[0].keys), *more))

    def where(self, keeps: Callable[[Effect], bool]) -> Candidate | None:
        """Return the Candidate with the terms whose Effects `keeps` accepts; None without any."""
        terms = tuple(term for term in self.terms if keeps(term.effect))
        return self if terms == self.terms else Candidate(terms, self.price) if terms else None

    def plausible(self, beta: np.ndarray) -> bool:
        """Return whether values of its columns, (k,), are within the bounds of its effects."""
        values = dict(zip(((column.effect, column.key) for column in self.columns), beta.tolist()))
        return all(
            term.effect.within_bounds(
                {key: values[term.effect.merge_key, key] for key in term.keys}
            )
            for term in self.terms
        )

    def sizable(self, beta: np.ndarray) -> bool:
        """Return whether enough of the values of its columns, (k,), exceed the negligible size.

        If few values are large, a smaller group of parameters suffices.
        """
        effects = [term.effect for term in self.terms for _ in term.keys]
        worth = [abs(value) >= one.row.negligible for value, one in zip(beta.tolist(), effects)]
        return sum(worth) >= sum(one.sizable_share for one in effects)


def candidates_of(effect: Effect, anchors: Anchors, pairs: np.ndarray) -> list[Candidate]:
    """Return one Candidate per meaningful set of parameters of an Effect, the full set first.

    anchors : Anchors; pairs : (m, 2) ids of the measured pairs
    """
    sets = [keys for keys in effect.groups(anchors, pairs) if keys]
    return [Candidate((Term(effect, tuple(keys)),), effect.penalty) for keys in sets]


def columns_of(candidates: Iterable[Candidate]) -> list[Column]:
    """Return all Columns of some Candidates, each once."""
    return list(dict.fromkeys(column for candidate in candidates for column in candidate.columns))
