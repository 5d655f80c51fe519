"""Takes the effects out of distances to anchors, at where the filter was a little earlier: live and
off line, from stamps alone.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects.samples import RADIO

from .core.aids import STREAMS
from .core.memory import ODOMETRY, Measurements
from .frames import poses_of
from .results import Odometry

if TYPE_CHECKING:
    from collections.abc import Iterator

    from uwb_tdoa_bias.effects import EffectSet

    from .installed import Installed

SLICE = 0.05  # s; what is measured in a slice is corrected at the last pose of those before
_NOWHERE = np.zeros(1, ODOMETRY)
_NOWHERE["x"] = np.nan
KINDS = {
    STREAMS.index(channel): kind for channel, kind in RADIO.items() if channel in STREAMS
}  # {kind of AID: type of its samples}


class RadioCorrections:
    """What bias_node is for TDOAs, for those of the SENSORS that measure distances to anchors:
    these come to the filter as they are.
    """

    def __init__(self, effects: EffectSet, installed: Installed) -> None:
        """effects : EffectSet; installed : Installed, which may change."""
        acting = ((kind, effects.acting_on(samples.channel)) for kind, samples in KINDS.items())
        self._correctors = {
            kind: Corrector(installed.anchors, mine) for kind, mine in acting if len(mine)
        }
        self._installed, self._slice, self._start = installed, -math.inf, math.nan
        self._pose = self._latest = (
            _NOWHERE  # (1,) of ODOMETRY, of which nothing is computed before there are distances
        )
        self._together = False  # whether the last part may hold several slices

    @property
    def idle(self) -> bool:
        """True if there is nothing to correct with."""
        return not self._correctors

    def add_odometry(self, rows: np.ndarray) -> None:
        """Tell where the tag was: (n,) of ODOMETRY that came of the last part, in the order of
        their stamps.
        """
        if not len(rows):
            return
        before = (
            int(np.searchsorted(np.floor(rows["t"] / SLICE), self._slice)) if self._together else 0
        )
        if before:
            self._pose = rows[before - 1 : before]
        self._latest, self._together = rows[-1:], False

    def slices(self, measured: Measurements) -> Iterator[Measurements]:
        """Measurements in parts, corrected. What comes of each is to be given to `add_odometry`
        before the next is asked for. What holds no distances, as all of a recording without any, is
        one part.
        """
        if not len(measured.aids) or not self._ranged(measured.aids).any():
            yield self._unchanged(measured)
            return
        of_rows = [np.floor(part["t"] / SLICE) for part in measured]
        for number in np.unique(np.concatenate(of_rows)).tolist():
            if number != self._slice:
                self._slice, self._pose = number, self._latest
            inside = (
                slice(*np.searchsorted(numbers, [number, number + 1.0])) for numbers in of_rows
            )
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
        """The stamp of the first TDOA or distance counts as the start of the recording. ranged (m,)
        bool : as of `_ranged`.
        """
        if math.isnan(self._start) and (len(measured.tdoa) or ranged.any()):
            self._start = float(min([*measured.tdoa["t"][:1], *measured.aids["t"][ranged][:1]]))

    def _corrected(self, measured: Measurements) -> np.ndarray:
        """The (m,) of AID in Measurements of a slice, without what is known to be wrong with them."""
        aids = measured.aids
        self._begin(measured, self._ranged(aids))
        _, p, q, _, yaw_std = poses_of(Odometry.from_rows(self._pose))
        for kind, corrector in self._correctors.items():
            anchors, (rows,) = self._installed.anchors, np.nonzero(aids["kind"] == kind)
            at = anchors.index(self._installed.ids[aids["anchor"][rows]])
            rows, at = rows[at >= 0], at[at >= 0]
            if not len(rows):
                continue
            n = len(rows)
            ps, qs, stds = np.repeat(p, n, axis=0), np.repeat(q, n, axis=0), np.repeat(yaw_std, n)
            samples = KINDS[kind](
                aids["t"][rows], at, at, ps, qs, anchors, self._start, yaw_std=stds
            )
            bias, std, _, _ = corrector.contribution(samples)
            aids = aids.copy() if aids is measured.aids else aids
            aids["value"][rows, 0] -= bias
            aids["std"][rows, 0] = np.hypot(aids["std"][rows, 0], std)
        return aids
