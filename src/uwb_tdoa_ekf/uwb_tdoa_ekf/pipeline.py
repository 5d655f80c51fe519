# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the filter and the Monitor on measurements in the order of their stamps, live and offline."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.samples import RADIO

from .anchor_table import AnchorTable
from .core.config import FilterConfig
from .core.engine import feed, set_pose
from .core.memory import ODOMETRY, RESIDUAL, TDOA, FilterState, Measurements, joined, new_state
from .core.sensors import STREAMS
from .monitoring.monitor import Monitor
from .monitoring.slices import LENGTH
from .reorder_buffer import ReorderBuffer
from .results import Odometry, Residuals, poses_of

SLICE = 0.05  # s; ranges in a slice are corrected at the last pose of earlier slices
_NOWHERE = np.zeros(1, ODOMETRY)
_NOWHERE["x"] = np.nan
KINDS = {
    STREAMS.index(channel): kind for channel, kind in RADIO.items() if channel in STREAMS
}  # {kind of SENSOR_ROW: type of its samples}


class RadioCorrections:
    """Correct distances to anchors, as bias_node corrects TDOAs.

    Distances come from SENSORS, and these reach the filter uncorrected.
    """

    def __init__(self, effects: EffectSet, anchor_table: AnchorTable) -> None:
        """Create a Corrector for each kind of distance on which an effect acts.

        Parameters
        ----------
        effects : EffectSet
            Known effects.
        anchor_table : AnchorTable
            Anchors, which may change later.
        """
        acting = ((kind, effects.acting_on(samples.channel)) for kind, samples in KINDS.items())
        self._correctors = {
            kind: Corrector(anchor_table.anchors, mine) for kind, mine in acting if len(mine)
        }
        self._anchor_table, self._slice, self._start = anchor_table, -math.inf, math.nan
        # (1,) of ODOMETRY: the last one before the present slice, and the last one of all; their
        # positions are NaN until there is odometry
        self._pose = self._latest = _NOWHERE

    def add_odometry(self, rows: np.ndarray) -> None:
        """Store the pose for the next correction.

        Parameters
        ----------
        rows : (n,) array of ODOMETRY
            Odometry of the last part, in the order of its stamps.
        """
        if not self._correctors or not len(rows):
            return
        earlier = int(np.searchsorted(_slice_numbers(rows), self._slice))
        if earlier:
            self._pose = rows[earlier - 1 : earlier]
        self._latest = rows[-1:]

    def slices(self, measured: Measurements) -> Iterator[Measurements]:
        """Yield Measurements in corrected parts, or all at once if none needs correction.

        The caller must pass the odometry of each part to `add_odometry` before it asks for the
        next.
        """
        if not self._correctors:
            yield measured
            return
        self._begin(measured)
        kinds = measured.sensors["kind"]
        if not len(kinds) or not np.isin(kinds, list(self._correctors)).any():
            newest = np.concatenate([_slice_numbers(part[-1:]) for part in measured])
            self._enter(float(newest.max()))
            yield measured
            return
        of_rows = [_slice_numbers(part) for part in measured]
        for number in np.unique(np.concatenate(of_rows)).tolist():
            self._enter(number)
            inside = (slice(*np.searchsorted(each, [number, number + 1.0])) for each in of_rows)
            now = Measurements(*(part[rows] for part, rows in zip(measured, inside)))
            yield now._replace(sensors=self._corrected(now))

    def _begin(self, measured: Measurements) -> None:
        """Store the stamp at which the recording starts: of its first TDOA or distance."""
        if math.isnan(self._start):
            ranged = np.isin(measured.sensors["kind"], list(KINDS))
            stamps = [*measured.tdoa["t"][:1], *measured.sensors["t"][ranged][:1]]
            self._start = float(min(stamps, default=math.nan))

    def _enter(self, number: float) -> None:
        """Store the last pose before a new slice."""
        if number != self._slice:
            self._slice, self._pose = number, self._latest

    def _corrected(self, measured: Measurements) -> np.ndarray:
        """Return the (m,) of SENSOR_ROW of one slice, with the distances corrected."""
        sensors = measured.sensors
        _, p, q, _, yaw_std = poses_of(Odometry.from_rows(self._pose))
        for kind, corrector in self._correctors.items():
            anchors = self._anchor_table.anchors
            rows = np.flatnonzero(sensors["kind"] == kind)
            at = anchors.index(self._anchor_table.ids[sensors["anchor"][rows]])
            rows, at = rows[at >= 0], at[at >= 0]
            if not len(rows):
                continue
            n = len(rows)
            ps, qs, stds = np.repeat(p, n, axis=0), np.repeat(q, n, axis=0), np.repeat(yaw_std, n)
            samples = KINDS[kind](
                sensors["t"][rows], at, at, ps, qs, anchors, self._start, yaw_std=stds
            )
            bias, std, _, _ = corrector.contribution(samples)
            sensors = sensors.copy() if sensors is measured.sensors else sensors
            sensors["value"][rows, 0] -= bias
            sensors["std"][rows, 0] = np.hypot(sensors["std"][rows, 0], std)
        return sensors


def _slice_numbers(rows: np.ndarray) -> np.ndarray:
    """Return the number of the slice of each row, (n,)."""
    numbers: np.ndarray = np.floor(rows["t"] / SLICE)
    return numbers


class PipelineOutput(NamedTuple):
    """Store the result of one call of the filter.

    Attributes
    ----------
    measured : Measurements
        Measurements that were used.
    odometry : (n,) array of ODOMETRY
        Odometry from these measurements.
    tdoas, sensors : (k,) and (m,) array of RESIDUAL
        Outcome of each TDOA and of each measurement of SENSORS.
    """

    measured: Measurements
    odometry: np.ndarray
    tdoas: np.ndarray
    sensors: np.ndarray


class Pipeline:
    """Feed the measurements that a ReorderBuffer releases to the filter.

    Attributes
    ----------
    state : FilterState
        State of the filter.
    monitor : Monitor or None
        Search for changes; None if it is not needed.
    """

    def __init__(
        self,
        anchors: AnchorTable,
        config: FilterConfig,
        effects: EffectSet = EffectSet(),
        watched: bool = True,
        records: list[np.ndarray] | None = None,
    ) -> None:
        """Create a filter without measurements.

        Parameters
        ----------
        anchors : AnchorTable
            Anchors and their rows.
        config : FilterConfig
            Parameters of the filter.
        effects : EffectSet
            Known effects that the filter models itself, or that are subtracted from distances to
            anchors.
        watched : bool
            Create a Monitor even if no delay is compensated.
        records : list or None
            Receives the history of the filter (see engine.feed).
        """
        self._anchors, self._effects, self._records = anchors, effects, records
        self.state = self._new_state()
        self._corrections = RadioCorrections(effects, anchors)
        self.monitor = (
            Monitor(anchors, effects.covariance) if watched or config.compensate_changes else None
        )
        self.configure(config)

    def configure(self, config: FilterConfig) -> None:
        """Replace the FilterConfig."""
        self._config, self._parameters = config, config.parameters()
        if not config.compensate_changes:
            self.state.anchors["delay"] = self.state.anchors["delay_variance"] = 0.0

    def _new_state(self) -> FilterState:
        """Return the state of a filter without measurements, one row for each of the AnchorTable.

        Rows of absent anchors are placeholders: no TDOA refers to them.
        """
        anchors, present = self._anchors.anchors, self._anchors.present
        floor = self._effects.near_ground_delays(anchors)
        state = new_state(anchors.positions, self._effects.sensor_functions, floor)
        places = np.zeros(len(self._anchors), int)
        places[present] = np.arange(len(present))
        return state._replace(anchors=state.anchors[places])

    def change_anchors(self, gone: np.ndarray) -> None:
        """Adapt the filter to a changed AnchorTable.

        Parameters
        ----------
        gone : (k,) int array
            Rows of the anchors that are no longer present.
        """
        more, first = self._new_state(), len(self.state.anchors)
        self.state = self.state._replace(
            anchors=np.concatenate([self.state.anchors, more.anchors[first:]])
        )
        self.state.record.extent[:] = more.record.extent
        self._forget(gone)
        if self.monitor is not None:
            self.monitor.forget(gone)

    def _forget(self, gone: np.ndarray) -> None:
        """Remove all measurements of the anchors in rows (k,) from the state of the filter."""
        ekf = self.state.record
        self.state.anchors["heard"][gone] = -np.inf
        window = ekf["window"][: ekf["kept"]]
        others = window[~(np.isin(window["a"], gone) | np.isin(window["b"], gone))]
        if len(others):  # an empty window has no stamps to keep
            ekf["window"][: len(others)], ekf["kept"] = others, len(others)
        if ekf["ranged"]["anchor"][0] in gone:
            ekf["ranged"]["t"] = -np.inf

    def run(self, buffer: ReorderBuffer, until: float) -> list[PipelineOutput]:
        """Process the rows that a ReorderBuffer holds up to the stamp `until`, in s.

        With compensate_changes, each delay is compensated from the stamp at which the Monitor finds
        it.
        """
        parts = []
        while self._config.compensate_changes and self.monitor is not None and len(buffer):
            # the first slice begins with the first TDOA
            end = min(self.monitor.end, (math.floor(buffer.first / LENGTH) + 1.0) * LENGTH)
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
        """Return sentences on changes since the start of the flight."""
        return [] if self.monitor is None else self.monitor.alarms

    def set_pose(self, pose: np.ndarray) -> None:
        """Set the filter to a pose, (1,) of POSE, not older than the measurements used."""
        set_pose(self.state, self._parameters, pose)

    def _feed(self, measured: Measurements) -> list[PipelineOutput]:
        # Run the filter on measurements, slice by slice if ranges are corrected.
        if not any(map(len, measured)):
            return []
        parts = []
        for part in self._corrections.slices(measured):
            used = part if self._config.use_imu else part._replace(imu=part.imu[:0])
            fed = PipelineOutput(part, *feed(self.state, self._parameters, used, self._records))
            self._corrections.add_odometry(fed.odometry)
            parts.append(fed)
        if self.monitor is not None:
            self.monitor.add(odometry_of(parts), self.residuals(parts))
        return parts

    def residuals(self, parts: Sequence[PipelineOutput]) -> Residuals:
        """Return the Residuals of the TDOAs of several PipelineOutputs, in order of use."""
        tdoa = joined(TDOA, [part.measured.tdoa for part in parts])
        rows = joined(RESIDUAL, [part.tdoas for part in parts])
        ids = self._anchors.ids
        return Residuals.from_rows(tdoa["t"], ids[tdoa["a"]], ids[tdoa["b"]], rows)


def odometry_of(parts: Sequence[PipelineOutput]) -> Odometry:
    """Return the Odometry of several PipelineOutputs."""
    return Odometry.from_rows(joined(ODOMETRY, [part.odometry for part in parts]))
