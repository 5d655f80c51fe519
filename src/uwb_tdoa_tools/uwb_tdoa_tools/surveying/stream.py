# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibrate anchors while the tag moves, from a stream in pieces.

Each piece judges what the pieces before it have found. Only then it takes part in the solution.
A tape can be better than these pieces can tell. A first calibration is used once it moves the path
by more than it leaves unknown; until then, the next piece goes on from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.evidence import keys_of

from ..diagnosis.self_calibration import SelfCalibration, Tape, self_calibrate
from ..diagnosis.self_calibration.equations import path_by_anchors, slow_innovations
from ..diagnosis.self_calibration.prior import with_calibration
from ..diagnosis.self_calibration.solve import CLEARLY, LEFT

PIECE = 35.0  # s; a solution needs 30 s of motion, and a change three pieces at most
SMALLEST_RATIO = 1.5  # of the slow innovations after and before a change of the anchors
# Largest expected position error with a first calibration, share of that with the anchors as given,
# set on draws of const1 and const4 trial 1 that the table of `study streaming` does not report
LARGEST_SHARE = 0.65
# Pieces whose median shows what the calibration in use leaves: after half as many it is what is left
# after a change that nothing explains
MOST_LEVELS = 8
MOST_CHANGED = 2  # anchors at once; changes of more explain a piece, but are seldom the true ones
MOST_WAITING = 4  # pieces with little motion that one solution joins


@dataclass(frozen=True)
class Step:
    """What one piece has told.

    name : of the piece; first, last : s, its stamps
    before, after : m, slow innovations with the calibration in use, and with the candidate that was found
        before this piece; NaN if there is none of use
    taken : whether the candidate is used from now on; text : what happened, as a sentence
    """

    name: str
    first: float
    last: float
    before: float
    after: float
    taken: bool
    text: str

    def as_text(self, origin: float) -> str:
        """Return a line; origin : s, stamp from which its times count."""
        return f"{self.name}: {self.first - origin:.0f} to {self.last - origin:.0f} s: {self.text}"


class StreamCalibration:
    """Calibration of the anchors of a stream. It depends on the pieces alone, not on when they come.

    Attributes
    ----------
    number : int
        Number of calibrations that were taken.
    effects : EffectSet
        Calibration in use, with `given` anchors: their position errors and delays, and the base. Its covariance is
        the prior of the next solution, and of the next start.
    """

    def __init__(
        self,
        given: Anchors,
        tape: Tape = Tape(),
        effects: EffectSet = EffectSet(),
        config: FilterConfig | None = None,
    ) -> None:
        """Start from given Anchors.

        effects : known effects, or the `effects` of an earlier StreamCalibration of these Anchors
        """
        self.given, self.effects, self.number = given, effects, 0
        self._tape, self._config = tape, config
        # the next solution starts from this calibration; it may not be good enough to be used
        self._further = effects
        self._candidates: list[SelfCalibration] = []
        self._waiting: list[Flight] = []
        self._levels: list[float] = []  # m, slow innovations on the last pieces

    def take(self, piece: Flight) -> Step:
        """Judge the candidates on a piece, then find the next ones from it."""
        try:
            before = self._slow(piece, self.effects)
        except InputError as error:
            return Step(piece.name, piece.start, piece.end, np.nan, np.nan, False, str(error))
        changed = bool(before > SMALLEST_RATIO * self._level)
        refusals: list[str] = []
        text, after, taken = "nothing to judge yet", np.nan, False
        further = self._further
        for candidate in self._candidates:
            after, self._further = np.nan, self.effects
            try:
                effects = with_calibration(
                    further, candidate.found(candidate.shifts), candidate.covariance
                )
                after = self._slow(piece, effects)
                why_not = self._reason_against(candidate, changed, before, after)
                if self.effects.covariance is None and after <= before and not candidate.changes:
                    self._further = effects
                    why_not = why_not or self._too_little(piece, effects, after)
            except InputError as error:  # these anchors give no estimate
                why_not = str(error)
            if why_not is not None:
                refusals.append(why_not)
                text = f"not taken: {refusals[0]}"
            else:
                self.effects = self._further = effects
                self.number, taken = self.number + 1, True
                changes = [change.as_text() for change in candidate.changes]
                text = "; ".join([f"calibration {self.number} is in use", *changes])
                break
        if self.effects.covariance is not None:
            self._levels = [*self._levels, after if taken else before][-MOST_LEVELS:]
        found = self._find(piece, changed and not taken)
        return Step(piece.name, piece.start, piece.end, before, after, taken, text + found)

    def _find(self, piece: Flight, changed: bool) -> str:
        """Set the candidates, and return a phrase on why there are none, or "".

        changed : whether the anchors have changed
        """
        self._candidates = []
        self._waiting = [*self._waiting, piece][-MOST_WAITING:]
        anchors, base = in_place(self.given, self._further)
        flights = [replace(one, anchors=anchors) for one in self._waiting]
        # an unknown anchor is placed once
        known = base.covariance is not None
        tape = replace(self._tape, unknown=()) if known else self._tape
        solve = partial(self_calibrate, flights, base=base, config=self._config)
        text = ""
        try:
            spread = solve(replace(tape, steady=True))
            self._candidates = [spread]
            # a change of single anchors is judged first
            if changed or (self.effects.covariance is None and spread.why_not):
                self._candidates = [solve(replace(tape, steady=False)), spread]
        except InputError as error:
            text = f"; no new solution: {error}"
        self._waiting = [] if self._candidates else self._waiting
        return text

    @property
    def _level(self) -> float:
        """Return slow innovations that the calibration in use leaves, m."""
        if self.effects.covariance is None:
            return np.inf
        return float(np.median(self._levels)) if self._levels else LEFT

    def _slow(self, piece: Flight, effects: EffectSet) -> float:
        anchors, others = in_place(self.given, effects)
        return slow_innovations([replace(piece, anchors=anchors)], others, self._config)

    def _reason_against(
        self, candidate: SelfCalibration, changed: bool, before: float, after: float
    ) -> str | None:
        """Return why a candidate must not be used, or None.

        changed : whether these anchors have changed since the last calibration
        before, after : m, slow innovations on data that was not used
        """
        alone = {change.anchor for change in candidate.changes}
        if self.effects.covariance is not None and len(alone) > MOST_CHANGED:
            return f"more than {MOST_CHANGED} anchors have changed: survey them again"
        if candidate.why_not is not None:
            return candidate.why_not
        fall = f"slow innovations go from {100 * before:.1f} to {100 * after:.1f} cm"
        if self.effects.covariance is None:
            if after > LEFT:
                return f"{fall}: more than {100 * LEFT:.1f} cm"
            if alone and before < CLEARLY * after:
                return f"{fall}: by less than a factor of {CLEARLY:g}, with one anchor elsewhere"
        if changed and after > SMALLEST_RATIO * self._level:
            return f"{fall}: not back to {100 * self._level:.1f} cm"
        return fall if after > before else None

    def _too_little(self, piece: Flight, effects: EffectSet, slow: float) -> str | None:
        """Return why a first calibration is expected to gain too little on a piece, or None.

        The position errors with it and with the anchors as given differ by what it moves the path. What it
        leaves is unknown: as its covariance says, and of each anchor as much as the slow innovations, m.
        """
        anchors, others = in_place(self.given, effects)
        assert effects.covariance is not None  # as of a calibration
        keys = keys_of(anchors.ids)
        after, before = map(_values, (effects, self.effects))
        change = [after[key] - before.get(key, 0.0) for key in keys]
        late = [slow**2 if effect == AnchorDelay.name else 0.0 for effect, _ in keys]
        unknown = effects.covariance.of(keys)[1] + np.diag(late)
        by_anchors = path_by_anchors(replace(piece, anchors=anchors), others, self._config)
        moved = sum(np.sum((one @ change) ** 2) for one in by_anchors)
        left = sum(np.trace(one @ unknown @ one.T) for one in by_anchors)
        share = float(np.sqrt(left / (left + moved)))
        if share <= LARGEST_SHARE:
            return None
        return f"it is expected to leave {share:.0%} of the position error, more than {LARGEST_SHARE:.0%}"


def _values(effects: EffectSet) -> dict[tuple[str, ...], float]:
    """Return {(effect, parameter): value}."""
    return {(one.name, key): value for one in effects for key, value in one.values.items()}


def in_place(given: Anchors, effects: EffectSet) -> tuple[Anchors, EffectSet]:
    """Return the Anchors at the places that an EffectSet states, and the EffectSet with shifts of 0."""
    shifts, rest = np.zeros_like(given.positions), []
    for effect in effects:
        if isinstance(effect, AnchorPosition):
            for row, i in enumerate(given.ids.tolist()):
                shifts[row] += [effect.values.get(f"{i}.{axis}", 0.0) for axis in "xyz"]
            effect = replace(effect, values=dict.fromkeys(effect.values, 0.0))
        rest.append(effect)
    return given.at(given.positions + shifts), EffectSet(tuple(rest), effects.covariance)
