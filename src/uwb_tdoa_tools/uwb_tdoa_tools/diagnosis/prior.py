"""What is known of positions and delays of anchors before some flights: what a tape says, or the last calibration.

The last calibration holds where nothing has changed since. What has, an anchor that was moved, a module that was replaced, is
found by evidence (MacKay, Bayesian interpolation, Neural Computation 1992), one change after the other, as long as each makes
the flights ODDS times as probable. So are delays, where nothing is known of them: the smallest are taken that do not make the
flights ODDS times less probable than larger ones, because delays take what nothing else explains.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable
    from numpy.typing import ArrayLike
    from uwb_tdoa_bias.effects import Covariance
    from uwb_tdoa_bias.foundation.anchors import Anchors

    ChangeKey = tuple[str, int]  # effect, number of an anchor

DELAY_STDS = 0.02, 0.05, 0.1, 0.2, 0.4  # m, that the evidence chooses from where nothing is known of delays
DELAY_STD = 0.1  # m, of the delay of an anchor that the last calibration did not have
FUNCTION_STDS = 0.003, 0.03, 0.06, 0.1, 0.15, 0.22, 0.3  # m, the same of functions of the place
DRIFT = 0.005  # m, by which anything may be off since the last calibration without having changed
MOVED, LATER = 0.3, 0.2  # m, standard deviations of changes: of each coordinate, of a delay
ODDS = 100.0
LOOSE = 0.05  # m, standard deviation of delays in a preliminary solution
POSITION, DELAY = "anchor_position", "anchor_delay"


@dataclass(frozen=True, eq=False)
class Prior:
    """covariance (4N, 4N) m^2: of coordinates, anchor by anchor, and delays; told (4N,) bool: what the last calibration knows; ids
    (N,)."""

    covariance: np.ndarray
    told: np.ndarray
    ids: tuple[str, ...]

    @classmethod
    def of(cls, anchors: Anchors, position_std: np.ndarray, last: Covariance | None = None) -> Prior:
        """position_std (N, 3) m : of Anchors; last : Covariance of the last calibration, or None."""
        keys, n = keys_of(anchors.ids), len(anchors)
        covariance = np.diag(np.concatenate([position_std.ravel(), np.full(n, DELAY_STD)]) ** 2.0)
        told = np.zeros(4 * n, dtype=bool)
        if last is not None:
            places, known = last.of(keys)
            covariance[np.ix_(places, places)] = known + DRIFT**2 * np.eye(len(places))
            told[places] = True
        return cls(covariance, told, tuple(map(str, anchors.ids)))

    @property
    def loose(self) -> np.ndarray:
        """(4N,) m: standard deviations that forbid nothing which may have happened."""
        n = len(self.ids)
        std = np.hypot(np.sqrt(np.diag(self.covariance)), np.where(self.told, MOVED, 0.0))
        return np.concatenate([std[: 3 * n], np.full(n, LOOSE)])

    def changes(self) -> dict[ChangeKey, tuple[np.ndarray, float]]:
        """{(what, number of an anchor): (places, m, standard deviation)} of what may have changed."""
        n, out = len(self.ids), {}
        for k in range(n):
            for what, places, std in ((POSITION, np.arange(3 * k, 3 * k + 3), MOVED), (DELAY, np.array([3 * n + k]), LATER)):
                if self.told[places].all():
                    out[what, k] = places, std
        return out

    def with_changes(self, changes: Iterable[tuple[np.ndarray, float]]) -> np.ndarray:
        """(4N, 4N) m^2, the covariance after some of `changes`."""
        out = self.covariance.copy()
        for places, std in changes:
            out[places, places] += std**2
        return out

    def with_delays(self, std: float) -> np.ndarray:
        """(4N, 4N) m^2, the covariance with another standard deviation of all delays."""
        out = self.covariance.copy()
        rows = np.arange(3 * len(self.ids), len(out))
        out[rows, rows] = std**2
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


def solve(gram: np.ndarray, vector: np.ndarray, prior: Prior, offset: np.ndarray) -> Solution:
    """Solution of normal equations with the largest evidence.

    gram (k, k), vector (k,) : the first 4N columns those of a Prior, the others functions; offset (4N,) m: where the equations
    were made, from the mean of the prior.
    """
    parts = [(eliminated(gram, vector, len(offset), std), std) for std in FUNCTION_STDS]

    def best(covariance: np.ndarray) -> Solution:
        return max((posterior(*part, covariance, offset, std) for part, std in parts), key=lambda one: one.evidence)

    if not prior.told.any():
        trials = [(best(prior.with_delays(std)), std) for std in DELAY_STDS]
        enough = max(found.evidence for found, _ in trials) - np.log(ODDS)
        found, std = next(trial for trial in trials if trial[0].evidence >= enough)
        return Solution(found.evidence, found.step, found.covariance, found.function_std, std)
    found, possible = best(prior.covariance), prior.changes()
    changed: dict[ChangeKey, list[ChangeKey]] = {}
    while len(changed) < len(possible):
        known = [possible[key] for key in changed]
        left = {key: change for key, change in possible.items() if key not in changed}
        changing = {key: best(prior.with_changes([*known, change])) for key, change in left.items()}
        key = max(changing, key=lambda key: changing[key].evidence)
        if changing[key].evidence < found.evidence + np.log(ODDS):
            break
        found, doubt = changing[key], changing[key].evidence - np.log(ODDS)
        rivals = [other for other in changing if other[1] == key[1] and other != key]
        changed[key] = [other for other in rivals if changing[other].evidence > doubt]
    return Solution(found.evidence, found.step, found.covariance, found.function_std, changed=changed)


def eliminated(gram: np.ndarray, vector: np.ndarray, n: int, sizes: ArrayLike) -> tuple[np.ndarray, np.ndarray, float]:
    """(gram (n, n), vector (n,), logarithm of the evidence of the rest): normal equations with what comes after the first n unknowns
    integrated out, whose standard deviations are `sizes`, a number or one for each."""
    cross = gram[:n, n:]
    sizes = np.broadcast_to(sizes, len(gram) - n)
    rest = gram[n:, n:] + np.diag(sizes**-2.0)
    solved = np.linalg.solve(rest, np.column_stack([cross.T, vector[n:]]))
    evidence = vector[n:] @ solved[:, -1] - np.linalg.slogdet(rest)[1] - 2.0 * np.sum(np.log(sizes))
    return gram[:n, :n] - cross @ solved[:, :-1], vector[:n] - cross @ solved[:, -1], 0.5 * evidence


def posterior(
    gram: np.ndarray, vector: np.ndarray, evidence: float, covariance: np.ndarray, offset: np.ndarray, std: float = 0.0
) -> Solution:
    """Solution of what `eliminated` leaves, with a prior of some covariance whose mean is `offset` before the equations; std : of what
    was integrated out, for the Solution."""
    prior = np.linalg.inv(covariance)
    right, information = vector - prior @ offset, gram + prior
    step = np.linalg.solve(information, right)
    evidence += 0.5 * (right @ step - np.linalg.slogdet(information)[1] - np.linalg.slogdet(covariance)[1] - offset @ prior @ offset)
    return Solution(evidence, step, np.linalg.inv(information), std)
