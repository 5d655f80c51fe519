"""What is known of positions and delays of anchors before some flights: what a tape says, or the last calibration.

The last calibration holds where nothing has changed since. What has, an anchor that was moved, a module that was replaced, is
found by evidence (MacKay, Bayesian interpolation, Neural Computation 1992), one change after the other, as long as each makes
the flights ODDS times as probable. So are delays, where nothing is known of them: the smallest are taken that do not make the
flights ODDS times less probable than larger ones, because delays take what nothing else explains.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_triangular

from uwb_tdoa_bias.effects import Covariance, EffectSet

from ...checking.known_path import MANY

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from numpy.typing import ArrayLike
    from uwb_tdoa_bias.effects import Effect
    from uwb_tdoa_bias.foundation.anchors import Anchors

    ChangeKey = tuple[str, int]  # effect, number of an anchor

DELAY_STDS = 0.02, 0.05, 0.1, 0.2, 0.4  # m, that the evidence chooses from where nothing is known of delays
DELAY_STD = 0.1  # m, of the delay of an anchor that the last calibration did not have
TAG_DELAY = 0.5  # m, of what all ranges are too long by, the antenna delay of the tag: a TDOA does not know of it
FUNCTION_STDS = 0.003, 0.03, 0.06, 0.1, 0.15, 0.22, 0.3  # m, the same of functions of the place
DRIFT = 0.005  # m, by which anything may be off since the last calibration without having changed
MOVED, LATER = 0.3, 0.2  # m, standard deviations of changes: of each coordinate, of a delay
ODDS = 100.0
LOOSE = 0.05  # m, standard deviation of delays in a preliminary solution
OF_ANCHORS = POSITION, DELAY = "anchor_position", "anchor_delay"


@dataclass(frozen=True, eq=False)
class Prior:
    """covariance (4N, 4N) m^2: of coordinates, anchor by anchor, and delays; known (4N,) bool: what the last calibration knows; ids
    (N,); common : m, standard deviation of what delays that nothing is known of have in common."""

    covariance: np.ndarray
    known: np.ndarray
    ids: tuple[str, ...]
    common: float = 0.0

    @classmethod
    def of(cls, anchors: Anchors, position_std: np.ndarray, last: Covariance | None = None, common: float = 0.0) -> Prior:
        """position_std (N, 3) m : of Anchors; last : Covariance of the last calibration, or None; common : as of a Prior."""
        keys, n = keys_of(anchors.ids), len(anchors)
        covariance = np.diag(np.concatenate([position_std.ravel(), np.full(n, DELAY_STD)]) ** 2.0)
        covariance[3 * n :, 3 * n :] += common**2
        known = np.zeros(4 * n, dtype=bool)
        if last is not None:
            places, of_last = last.of(keys)
            covariance[np.ix_(places, places)] = of_last + DRIFT**2 * np.eye(len(places))
            known[places] = True
        return cls(covariance, known, tuple(map(str, anchors.ids)), common)

    @property
    def loose(self) -> np.ndarray:
        """(4N,) m: standard deviations that forbid nothing which may have happened."""
        n = len(self.ids)
        std = np.hypot(np.sqrt(np.diag(self.covariance)), np.where(self.known, MOVED, 0.0))
        return np.concatenate([std[: 3 * n], np.full(n, np.hypot(LOOSE, self.common))])

    def changes(self) -> dict[ChangeKey, tuple[np.ndarray, float]]:
        """{(what, number of an anchor): (places, m, standard deviation)} of what may have changed; of MANY anchors without a calibration
        too: among so many there is one that does not stand where the tape says."""
        n, out = len(self.ids), {}
        anything = n > MANY and not self.known.any()
        for k in range(n):
            for what, places, std in ((POSITION, np.arange(3 * k, 3 * k + 3), MOVED), (DELAY, np.array([3 * n + k]), LATER)):
                if anything or self.known[places].all():
                    out[what, k] = places, std
        return out

    def with_delays(self, std: float) -> np.ndarray:
        """(4N, 4N) m^2, the covariance with another standard deviation of all delays, beside what they have in common."""
        out, first = self.covariance.copy(), 3 * len(self.ids)
        out[first:, first:] = self.common**2 + std**2 * np.eye(len(self.ids))
        return out


@dataclass(frozen=True, eq=False)
class Solution:
    """step (4N,), covariance (4N, 4N); changed : {key of `Prior.changes`: keys of others of its anchor that
    the flights cannot tell from it}; delay_std, function_std : m."""

    evidence: float
    step: np.ndarray
    covariance: np.ndarray
    function_std: float
    delay_std: float = DELAY_STD
    changed: dict[ChangeKey, list[ChangeKey]] = field(default_factory=dict)


def keys_of(ids: Iterable[Any]) -> tuple[tuple[str, str], ...]:
    """((effect, parameter), ...) of all coordinates and delays of anchors."""
    return (*((POSITION, f"{i}.{axis}") for i in ids for axis in "xyz"), *((DELAY, str(i)) for i in ids))


def to_keep(keys: tuple[tuple[str, ...], ...], matrix: np.ndarray) -> Covariance:
    """Covariance to be the prior of the next calibration; of MANY anchors what it says of each of them, or no file could hold it."""
    out = Covariance(keys, matrix)
    return out.of_each_anchor() if len({key.partition(".")[0] for _, key in keys}) > MANY else out


def with_calibration(base: EffectSet, found: Iterable[Effect], covariance: Covariance | None) -> EffectSet:
    """The EffectSet `base` with other Effects: positions and delays of anchors are added to those that it has. covariance : of these, for
    the next calibration; None where none are found."""
    effects = list(base.effects)
    for effect in found:
        same = next((k for k, one in enumerate(effects) if one.name == effect.name and effect.name in OF_ANCHORS), None)
        if same is None:
            effects.append(effect)
            continue
        known = effects[same]
        values = {key: known.values.get(key, 0.0) + value for key, value in effect.values.items()}
        effects[same] = replace(effect, values={**known.values, **values}, std={**known.std, **effect.std})
    return EffectSet(tuple(effects), covariance or base.covariance)


def solve(gram: np.ndarray, vector: np.ndarray, prior: Prior, offset: np.ndarray) -> Solution:
    """Solution of normal equations with the largest evidence.

    gram (k, k), vector (k,) : the first 4N columns those of a Prior, the others functions; offset (4N,) m: where the equations
    were made, from the mean of the prior.
    """
    parts = _parts(gram, vector, prior, offset)

    def best(covariance: np.ndarray) -> tuple[float, int]:
        """(evidence, number of the part) with the largest evidence."""
        known = np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]
        return max((_evidence(*part[:3], *known, offset), k) for k, part in enumerate(parts))

    unchanged, delay_std = prior.covariance, DELAY_STD
    if not prior.known.any():
        evidences = [best(prior.with_delays(std))[0] for std in DELAY_STDS]
        delay_std = next(std for std, evidence in zip(DELAY_STDS, evidences) if evidence >= max(evidences) - np.log(ODDS))
        unchanged = prior.with_delays(delay_std)
    covariance = unchanged
    evidence, number = best(covariance)
    possible = prior.changes()
    changed: dict[ChangeKey, list[ChangeKey]] = {}
    while len(changed) < len(possible):
        trials = _with_each_change(parts, covariance, offset, {key: possible[key] for key in possible if key not in changed})
        key = max(trials, key=trials.__getitem__)
        if trials[key] < evidence + np.log(ODDS):
            break
        doubt = trials[key] - np.log(ODDS)
        changed[key] = [other for other in trials if other[1] == key[1] and other != key and trials[other] > doubt]
        covariance = unchanged.copy()
        for places, std in (possible[one] for one in changed):
            covariance[places, places] += std**2
        evidence, number = best(covariance)
    found = posterior(*parts[number][:3], covariance, offset, parts[number][3])
    return replace(found, delay_std=delay_std, changed=changed)


def _parts(gram: np.ndarray, vector: np.ndarray, prior: Prior, offset: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float, float]]:
    """[(what `eliminated` leaves, standard deviation of functions)], for each of FUNCTION_STDS; of MANY anchors, where each takes seconds,
    only up to those that make the flights ODDS times less probable than smaller ones."""
    out, evidences = [], []
    known = np.linalg.inv(prior.covariance), np.linalg.slogdet(prior.covariance)[1]
    for std in FUNCTION_STDS:
        out.append((*eliminated(gram, vector, len(offset), std), std))
        evidences.append(_evidence(*out[-1][:3], *known, offset))
        if len(prior.ids) > MANY and evidences[-1] < max(evidences) - np.log(ODDS):
            break
    return out


def eliminated(gram: np.ndarray, vector: np.ndarray, n: int, sizes: ArrayLike) -> tuple[np.ndarray, np.ndarray, float]:
    """(gram (n, n), vector (n,), logarithm of the evidence of the rest): normal equations with what comes after the first n unknowns
    integrated out, whose standard deviations are `sizes`, a number or one for each."""
    informed = n + np.flatnonzero(np.diagonal(gram)[n:] > 0.0)  # the others add nothing
    sizes, cross = np.broadcast_to(sizes, len(gram) - n)[informed - n], gram[:n, informed]
    root = np.linalg.cholesky(gram[np.ix_(informed, informed)] + np.diag(sizes**-2.0))
    solved = solve_triangular(root, np.column_stack([cross.T, vector[informed]]), lower=True, check_finite=False)
    evidence = solved[:, -1] @ solved[:, -1] - 2.0 * np.sum(np.log(np.diagonal(root))) - 2.0 * np.sum(np.log(sizes))
    less = solved[:, :-1].T @ solved
    return gram[:n, :n] - less[:, :-1], vector[:n] - less[:, -1], 0.5 * evidence


def posterior(
    gram: np.ndarray, vector: np.ndarray, evidence: float, covariance: np.ndarray, offset: np.ndarray, std: float = 0.0
) -> Solution:
    """Solution of what `eliminated` leaves, with a prior of some covariance whose mean is `offset` before the equations; std : of what
    was integrated out, for the Solution."""
    prior = np.linalg.inv(covariance)
    inverse = np.linalg.inv(gram + prior)
    evidence = _evidence(gram, vector, evidence, prior, np.linalg.slogdet(covariance)[1], offset)
    return Solution(evidence, inverse @ (vector - prior @ offset), inverse, std)


def _evidence(gram: np.ndarray, vector: np.ndarray, evidence: float, prior: np.ndarray, size: float, offset: np.ndarray) -> float:
    """Logarithm of the evidence of a `posterior`, whose prior has the inverse covariance `prior` and the logarithm of its determinant
    `size`."""
    right, root = vector - prior @ offset, np.linalg.cholesky(gram + prior)
    solved = solve_triangular(root, right, lower=True, check_finite=False)
    return evidence + 0.5 * (solved @ solved - 2.0 * np.sum(np.log(np.diagonal(root))) - size - offset @ prior @ offset)


def _with_each_change(
    parts: Sequence[tuple[np.ndarray, np.ndarray, float, float]], covariance: np.ndarray, offset: np.ndarray,
    changes: dict[ChangeKey, tuple[np.ndarray, float]],
) -> dict[ChangeKey, float]:  # fmt: skip
    """{key: the largest evidence with that change of `changes` more}: in closed form, by what the data say of a shift of the prior's
    mean."""
    prior, size, out = np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1], dict.fromkeys(changes, -np.inf)
    for gram, vector, rest, _ in parts:
        evidence, inverse = _evidence(gram, vector, rest, prior, size, offset), np.linalg.inv(gram + prior)
        slope = prior @ (offset + inverse @ (vector - prior @ offset))
        information = prior - prior @ inverse @ prior
        for key, (places, std) in changes.items():
            some = information[np.ix_(places, places)]
            more = slope[places] @ np.linalg.solve(some + np.eye(len(places)) / std**2, slope[places])
            more -= np.linalg.slogdet(np.eye(len(places)) + std**2 * some)[1]
            out[key] = max(out[key], evidence + 0.5 * more)
    return out
