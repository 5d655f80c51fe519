"""Which effects explain the residuals: forward and backward steps with a price on every parameter.

The statistic of a candidate is what it gains in log-likelihood, twice, over all channels together and counted in
independent rows. A parameter costs log(rows) as in the Bayesian information criterion, and choosing among C candidates
costs 2 log C (Chen and Chen, Biometrika 2008, extended BIC): that holds the false-alarm rate of the whole catalogue.
"""

from dataclasses import dataclass, field

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from .fit import fit, prior_sizes, solve
from .rows import CHANNELS

MAX_STEPS = 14
NEGLIGIBLE = (0.004, 5e-4, 0.01)  # m, rad/s, m/s^2: root mean square of a contribution that is not worth a term
AMBIGUOUS = 10.0  # less difference in the criterion is no decision


@dataclass(frozen=True)
class Candidate:
    """An effect with the columns (effect, parameter) that a fit gives values. `fixed` : further values, which are no
    columns; `extra` : price of the search that found it; `terms` : the SmoothTerms it is, if it is no declared
    effect."""

    effect: str
    columns: tuple
    fixed: dict = field(default_factory=dict)
    extra: float = 0.0
    terms: tuple = ()

    @property
    def keys(self):
        """Names of the parameters."""
        return tuple(key for _, key in self.columns)

    @property
    def channels(self):
        """Where it acts."""
        return EFFECTS[self.effect].channels if not self.terms else (self.terms[0].channel.partition(".")[0],)


class Scorer:
    """What sets of columns would gain, with the weights, scales and inflation of one Fit."""

    def __init__(self, table, base, now):
        """base : columns that are in the model already; now : Fit of them."""
        self.table, self.base, self.size = table, list(base), now.size
        self.root = now.weight / (now.scale[table.channel] ** 2 * now.inflation[table.channel])
        self.inflation, self.rows = now.inflation, [table.channel == c for c in range(3)]
        self.present = [c for c in range(3) if self.rows[c].any()]
        self.x = table.matrix(self.base)
        self.gram = (self.x * self.root[:, None]).T @ self.x
        self.vector = self.x.T @ (self.root * table.y)
        self.before = self._result(self.x, self.gram, self.vector, prior_sizes(self.base))

    def with_columns(self, columns):
        """Result with further columns: (beta of base and columns, parameters told, {channel: squares}, penalty)."""
        new = [name for name in columns if name not in self.base]
        x = self.table.matrix(new)
        xw = x * self.root[:, None]
        cross = self.x.T @ xw
        gram = np.block([[self.gram, cross], [cross.T, x.T @ xw]])
        vector = np.concatenate([self.vector, xw.T @ self.table.y])
        return self._result(np.hstack([self.x, x]), gram, vector, prior_sizes(self.base + new)), self.base + new

    def _result(self, x, gram, vector, sizes):
        beta, _, told = solve(gram, vector, sizes)
        rest = self.table.y - x @ beta
        power = self.root * rest**2
        squares = {c: max(float(np.sum(power[self.rows[c]])), 1e-12) for c in self.present}
        return beta, told, squares, float(np.sum((beta / sizes) ** 2))

    def gain(self, before, after):
        """Twice the gain in log-likelihood between two results."""
        data = sum(self.size[c] * np.log(before[2][c] / after[2][c]) for c in self.present)
        return data + before[3] - after[3]

    def price(self, candidate, added, choices):
        """What the parameters of a candidate must at least gain."""
        rows = sum(
            self.size[CHANNELS.index(name)] for name in candidate.channels if CHANNELS.index(name) in self.present
        )
        return added * np.log(max(rows, 10.0)) + 2.0 * np.log(max(choices, 2)) + candidate.extra


@dataclass
class Selection:
    """chosen : [Candidate]; fit : Fit of all; loss : [criterion without it]; rivals : [[(gap, Candidate)]]: what could
    stand in its place at nearly the same price; ranked : what remains after the last step, best first."""

    chosen: list
    fit: object
    loss: list
    rivals: list
    ranked: list


def select(table, candidates, inflation, search=None, start=(), progress=None):
    """Selection among `candidates`, whose columns the Table holds.

    search(table, fit, chosen) -> more Candidates, found for this residual, whose columns it adds to the table.
    start : Candidates that are in the model to begin with, and may fall out again.
    """
    chosen = list(start)
    now, ranked = fit(table, columns_of(chosen), inflation), []
    for _ in range(MAX_STEPS):
        found = search(table, now, chosen) if search else []
        ranked = rank(table, candidates + found, chosen, now)
        if progress:
            progress()
        if not ranked or ranked[0][0] <= 0.0:
            break
        chosen.append(ranked[0][1])
        now = fit(table, columns_of(chosen), inflation)
        chosen, now = _backward(table, chosen, now, len(candidates))
    loss = _losses(table, chosen, now, len(candidates))
    return Selection(chosen, now, loss, _rivals(table, candidates, chosen, now), ranked)


def worth(table, selection, choices):
    """Criterion of a whole Selection against a model with nothing in it, with the weights of its own fit."""
    if not selection.chosen:
        return 0.0
    scorer, total = Scorer(table, [], selection.fit), 0.0
    after, _ = scorer.with_columns(columns_of(selection.chosen))
    total = scorer.gain(scorer.before, after)
    for k, one in enumerate(selection.chosen):
        told = Scorer(table, columns_of(selection.chosen[:k]), selection.fit)
        added = told.with_columns(one.columns)[0][1] - told.before[1]
        total -= scorer.price(one, added, choices)
    return total


def columns_of(chosen):
    """All columns of some Candidates, each once."""
    return list(dict.fromkeys(name for one in chosen for name in one.columns))


def rank(table, candidates, chosen, now):
    """[(criterion, Candidate)], best first; without those of negligible or impossible size."""
    scorer, out = Scorer(table, columns_of(chosen), now), []
    for one in candidates:
        after, names = scorer.with_columns(one.columns)
        added = after[1] - scorer.before[1]
        if len(names) == len(scorer.base) or added < 0.3:
            continue
        beta = after[0][[names.index(name) for name in one.columns]]
        if not sizable(table, one, beta) or not plausible(one, beta):
            continue
        out.append((scorer.gain(scorer.before, after) - scorer.price(one, added, len(candidates)), one))
    return sorted(out, key=lambda item: -item[0])


def sizable(table, candidate, beta):
    """Whether it moves a channel by more than what nobody would model, and most of its parameters are worth having."""
    if not candidate.terms and np.mean(np.abs(beta) >= EFFECTS[candidate.effect].negligible) < 0.5:
        return False  # a smaller group says as much
    part = table.matrix(candidate.columns) @ beta
    moved = [part[(table.channel == c) & (part != 0.0)] for c in range(3)]
    return any(len(x) > 0 and np.sqrt(np.mean(x**2)) > NEGLIGIBLE[c] for c, x in enumerate(moved))


def plausible(candidate, beta):
    """Within the bounds of the effect, and late rather than early where it can only be late."""
    if candidate.terms:
        return True
    effect = EFFECTS[candidate.effect]
    if any(abs(value) > effect.bound_of(key) for key, value in zip(candidate.keys, beta)):
        return False
    return candidate.effect != "nlos" or bool((beta > 0.0).all())


def _backward(table, chosen, now, choices):
    """Drop what is no longer worth its price, once others are in, or has become negligible or impossible."""
    while len(chosen) > 1:
        losses = _losses(table, chosen, now, choices)
        for k, one in enumerate(chosen):
            beta = now.beta[[now.names.index(name) for name in one.columns]]
            if not sizable(table, one, beta) or not plausible(one, beta):
                losses[k] = -np.inf
        worst = int(np.argmin(losses))
        if losses[worst] > 0.0:
            break
        chosen = chosen[:worst] + chosen[worst + 1 :]
        now = fit(table, columns_of(chosen), now.inflation)
    return chosen, now


def _losses(table, chosen, now, choices):
    """Criterion that each chosen one is worth beside the others."""
    out = []
    for k, one in enumerate(chosen):
        scorer = Scorer(table, columns_of(chosen[:k] + chosen[k + 1 :]), now)
        after, _ = scorer.with_columns(one.columns)
        out.append(scorer.gain(scorer.before, after) - scorer.price(one, after[1] - scorer.before[1], choices))
    return out


def _rivals(table, candidates, chosen, now):
    """For each chosen one, other effects that could replace it: [(gap of the criterion, Candidate)]."""
    out = []
    for k, one in enumerate(chosen):
        others = chosen[:k] + chosen[k + 1 :]
        rest = fit(table, columns_of(others), now.inflation)
        ranked = rank(table, [c for c in candidates if c.effect != one.effect] + [one], others, rest)
        own = next((score for score, candidate in ranked if candidate is one), None)
        near = {}
        for score, candidate in ranked if own is not None else []:
            if candidate.effect != one.effect and score > own - AMBIGUOUS:
                near.setdefault(candidate.effect, (float(own - score), candidate))
        out.append(list(near.values()))
    return out
