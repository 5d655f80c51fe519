"""What a tape, or the last calibration, says of the anchors before some flights, and what the
flights make of it.

What has changed since is found by evidence (`uwb_tdoa_ekf.evidence`). So are delays, where nothing
is known of them: the smallest are taken that do not make the flights ODDS times less probable than
larger ones, because delays take what nothing else explains.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import Covariance, EffectSet
from uwb_tdoa_ekf.evidence import (
    MOVED,
    ODDS,
    OF_ANCHORS,
    POSITION,
    Part,
    changes_of,
    eliminated,
    known_before,
    log_evidence,
    most_likely_changes,
    most_probable,
)

from ...checking.pair_rules import MANY

if TYPE_CHECKING:
    from collections.abc import Iterable

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.effects import Effect
    from uwb_tdoa_ekf.evidence import Change, ChangeKey

# m, that the evidence chooses from where nothing is known of delays
DELAY_STDS = (0.02, 0.05, 0.1, 0.2, 0.4)
DELAY_STD = 0.1  # m, of the delay of an anchor that the last calibration did not have
# m, of what all ranges are too long by, the antenna delay of the tag: a TDOA does not know of it
TAG_DELAY = 0.5
FUNCTION_STDS = 0.003, 0.03, 0.06, 0.1, 0.15, 0.22, 0.3  # m, the same of functions of the place
# m, standard deviation of a coordinate of an anchor that has moved, once that is plain
ANYWHERE = 1.0
LOOSE = 0.05  # m, standard deviation of delays in a preliminary solution


@dataclass(frozen=True, eq=False)
class Prior:
    """covariance (4N, 4N) m^2: of coordinates, anchor by anchor, and delays; known (4N,) bool: what
    the last calibration knows; ids (N,); common : m, standard deviation of what delays that nothing
    is known of have in common.
    """

    covariance: np.ndarray
    known: np.ndarray
    ids: tuple[str, ...]
    common: float = 0.0

    @classmethod
    def of(
        cls,
        anchors: Anchors,
        position_std: np.ndarray,
        last: Covariance | None = None,
        common: float = 0.0,
    ) -> Prior:
        """position_std (N, 3) m : of Anchors; last : Covariance of the last calibration, or None;
        common : as of a Prior.
        """
        n = len(anchors)
        variance = np.concatenate([position_std.ravel(), np.full(n, DELAY_STD)]) ** 2.0
        covariance, known = known_before(anchors.ids, variance, last)
        free = np.flatnonzero(~known[3 * n :]) + 3 * n
        covariance[np.ix_(free, free)] += common**2
        return cls(covariance, known, tuple(map(str, anchors.ids)), common)

    @property
    def loose(self) -> np.ndarray:
        """(4N,) m: standard deviations that forbid nothing which may have happened."""
        n = len(self.ids)
        std = np.hypot(np.sqrt(np.diag(self.covariance)), np.where(self.known, MOVED, 0.0))
        return np.concatenate([std[: 3 * n], np.full(n, np.hypot(LOOSE, self.common))])

    def changes(self) -> dict[ChangeKey, Change]:
        """{(what, number of an anchor): Change} of what may have changed since the last
        calibration. Without one, an anchor may stand elsewhere than the tape says; of MANY, one may
        also be later than the others.
        """
        unknown, many = not self.known.any(), len(self.ids) > MANY
        return {
            key: change
            for key, change in changes_of(len(self.ids)).items()
            if self.known[change[0]].all() or (unknown and (many or key[0] == POSITION))
        }

    def with_delays(self, std: float) -> np.ndarray:
        """(4N, 4N) m^2, the covariance with another standard deviation of all delays, beside what
        they have in common.
        """
        out, first = self.covariance.copy(), 3 * len(self.ids)
        out[first:, first:] = self.common**2 + std**2 * np.eye(len(self.ids))
        return out


@dataclass(frozen=True, eq=False)
class Solution:
    """step (4N,), covariance (4N, 4N); changed : {key of `Prior.changes`: keys of others that
    the flights cannot tell from it}; delay_std, function_std : m.
    """

    evidence: float
    step: np.ndarray
    covariance: np.ndarray
    function_std: float
    delay_std: float = DELAY_STD
    changed: dict[ChangeKey, list[ChangeKey]] = field(default_factory=dict)


def to_keep(keys: tuple[tuple[str, ...], ...], matrix: np.ndarray) -> Covariance:
    """Covariance to be the prior of the next calibration; of MANY anchors what it says of each of
    them, or no file could hold it.
    """
    out = Covariance(keys, matrix)
    return out.of_each_anchor() if len({key.partition(".")[0] for _, key in keys}) > MANY else out


def with_calibration(
    base: EffectSet, found: Iterable[Effect], covariance: Covariance | None
) -> EffectSet:
    """The EffectSet `base` with other Effects: positions and delays of anchors are added to those
    that it has. covariance : of these, for the next calibration; None where none are found.
    """
    effects = list(base.effects)
    for effect in found:
        same = next(
            (
                k
                for k, one in enumerate(effects)
                if one.name == effect.name and effect.name in OF_ANCHORS
            ),
            None,
        )
        if same is None:
            effects.append(effect)
            continue
        known = effects[same]
        values = {key: known.values.get(key, 0.0) + value for key, value in effect.values.items()}
        effects[same] = replace(
            effect, values={**known.values, **values}, std={**known.std, **effect.std}
        )
    return EffectSet(tuple(effects), covariance or base.covariance)


def solve(gram: np.ndarray, vector: np.ndarray, prior: Prior, offset: np.ndarray) -> Solution:
    """Solution of normal equations with the largest evidence.

    gram (k, k), vector (k,) : the first 4N columns those of a Prior, the others functions; offset
    (4N,) m: where the equations were made, from the mean of the prior.
    """
    parts, unchanged, delay_std = _parts(gram, vector, prior, offset), prior.covariance, DELAY_STD
    if not prior.known.any():
        evidences = [most_probable(parts, prior.with_delays(std), offset)[0] for std in DELAY_STDS]
        delay_std = next(
            std
            for std, evidence in zip(DELAY_STDS, evidences)
            if evidence >= max(evidences) - np.log(ODDS)
        )
        unchanged = prior.with_delays(delay_std)
    changes, possible = (
        most_likely_changes(parts, unchanged, offset, prior.changes()),
        prior.changes(),
    )
    covariance = changes.covariance.copy()
    for places in (possible[key][0] for key in changes.found if key[0] == POSITION):
        covariance[places, places] += ANYWHERE**2
    found = posterior(parts[changes.number], covariance, offset)
    return replace(
        found,
        delay_std=delay_std,
        changed={key: rivals for key, (_, rivals) in changes.found.items()},
    )


def _parts(gram: np.ndarray, vector: np.ndarray, prior: Prior, offset: np.ndarray) -> list[Part]:
    """Parts, for each of FUNCTION_STDS; of MANY anchors, where each takes seconds, only up to those
    that make the flights ODDS times less probable than smaller ones.
    """
    out: list[Part] = []
    evidences: list[float] = []
    known = np.linalg.inv(prior.covariance), float(np.linalg.slogdet(prior.covariance)[1])
    for std in FUNCTION_STDS:
        out.append(Part(*eliminated(gram, vector, len(offset), std), std))
        evidences.append(log_evidence(out[-1], *known, offset))
        if len(prior.ids) > MANY and evidences[-1] < max(evidences) - np.log(ODDS):
            break
    return out


def posterior(part: Part, covariance: np.ndarray, offset: np.ndarray) -> Solution:
    """Solution of a Part, with a prior of some covariance whose mean is `offset` before the
    equations.
    """
    prior = np.linalg.inv(covariance)
    inverse = np.linalg.inv(part.gram + prior)
    evidence = log_evidence(part, prior, float(np.linalg.slogdet(covariance)[1]), offset)
    return Solution(evidence, inverse @ (part.vector - prior @ offset), inverse, part.std)
