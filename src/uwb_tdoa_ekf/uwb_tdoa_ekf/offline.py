# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run bias correction and filter on a recording without ROS, with the results of the two nodes.

A Pipeline runs the filter and the Monitor on measurements in the order of their stamps, live and offline.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.samples import RADIO

from .anchor_table import AnchorTable
from .core.config import FilterConfig
from .core.engine import feed, set_pose
from .core.hypotheses import yaw_offset
from .core.memory import (
    INVALID,
    ODOMETRY,
    RESIDUAL,
    SENSOR_ROW,
    TDOA,
    FilterState,
    Measurements,
    imu_rows,
    joined,
    new_state,
    sensor_rows,
    structured,
    usable_tdoas,
)
from .core.sensors import STREAMS
from .monitoring.anchor_watch import LENGTH
from .monitoring.monitor import Monitor
from .reorder_buffer import FIRST_SENSOR, IMU_STREAM, TDOA_STREAM, ReorderBuffer
from .results import VERDICTS, Odometry, Residuals, poses_of

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


# TDOAs per call of the filter while a history is recorded; memory is reserved for the worst case
RECORDED_AT_ONCE = 256


@dataclass(frozen=True)
class Run:
    """Store the result of one recording.

    Attributes
    ----------
    odometry : Odometry
        Estimates.
    residuals : Residuals
        One row per TDOA of the flight, in its order.
    bias, bias_std : (n,) array
        Bias that was subtracted from each raw TDOA and its standard deviation, in m.
    recoveries : int
        How often the filter detected divergence and initialized again.
    yaw_offset : float
        Start of the correct yaw hypothesis minus initial_yaw, in rad, at the first start.
    sensors : dict
        {stream: (m,) of RESIDUAL}, one row per measurement, for the SENSORS in the flight.
    range_offset : (float, float) or None
        Common offset of all ranges and its standard deviation, in m, when its variance was
        smallest. Positive means that ranges are too long. The standard deviation covers noise
        alone. None if the filter did not estimate the offset.
    left_height : bool
        Whether TDOAs have contradicted `fixed_height`.
    """

    odometry: Odometry
    residuals: Residuals
    bias: np.ndarray
    bias_std: np.ndarray
    recoveries: int
    yaw_offset: float
    sensors: dict[str, np.ndarray]
    range_offset: tuple[float, float] | None = None
    left_height: bool = False

    @property
    def counts(self) -> dict[str, int]:
        """Return {verdict: number of TDOAs}."""
        return {
            name: int(np.sum(self.residuals.verdict == value)) for value, name in VERDICTS.items()
        }


def run_offline(
    flight: Flight,
    config: FilterConfig | None = None,
    corrector: Corrector | None = None,
    records: list[np.ndarray] | None = None,
    tdoas: list[np.ndarray] | None = None,
) -> Run:
    """Run bias correction and filter on a Flight and return a Run.

    Each measurement is corrected with earlier data only, as in the nodes. The filter restarts at
    each of the restarts of the Flight.

    Parameters
    ----------
    flight : Flight
        Recording.
    config : FilterConfig or None
        Parameters of the filter; defaults if None.
    corrector : Corrector or None
        Its stored poses are cleared first. None applies no correction.
    records : list or None
        Receives the history of the filter (see engine.feed).
    tdoas : list or None
        Receives the corrected TDOAs, in arrays of TDOA.
    """
    config = config or FilterConfig()
    corrector = corrector or Corrector(flight.anchors)
    corrector.reset()
    flight = corrector.effects.correct_streams(flight)
    tdoa, anchors = flight.tdoa, flight.anchors
    raw = tdoa.t, anchors.index(tdoa.a), anchors.index(tdoa.b), tdoa.d
    effects = EffectSet((*corrector.effects, *corrector.left_to_filter))
    anchor_table = AnchorTable(anchors)
    pipeline = Pipeline(anchor_table, config, effects, watched=False, records=records)
    buffer, places = loaded(flight, config)
    bias, std = np.zeros((2, len(tdoa)))
    parts: list[PipelineOutput] = []
    of_tdoas: list[
        np.ndarray
    ] = []  # places in the flight of usable TDOAs, in the order of their stamps
    recoveries = 0
    for batch, until, restart in _batches(
        *raw, corrector, len(tdoa) if records is None else RECORDED_AT_ONCE, flight.restarts
    ):
        if restart:  # the nodes start over here, because the stamps that they get fall back
            recoveries += int(pipeline.state.record.recoveries)
            pipeline = Pipeline(anchor_table, config, effects, watched=False, records=records)
            corrector.reset()
        t, a, b, d = (column[batch] for column in raw)
        correction = corrector.correct(t, a, b, d)
        bias[batch], std[batch] = correction.bias, correction.std
        variance = correction.std**2 + tdoa.variance[batch]
        rows = structured(
            TDOA, t, a, b, correction.corrected, variance, correction.slope, correction.state
        )
        usable = usable_tdoas(rows, anchors.positions)
        rows = rows if usable.all() else rows[usable]
        buffer.load(TDOA_STREAM, rows)
        if tdoas is not None:
            tdoas.append(rows)
        of_tdoas.append(batch[usable])
        fed = pipeline.run(buffer, until)
        parts += fed
        if corrector.uses_pose and fed:
            corrector.add_pose(*poses_of(odometry_of(fed)))
    outcome = _verdicts(len(tdoa), np.concatenate(of_tdoas), [part.tdoas for part in parts])
    residuals = Residuals.from_rows(tdoa.t, tdoa.a, tdoa.b, outcome)
    of_sensors = joined(RESIDUAL, [part.sensors for part in parts])
    sensors = {
        name: _verdicts(n, rows, [of_sensors[ranks]]) for name, (n, rows, ranks) in places.items()
    }
    ekf = pipeline.state.record
    offset, variance = ekf.range_offset.tolist()
    found = (offset, math.sqrt(variance)) if variance < math.inf else None
    return Run(
        odometry_of(parts),
        residuals,
        bias,
        std,
        recoveries + int(ekf.recoveries),
        yaw_offset(int(ekf.best if ekf.first_best < 0 else ekf.first_best)),
        sensors,
        found,
        bool(ekf.height.ignore_time > 0.0 and config.fixed_height_std > 0.0),
    )


def may_have_offset(flight: Flight, config: FilterConfig) -> bool:
    """Return whether the filter will estimate a common offset of all ranges of a Flight."""
    # FilterConfig takes in the parameters of SENSORS, so mypy does not find these fields.
    looked_for = config.use_range and config.range_offset_std > 0.0  # type: ignore[attr-defined]
    return looked_for and flight.range is not None and len(flight.range) > 0


def without_offset(flight: Flight, offset: float) -> Flight:
    """Return a Flight whose ranges are shorter by `offset`, in m."""
    return flight.replaced(range=replace(flight.range, d=flight.range.d - offset))


def without_unknown_offset(
    flight: Flight, config: FilterConfig, corrector: Corrector | None = None
) -> Flight:
    """Return a Flight without the common range offset that the filter estimates, if it does.

    The parameters are as for run_offline.
    """
    if not may_have_offset(flight, config):
        return flight
    offset = run_offline(flight, config, corrector).range_offset
    return flight if offset is None else without_offset(flight, offset[0])


def loaded(
    flight: Flight, config: FilterConfig
) -> tuple[ReorderBuffer, dict[str, tuple[int, np.ndarray, np.ndarray]]]:
    """Return a ReorderBuffer with the inertial samples and SENSORS of a Flight, and their places.

    Parameters
    ----------
    flight : Flight
        Recording with corrected streams.
    config : FilterConfig
        Selects the streams that are used.

    Returns
    -------
    buffer : ReorderBuffer
        Contains all rows that can be measurements.
    places : dict
        {stream: (number of rows, places of usable rows, their ranks)}. The places are in the order
        of their stamps. The ranks are among all rows of SENSORS that leave the buffer.
    """
    buffer = ReorderBuffer.of_recording()
    if flight.imu is not None and config.use_imu:
        rows, usable = imu_rows(flight.imu.t, flight.imu.gyro, flight.imu.accel)
        buffer.load(IMU_STREAM, rows[usable])
    felt, kept_of = [], {}
    for name in STREAMS:
        stream = getattr(flight, name)
        if stream is not None and getattr(config, f"use_{name}"):
            rows, usable = sensor_rows(name, stream, flight.anchors)
            (kept,) = np.nonzero(usable)
            kept = kept[np.argsort(rows["t"][kept], kind="stable")]
            felt.append(rows[kept])
            kept_of[name] = len(rows), kept
    together = joined(
        SENSOR_ROW, felt
    )  # merge into one stream, because one sort is faster than many
    together = together[np.lexsort((together["kind"], together["t"]))]
    buffer.load(FIRST_SENSOR, together)
    return buffer, {
        name: (*kept, np.flatnonzero(together["kind"] == STREAMS.index(name)))
        for name, kept in kept_of.items()
    }


def _verdicts(n: int, places: np.ndarray, outcomes: list[np.ndarray]) -> np.ndarray:
    """Return (n,) of RESIDUAL with the outcomes at their places; all other rows are invalid."""
    out = np.zeros(n, RESIDUAL)
    out["innovation"] = out["variance"] = np.nan
    out["verdict"] = INVALID
    out[places] = joined(RESIDUAL, outcomes)
    return out


def _batches(
    t: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    d: np.ndarray,
    corrector: Corrector,
    longest: int,
    restarts: Sequence[float],
) -> Iterator[tuple[np.ndarray, float, bool]]:
    """Yield batches of TDOAs that can be corrected and used together.

    A correction needs a pose that is `lag` old. TDOAs less than that apart can be corrected in one
    batch. The stamps are continuous: the reader has shifted them after each restart of the clock. No
    batch crosses a restart. Each part between restarts yields at least one batch, which may be empty.

    Parameters
    ----------
    t, a, b, d : (n,) array
        Stamps in s, rows of both anchors, distance differences in m.
    corrector : Corrector
        Gives the lag.
    longest : int
        Largest number of TDOAs per batch.
    restarts : sequence of float
        Shifted stamps, in s, of the first message after each restart of the clock.

    Yields
    ------
    places : int array
        Places of the TDOAs, in the order of their stamps.
    until : float
        Stamp up to which everything may be used afterwards, in s.
    restart : bool
        True for the first batch after a restart.
    """
    known = np.flatnonzero((a >= 0) & (b >= 0) & np.isfinite(d) & np.isfinite(t))
    if not (np.diff(t[known]) > 0.0).all():
        # TDOAs of one stamp are in the same order as in the nodes
        known = known[np.lexsort((d[known], b[known], a[known], t[known]))]
    stamps, first = t[known], 0
    lag = corrector.lag if corrector.uses_pose else math.inf
    for number, bound in enumerate([*sorted(restarts), math.inf]):
        last, restart = int(np.searchsorted(stamps, bound)), number > 0
        while True:
            end = last
            if first < last:
                pose_limit = int(np.searchsorted(stamps, stamps[first] + lag))
                end = min(pose_limit, first + longest, last)
            before = stamps[end] if end < last else bound
            yield known[first:end], math.nextafter(before, -math.inf), restart
            first, restart = end, False
            if first >= last:
                break
