# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibrate anchors while the tag moves, from a stream in pieces.

Each piece judges what the pieces before it have found. Only then it takes part in the solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_ekf.core.config import FilterConfig

from ..diagnosis.self_calibration import SelfCalibration, Tape, self_calibrate
from ..diagnosis.self_calibration.equations import slow_innovations
from ..diagnosis.self_calibration.prior import with_calibration
from ..diagnosis.self_calibration.solve import LEFT, AnchorChange

PIECE = 45.0  # s; a solution needs 30 s of motion
# Smallest ratio of the slow innovations without and with a first calibration, or a changed anchor, on
# data that was not used
SMALLEST_RATIO = 1.5
MOST_WAITING = 4  # pieces with little motion that one solution joins


@dataclass(frozen=True)
class Step:
    """What one piece has told.

    name : of the piece; first, last : s, its stamps
    before, after : m, slow innovations with the calibration in use, and with the candidate that was found
        before this piece; NaN if there is none
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
        self._candidates: list[SelfCalibration] = []
        self._waiting: list[Flight] = []
        # m, slow innovations on the piece that judged the calibration in use
        self._level = np.inf if effects.covariance is None else LEFT

    def take(self, piece: Flight) -> Step:
        """Judge the candidates on a piece, then find the next ones from it."""
        try:
            before = self._slow(piece, self.effects)
        except InputError as error:
            return Step(piece.name, piece.start, piece.end, np.nan, np.nan, False, str(error))
        text, after = "nothing to judge yet", np.nan
        taken = False
        for candidate in self._candidates:
            effects = with_calibration(
                self.effects, candidate.found(candidate.shifts), candidate.covariance
            )
            try:
                after = self._slow(piece, effects)
                why_not = candidate.why_not or self._reason_against(candidate, before, after)
            except InputError as error:  # these anchors give no estimate
                why_not = str(error)
            text = f"not taken: {why_not}"
            if why_not is None:
                self.effects, self._level = effects, after
                self.number, taken = self.number + 1, True
                changes = [change.as_text() for change in _changes(candidate)]
                text = "; ".join([f"calibration {self.number} is in use", *changes])
                break
        changed = not taken and bool(before > SMALLEST_RATIO * self._level)
        found = self._find(piece, changed)
        return Step(piece.name, piece.start, piece.end, before, after, taken, text + found)

    def _find(self, piece: Flight, changed: bool) -> str:
        """Set the candidates, and return a phrase on why there are none, or "".

        changed : whether a single anchor may have changed; such a candidate is judged first
        """
        self._candidates = []
        self._waiting = [*self._waiting, piece][-MOST_WAITING:]
        anchors, base = in_place(self.given, self.effects)
        flights = [replace(one, anchors=anchors) for one in self._waiting]
        # an unknown anchor is placed once
        tape = replace(self._tape, unknown=()) if self.number else self._tape
        if self.effects.covariance is None:
            tapes = [tape]
        else:
            tapes = [tape] * changed + [replace(tape, steady=True)]
        try:
            for tape in tapes:
                self._candidates.append(self_calibrate(flights, tape, base, self._config))
        except InputError as error:
            return f"; no new solution: {error}"
        self._waiting = []
        return ""

    def _slow(self, piece: Flight, effects: EffectSet) -> float:
        anchors, others = in_place(self.given, effects)
        return slow_innovations([replace(piece, anchors=anchors)], others, self._config)

    def _reason_against(
        self, candidate: SelfCalibration, before: float, after: float
    ) -> str | None:
        """Return why slow innovations on data that was not used forbid a candidate, or None.

        before, after : m, slow innovations
        """
        first = self.effects.covariance is None
        fall = f"slow innovations go from {100 * before:.1f} to {100 * after:.1f} cm"
        if first and after > LEFT:
            return f"{fall}: more than {100 * LEFT:.1f} cm"
        ratio = SMALLEST_RATIO if first or _changes(candidate) else 1.0
        if before < ratio * after:
            return fall if ratio == 1.0 else f"{fall}: by less than a factor of {ratio:g}"
        return None


def _changes(found: SelfCalibration) -> Sequence[AnchorChange]:
    """Return the changes of single anchors since the calibration before, if there is one."""
    return () if found.base.covariance is None else found.changes


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
