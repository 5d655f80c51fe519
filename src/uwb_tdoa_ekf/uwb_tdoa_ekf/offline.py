# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run bias correction and filter on a recording without ROS, with the results of the two nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet

from .anchor_table import AnchorTable
from .core.config import FilterConfig
from .core.hypotheses import yaw_offset
from .core.memory import (
    INVALID,
    RESIDUAL,
    SENSOR_ROW,
    TDOA,
    imu_rows,
    joined,
    sensor_rows,
    structured,
    usable_tdoas,
)
from .core.sensors import STREAMS as SENSOR_NAMES
from .pipeline import Pipeline, PipelineOutput, odometry_of
from .reorder_buffer import FIRST_SENSOR, IMU_STREAM, TDOA_STREAM, ReorderBuffer
from .results import VERDICTS, Odometry, Residuals, poses_of

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
    """

    odometry: Odometry
    residuals: Residuals
    bias: np.ndarray
    bias_std: np.ndarray
    recoveries: int
    yaw_offset: float
    sensors: dict[str, np.ndarray]
    range_offset: tuple[float, float] | None = None

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
        buffer.load(TDOA_STREAM, rows if usable.all() else rows[usable])
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
    for name in SENSOR_NAMES:
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
        name: (*kept, np.flatnonzero(together["kind"] == SENSOR_NAMES.index(name)))
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
