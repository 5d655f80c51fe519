"""From measurements in the order of their stamps to odometry: the filter, and the watch for
changes, live and off line.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uwb_tdoa_bias.effects import EffectSet

from .core.engine import feed, set_pose
from .core.memory import ODOMETRY, RESIDUAL, TDOA, FilterState, Measurements, joined
from .installed import Installed, forget, new_state_of
from .monitoring.monitor import Monitor
from .monitoring.slices import LENGTH
from .radio_corrections import RadioCorrections
from .results import Odometry, Residuals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .core.config import FilterConfig
    from .reorder_buffer import ReorderBuffer


class Fed(NamedTuple):
    """measured : Measurements that were used at once; odometry : (n,) of ODOMETRY that came of
    them; tdoas, aids : (k,) and (m,) of RESIDUAL, what became of them.
    """

    measured: Measurements
    odometry: np.ndarray
    tdoas: np.ndarray
    aids: np.ndarray


class Pipeline:
    """Takes what a ReorderBuffer releases. state : FilterState; monitor : Monitor, or None, if
    nobody asks what has changed.
    """

    def __init__(
        self,
        anchors: Installed,
        config: FilterConfig,
        effects: EffectSet = EffectSet(),
        watched: bool = True,
        records: list[np.ndarray] | None = None,
    ) -> None:
        """anchors : Installed; config : FilterConfig; effects : EffectSet that is known, of which
        the filter itself is told, or that is taken out of distances to anchors; watched : have a
        Monitor in any case; records : list to which the history is appended (see engine.feed), or
        None.
        """
        self._anchors, self._effects, self._records = anchors, effects, records
        self.state = self._new_state()
        self._corrections = RadioCorrections(effects, anchors)
        self.monitor = (
            Monitor(anchors, effects.covariance) if watched or config.compensate_changes else None
        )
        self.configure(config)

    def configure(self, config: FilterConfig) -> None:
        """Go on with a FilterConfig."""
        self._config, self._parameters = config, config.parameters()
        if not config.compensate_changes:
            self.state.anchors["delay"] = self.state.anchors["delay_variance"] = 0.0

    def _new_state(self) -> FilterState:
        return new_state_of(
            self._anchors,
            self._effects.sensor_functions,
            self._effects.near_ground_delays(self._anchors.anchors),
        )

    def change_anchors(self, gone: np.ndarray) -> None:
        """Go on after a change of the Installed: with what is known of its new rows, and without
        the rows `gone` (k,).
        """
        more, first = self._new_state(), len(self.state.anchors)
        self.state = self.state._replace(
            anchors=np.concatenate([self.state.anchors, more.anchors[first:]])
        )
        self.state.record.extent[:] = more.record.extent
        forget(self.state, gone)
        if self.monitor is not None:
            self.monitor.forget(gone)

    def run(self, buffer: ReorderBuffer, until: float) -> list[Fed]:
        """Use what a ReorderBuffer holds up to `until`, s; where delays are taken out, from the
        stamps on at which the monitor finds them.
        """
        parts = []
        while self._config.compensate_changes and self.monitor is not None and len(buffer):
            end = min(
                self.monitor.end, (math.floor(buffer.first / LENGTH) + 1.0) * LENGTH
            )  # the first slice begins with the first TDOA
            if end > until:
                break
            parts += self._feed(buffer.take(math.nextafter(end, -math.inf)))
            self.monitor.update(end)
            self.state.anchors["delay"], self.state.anchors["delay_variance"] = self.monitor.delays
        parts += self._feed(buffer.take(until))
        if self.monitor is not None:
            self.monitor.update(buffer.used_until)
        return parts

    @property
    def alarms(self) -> list[str]:
        """Sentences on what has changed since the flight began."""
        return [] if self.monitor is None else self.monitor.alarms

    def set_pose(self, pose: np.ndarray) -> None:
        """Put the filter at a pose, (1,) of POSE, that is not before what was used."""
        set_pose(self.state, self._parameters, pose)

    def _feed(self, measured: Measurements) -> list[Fed]:
        if not any(map(len, measured)):
            return []
        parts = []
        for part in [measured] if self._corrections.idle else self._corrections.slices(measured):
            used = part if self._config.use_imu else part._replace(imu=part.imu[:0])
            fed = Fed(part, *feed(self.state, self._parameters, used, self._records))
            if not self._corrections.idle:
                self._corrections.add_odometry(fed.odometry)
            parts.append(fed)
        if self.monitor is not None:
            self.monitor.add(odometry_of(parts), self.residuals(parts))
        return parts

    def residuals(self, parts: Sequence[Fed]) -> Residuals:
        """What became of the TDOAs of several Fed, in the order in which they were used."""
        tdoa, rows = (
            joined(TDOA, [part.measured.tdoa for part in parts]),
            joined(RESIDUAL, [part.tdoas for part in parts]),
        )
        ids = self._anchors.ids
        return Residuals.from_rows(tdoa["t"], ids[tdoa["a"]], ids[tdoa["b"]], rows)


def odometry_of(parts: Sequence[Fed]) -> Odometry:
    """What came of several Fed."""
    return Odometry.from_rows(joined(ODOMETRY, [part.odometry for part in parts]))
