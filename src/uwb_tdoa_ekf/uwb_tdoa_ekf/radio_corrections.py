"""Takes the effects out of distances to anchors, at where the filter was a little earlier: live and off line, from stamps alone."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects.samples import RADIO

from .core.aids import STREAMS
from .core.memory import Measurements

if TYPE_CHECKING:
    from collections.abc import Iterator

    from uwb_tdoa_bias.effects import EffectSet
    from .installed import Installed

SLICE = 0.05  # s; what is measured in a slice is corrected at the last pose of those before
KINDS = {STREAMS.index(channel): kind for channel, kind in RADIO.items() if channel in STREAMS}  # {kind of AID: type of its samples}


class RadioCorrections:
    """What bias_node is for TDOAs, for those of the SENSORS that measure distances to anchors: these come to the filter as they are."""

    def __init__(self, effects: EffectSet, installed: Installed) -> None:
        """effects : EffectSet; installed : Installed, which may change."""
        acting = ((kind, effects.acting_on(samples.channel)) for kind, samples in KINDS.items())
        self._correctors = {kind: Corrector(installed.anchors, mine) for kind, mine in acting if len(mine)}
        self._installed, self._slice, self._start = installed, -math.inf, math.nan
        self._pose = self._latest = np.full(3, np.nan), np.full(4, np.nan), 0.0
        self._together = False  # whether the last part may hold several slices

    @property
    def idle(self) -> bool:
        """True if there is nothing to correct with."""
        return not self._correctors

    def add_pose(self, t: np.ndarray, p: np.ndarray, q: np.ndarray, v: np.ndarray, yaw_std: np.ndarray) -> None:
        """Tell where the tag was, as of a Corrector: several, in the order of their stamps."""
        if not len(t):
            return
        before = self._before(t) if self._together else 0
        if before:
            self._pose = p[before - 1], q[before - 1], float(yaw_std[before - 1])
        self._latest, self._together = (p[-1], q[-1], float(yaw_std[-1])), False

    def telling(self, t: np.ndarray) -> np.ndarray:
        """Places (k,) in stamps t (n,), s, ascending, of the poses that `add_pose` asks for after a part: the last one before the slice
        that it ends in, and the last."""
        return np.unique([max(self._before(t) - 1, 0), len(t) - 1]) if len(t) else np.empty(0, np.int64)

    def _before(self, t: np.ndarray) -> int:
        """How many of some stamps lie before the slice."""
        return int(np.searchsorted(np.floor(t / SLICE), self._slice))

    def slices(self, measured: Measurements) -> Iterator[Measurements]:
        """Measurements in parts, corrected. The poses that come of each are to be told by `add_pose` before the next is asked for. What
        holds no distances, as all of a recording without any, is one part."""
        if not self._ranged(measured.aids).any():
            yield self._unchanged(measured)
            return
        of_rows = [np.floor(part["t"] / SLICE) for part in measured]
        for number in np.unique(np.concatenate(of_rows)).tolist():
            if number != self._slice:
                self._slice, self._pose = number, self._latest
            inside = (slice(*np.searchsorted(numbers, [number, number + 1.0])) for numbers in of_rows)
            now = Measurements(*(part[rows] for part, rows in zip(measured, inside)))
            yield now._replace(aids=self._corrected(now))

    @staticmethod
    def _ranged(aids: np.ndarray) -> np.ndarray:
        """(m,) bool: which of (m,) of AID are distances to anchors."""
        return np.isin(aids["kind"], list(KINDS))

    def _unchanged(self, measured: Measurements) -> Measurements:
        """Measurements without distances; the slice that they end in goes on."""
        number = max(float(np.floor(part["t"][-1] / SLICE)) for part in measured if len(part))
        if number != self._slice:
            self._slice, self._pose, self._together = number, self._latest, True
        self._begin(measured, np.zeros(0, bool))
        return measured

    def _begin(self, measured: Measurements, ranged: np.ndarray) -> None:
        """The stamp of the first TDOA or distance counts as the start of the recording. ranged (m,) bool : as of `_ranged`."""
        if math.isnan(self._start) and (len(measured.tdoa) or ranged.any()):
            self._start = float(min([*measured.tdoa["t"][:1], *measured.aids["t"][ranged][:1]]))

    def _corrected(self, measured: Measurements) -> np.ndarray:
        """The (m,) of AID in Measurements of a slice, without what is known to be wrong with them."""
        aids = measured.aids
        self._begin(measured, self._ranged(aids))
        for kind, corrector in self._correctors.items():
            anchors, (rows,) = self._installed.anchors, np.nonzero(aids["kind"] == kind)
            at = anchors.index(self._installed.ids[aids["anchor"][rows]])
            rows, at = rows[at >= 0], at[at >= 0]
            if not len(rows):
                continue
            p, q, yaw_std = (np.repeat(np.array(part)[None], len(rows), axis=0) for part in self._pose)
            samples = KINDS[kind](aids["t"][rows], at, at, p, q, anchors, self._start, yaw_std=yaw_std)
            bias, std, _, _ = corrector.contribution(samples)
            aids = aids.copy() if aids is measured.aids else aids
            aids["value"][rows, 0] -= bias
            aids["std"][rows, 0] = np.hypot(aids["std"][rows, 0], std)
        return aids
