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

    @property
    def idle(self) -> bool:
        """True if there is nothing to correct with."""
        return not self._correctors

    def add_pose(self, t: np.ndarray, p: np.ndarray, q: np.ndarray, v: np.ndarray, yaw_std: np.ndarray) -> None:
        """Tell where the tag was, as of a Corrector: several, in the order of their stamps."""
        if len(t):
            self._latest = p[-1], q[-1], float(yaw_std[-1])

    def slices(self, measured: Measurements) -> Iterator[Measurements]:
        """Measurements in parts, corrected. The poses that come of each are to be told by `add_pose` before the next is asked for."""
        of_rows = [np.floor(part["t"] / SLICE) for part in measured]
        for number in np.unique(np.concatenate(of_rows)).tolist():
            if number != self._slice:
                self._slice, self._pose = number, self._latest
            inside = (slice(*np.searchsorted(numbers, [number, number + 1.0])) for numbers in of_rows)
            now = Measurements(*(part[rows] for part, rows in zip(measured, inside)))
            yield now._replace(aids=self._corrected(now))

    def _corrected(self, measured: Measurements) -> np.ndarray:
        """The (m,) of AID in Measurements of a slice, without what is known to be wrong with them."""
        aids = measured.aids
        ranged = np.isin(aids["kind"], list(KINDS))
        if math.isnan(self._start) and (len(measured.tdoa) or ranged.any()):
            self._start = float(min([*measured.tdoa["t"][:1], *aids["t"][ranged][:1]]))
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
