# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find effects that a finding can be confounded with, and parameters that are not observable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_ekf.evidence import DELAY, POSITION

from .algebra import dense, product, weighted
from .fit import prior_sizes
from .select import Selection
from .terms import Candidate, Column, columns_of

ALIKE = 0.9  # smallest explained share of a finding's contribution, for an alternative
DISTINCT = 0.4  # smallest named weight of a combination, relative to the largest
ANY_FLIGHT = "a flight on which the two contributions differ: other places, headings and speeds"


@dataclass(frozen=True)
class Alternative:
    """An effect that explains a finding nearly equally well.

    share : explained share of the finding's contribution, None if below ALIKE
    gap : by how much its criterion is worse, None if the data reject it
    tell_apart : a flight that distinguishes both
    """

    effect: str
    share: float | None
    gap: float | None
    tell_apart: str


@dataclass(frozen=True)
class Level:
    """The constant part of all functions of an anchor, and what a move of it explains of them.

    delay : m, by which the anchor seems farther on average, relative to the others
    shift : (x, y, z) m of the anchor that explains most beside a delay; explained : its share
    """

    delay: float
    shift: tuple[float, float, float]
    explained: float


@dataclass(frozen=True)
class Unobservable:
    """A combination of parameters that the flights do not determine.

    direction : {key: weight} of parameters of the effect; None if the flights lack its channel
    """

    effect: str
    direction: dict[str, float] | None


def flight_to_tell(effect: str, other: str) -> str:
    """Return a sentence: the flight that distinguishes two effects, given by name."""
    for name, opposite in ((effect, other), (other, effect)):
        sentence = EFFECTS[name].row.distinguished_by.get(opposite) if name in EFFECTS else None
        if sentence:
            return sentence
    return ANY_FLIGHT


def alternatives(
    selection: Selection, candidate: Candidate, candidates: Sequence[Candidate]
) -> list[Alternative]:
    """Return the Alternatives of a chosen Candidate, the nearest first.

    Rivals with a similar criterion are alternatives. So are declared effects that explain at least
    ALIKE of its contribution beyond the rest of the model.

    candidates : all declared Candidates
    """
    rivals = selection.rivals[selection.chosen.index(candidate)]
    gaps = {rival.candidate.title: rival.gap for rival in rivals}
    shares = _shares(selection, candidate, candidates)
    names = sorted(
        {*gaps, *shares}, key=lambda name: (gaps.get(name, np.inf), -shares.get(name, 0.0), name)
    )
    return [
        Alternative(name, shares.get(name), gaps.get(name), flight_to_tell(candidate.name, name))
        for name in names
    ]


def _shares(
    selection: Selection, candidate: Candidate, candidates: Sequence[Candidate]
) -> dict[str, float]:
    """Return {effect: share}, the shares of a Candidate's contribution that other effects explain.

    The contribution is whitened, and what the other chosen Candidates and their priors explain is
    taken out. Shares below ALIKE are left out.
    """
    table, model = selection.table, selection.fit
    root = np.sqrt(model.information(table))
    others = columns_of([one for one in selection.chosen if one is not candidate])
    basis = None
    if others:
        rest = np.vstack(
            [dense(weighted(table.matrix(others), root)), np.diag(1.0 / prior_sizes(others))]
        )
        # Without the rows of the priors, its columns are not orthonormal.
        basis = np.linalg.qr(rest)[0][: len(root)]

    def free(x: np.ndarray) -> np.ndarray:
        return x if basis is None else x - basis @ (basis.T @ x)

    part = free((table.matrix(candidate.columns) @ model.values(candidate.columns)) * root)
    power = float(part @ part)
    out: dict[str, float] = {}
    for name, columns in _whole(candidates).items():
        columns = [column for column in columns if column not in others]
        if name == candidate.name or not columns or power == 0.0:
            continue
        x, sizes = weighted(table.matrix(columns), root), prior_sizes(columns)
        gram, vector = product(x, x), x.T @ part
        if basis is not None:  # project the basis out without a dense copy of x
            held = x.T @ basis
            gram = gram - held @ (2.0 * np.eye(len(held.T)) - basis.T @ basis) @ held.T
            vector = vector - held @ (basis.T @ part)
        solution = np.linalg.solve(gram + np.diag(1.0 / sizes**2), vector)
        # Explained power of the regularized projection of the contribution on the other effect.
        share = (2.0 * vector @ solution - solution @ gram @ solution) / power
        if share >= ALIKE:
            out[name] = round(float(share), 3)
    return out


def levels(selection: Selection, candidates: Sequence[Candidate]) -> dict[str, Level]:
    """Return the Level of each anchor that has functions without a name in the TDOAs.

    Functions of an anchor share a constant, so it belongs to none of them. It is a projection of
    their sum on the delay of the anchor, and on its delay and position.

    candidates : all declared Candidates
    """
    table, model = selection.table, selection.fit
    root, out, channel = np.sqrt(model.information(table)), {}, EFFECTS[DELAY].channels[0]
    functions = [
        column
        for term in (term for one in selection.chosen for term in one.terms)
        if term.function and term.function.form == "anchor" and term.function.channel == channel
        for column in term.columns
    ]
    declared = [column for name in (DELAY, POSITION) for column in _whole(candidates).get(name, ())]
    for anchor in dict.fromkeys(column.key.partition(".")[0] for column in functions):
        mine, named = (
            [column for column in some if column.key.partition(".")[0] == anchor]
            for some in (functions, declared)
        )
        part = (table.matrix(mine) @ model.values(mine)) * root
        if len(named) < 4 or not part.any():
            continue
        x = dense(weighted(table.matrix(named), root))
        (delay,), moved = (np.linalg.lstsq(x[:, :k], part, rcond=None)[0] for k in (1, 4))
        left, rest = (np.sum((part - each) ** 2) for each in (x @ moved, x[:, 0] * delay))
        share = 1.0 - float(left / max(rest, 1e-12))
        out[anchor] = Level(float(delay), tuple(moved[1:].tolist()), share)
    return out


def _whole(candidates: Sequence[Candidate]) -> dict[str, Sequence[Column]]:
    """Return {effect: all its Columns}; the first set of an effect is the full set."""
    out: dict[str, Sequence[Column]] = {}
    for candidate in candidates:
        out.setdefault(candidate.name, candidate.columns)
    return out


def unobservable(selection: Selection, candidates: Sequence[Candidate]) -> list[Unobservable]:
    """Return combinations of parameters of declared effects that the flights do not determine.

    They are eigenvectors of the information of a fit of one effect alone, scaled by the prior. An
    eigenvalue below 1 means that the prior determines the combination more than the data do.
    """
    table, out = selection.table, []
    weights, whole = selection.fit.information(table), _whole(candidates)
    for name, columns in whole.items():
        x, sizes = table.matrix(columns), prior_sizes(columns)
        information = product(weighted(x, weights), x) * np.outer(sizes, sizes)
        values, vectors = np.linalg.eigh(information)
        for value, vector in zip(values, vectors.T):
            if value < 1.0:
                strong = np.abs(vector) >= DISTINCT * np.abs(vector).max()
                named = {
                    column.key: round(float(w), 2)
                    for column, w, s in zip(columns, vector, strong)
                    if s
                }
                out.append(Unobservable(name, named))
    missing = [name for name, effect in EFFECTS.items() if effect.fitted and name not in whole]
    return out + [Unobservable(name, None) for name in missing]
