# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Combine the prior of the anchors, a tape or the last calibration, with the normal equations.

The evidence selects changes since the last calibration, and the size of unknown delays
(`uwb_tdoa_ekf.evidence`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import Covariance, Effect, EffectSet
from uwb_tdoa_ekf.evidence import (
    MOVED,
    ODDS,
    OF_ANCHORS,
    POSITION,
    Change,
    ChangeKey,
    Part,
    changes_of,
    eliminated,
    known_before,
    log_evidence,
    most_likely_changes,
    smallest_delays,
)

from ...checking.pair_rules import MANY
from ...choices import TAPE_STD, TRUSTED_STD

DELAY_STD = 0.1  # m, prior standard deviation of a delay that the last calibration lacks
# m, prior standard deviation of the antenna delay of the tag, which lengthens all ranges and
# cancels in TDOAs
TAG_DELAY = 0.5
# m, candidate standard deviations of functions of the place
FUNCTION_STDS = 0.003, 0.03, 0.06, 0.1, 0.15, 0.22, 0.3
# m, prior standard deviation of a coordinate of an anchor that has moved
ANYWHERE = 1.0
AXES = "xyz"
LOOSE = 0.05  # m, standard deviation of delays in a preliminary solution


@dataclass(frozen=True)
class Tape:
    """Prior standard deviations of anchor coordinates that were measured, e.g. with a tape.

    Attributes
    ----------
    std : m, of each coordinate
    height_std : m, of z; None: as `std`
    trusted : anchors ("3") or coordinates ("3.z") that are known better
    trusted_std : m, of these
    unknown : ids of anchors with unknown positions
    steady : whether no single anchor has moved or changed its delay, beyond the other deviations
    """

    std: float = TAPE_STD
    height_std: float | None = None
    trusted: tuple[str, ...] = ()
    trusted_std: float = TRUSTED_STD
    unknown: tuple[str, ...] = ()
    steady: bool = False

    def __post_init__(self) -> None:
        for name in ("std", "height_std", "trusted_std"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value <= 5.0:
                raise InputError(
                    f"--{name.replace('_', '-')}: {value:g} must be above 0 and at most 5 m."
                )

    def position_std(self, anchors: Anchors) -> np.ndarray:
        """Return the standard deviations of the coordinates of Anchors, (N, 3) m, world.

        Raises InputError for a name that is not an anchor or axis.
        """
        out = np.full((len(anchors), 3), self.std)
        if self.height_std is not None:
            out[:, 2] = self.height_std
        for name in self.trusted:
            anchor, dot, axis = name.partition(".")
            row = self._row(anchors, anchor, f"--trusted {name}")
            if dot and axis not in tuple(AXES):
                raise InputError(
                    f"--trusted: {name!r} has no axis {axis!r}; write {anchor} or {anchor}.x, "
                    f"{anchor}.y, {anchor}.z."
                )
            out[row, AXES.index(axis) if dot else slice(None)] = self.trusted_std
        return out

    def unknown_rows(self, anchors: Anchors) -> list[int]:
        """Return the rows of the unknown anchors.

        Raises InputError if fewer than four other anchors are left.
        """
        rows = [self._row(anchors, anchor, f"--unknown {anchor}") for anchor in self.unknown]
        if len(anchors) - len(rows) < 4:
            raise InputError(
                f"--unknown: {len(anchors) - len(rows)} of {len(anchors)} anchors are left; "
                "four must be known roughly."
            )
        return rows

    @staticmethod
    def _row(anchors: Anchors, text: str, option: str) -> int:
        ids = [str(i) for i in anchors.ids]
        if text not in ids:
            raise InputError(
                f"{option}: there is no anchor {text!r}; the survey has {', '.join(ids)}: add it "
                "there, roughly."
            )
        return ids.index(text)


@dataclass(frozen=True, eq=False)
class Prior:
    """A Gaussian prior of anchor coordinates and delays.

    covariance : (4N, 4N) m^2, coordinates x, y, z anchor by anchor, then N delays
    known : (4N,) bool, parameters that the last calibration determined; ids : (N,)
    common : m, standard deviation of the common part of unknown delays
    steady : as of Tape
    """

    covariance: np.ndarray
    known: np.ndarray
    ids: tuple[str, ...]
    common: float = 0.0
    steady: bool = False

    @classmethod
    def of(
        cls,
        anchors: Anchors,
        position_std: np.ndarray,
        last: Covariance | None = None,
        common: float = 0.0,
    ) -> Prior:
        """Return the Prior of Anchors.

        position_std : (N, 3) m; last : Covariance of the last calibration, or None; common : as of
            Prior
        """
        n = len(anchors)
        variance = np.concatenate([position_std.ravel(), np.full(n, DELAY_STD)]) ** 2.0
        covariance, known = known_before(anchors.ids, variance, last)
        free = np.flatnonzero(~known[3 * n :]) + 3 * n
        covariance[np.ix_(free, free)] += common**2
        return cls(covariance, known, tuple(map(str, anchors.ids)), common)

    @property
    def loose(self) -> np.ndarray:
        """Return standard deviations that allow every plausible change, (4N,) m."""
        n = len(self.ids)
        std = np.hypot(np.sqrt(np.diag(self.covariance)), np.where(self.known, MOVED, 0.0))
        return np.concatenate([std[: 3 * n], np.full(n, np.hypot(LOOSE, self.common))])

    def changes(self) -> dict[ChangeKey, Change]:
        """Return possible changes since the last calibration, {(effect, row of an anchor): Change}.

        Without a last calibration an anchor can stand elsewhere than the tape states. Above MANY
        anchors, a single anchor can also have a delay.
        """
        unknown, many = not self.known.any(), len(self.ids) > MANY
        return {
            key: change
            for key, change in changes_of(len(self.ids)).items()
            if not self.steady
            and (self.known[change[0]].all() or (unknown and (many or key[0] == POSITION)))
        }

    def with_delays(self, std: float) -> np.ndarray:
        """Return the covariance with standard deviation `std`, m, of all delays, (4N, 4N) m^2.

        The common part of the delays stays.
        """
        out, first = self.covariance.copy(), 3 * len(self.ids)
        out[first:, first:] = self.common**2 + std**2 * np.eye(len(self.ids))
        return out


@dataclass(frozen=True, eq=False)
class Solution:
    """The posterior of anchor coordinates and delays.

    evidence : log-evidence; step : (4N,) m, from the point of linearization; covariance : (4N, 4N)
        m^2
    function_std, delay_std : m, selected sizes of functions of the place and of delays
    changed : {key of `Prior.changes`: keys of changes that the flights do not distinguish from it}
    """

    evidence: float
    step: np.ndarray
    covariance: np.ndarray
    function_std: float
    delay_std: float = DELAY_STD
    changed: dict[ChangeKey, list[ChangeKey]] = field(default_factory=dict)


def to_keep(keys: tuple[tuple[str, ...], ...], matrix: np.ndarray) -> Covariance:
    """Return the Covariance that is the prior of the next calibration.

    Above MANY anchors only the block of each anchor is kept, to limit the file size.
    """
    out = Covariance(keys, matrix)
    return (
        out.block_diagonal_by_anchor()
        if len({key.partition(".")[0] for _, key in keys}) > MANY
        else out
    )


def with_calibration(
    base: EffectSet, found: Iterable[Effect], covariance: Covariance | None
) -> EffectSet:
    """Return the EffectSet `base` with other Effects added.

    Positions and delays of anchors add to the values in `base`.

    covariance : of positions and delays, for the next calibration; None keeps the covariance of
        `base`
    """
    effects = list(base.effects)
    places = {one.name: k for k, one in enumerate(effects) if one.name in OF_ANCHORS}
    for effect in found:
        if effect.name not in places:
            effects.append(effect)
            continue
        known = effects[places[effect.name]]
        values = {key: known.values.get(key, 0.0) + value for key, value in effect.values.items()}
        effects[places[effect.name]] = replace(
            effect, values={**known.values, **values}, std={**known.std, **effect.std}
        )
    return EffectSet(tuple(effects), covariance or base.covariance)


def solve(gram: np.ndarray, vector: np.ndarray, prior: Prior, offset: np.ndarray) -> Solution:
    """Return the Solution of normal equations with the largest evidence.

    gram : (k, k), vector : (k,) normal equations. The first 4N parameters belong to the Prior. The
        others are functions of the place.
    offset : (4N,) m, point of linearization minus prior mean
    """
    parts = _parts(gram, vector, prior, offset)
    unchanged, delay_std = prior.covariance, DELAY_STD
    if not prior.known.any():
        delay_std = smallest_delays(parts, prior.with_delays, offset)
        unchanged = prior.with_delays(delay_std)
    possible = prior.changes()
    changes = most_likely_changes(parts, unchanged, offset, possible)
    covariance = changes.covariance.copy()
    for places in (possible[key][0] for key in changes.found if key[0] == POSITION):
        covariance[places, places] += ANYWHERE**2
    found = posterior(parts[changes.number], covariance, offset)
    changed = {key: rivals for key, (_, rivals) in changes.found.items()}
    return replace(found, delay_std=delay_std, changed=changed)


def _parts(gram: np.ndarray, vector: np.ndarray, prior: Prior, offset: np.ndarray) -> list[Part]:
    """Return one Part, the equations without functions, for each of FUNCTION_STDS.

    Above MANY anchors each Part takes seconds. The list then ends when a size is ODDS times less
    probable than a smaller one.
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
    """Return the Solution of a Part with a Gaussian prior.

    covariance : (4N, 4N) m^2; offset : (4N,) m, point of linearization minus prior mean
    """
    prior = np.linalg.inv(covariance)
    inverse = np.linalg.inv(part.gram + prior)
    evidence = log_evidence(part, prior, float(np.linalg.slogdet(covariance)[1]), offset)
    return Solution(evidence, inverse @ (part.vector - prior @ offset), inverse, part.std)
