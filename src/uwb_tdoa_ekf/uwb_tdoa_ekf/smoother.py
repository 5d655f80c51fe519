# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Smooth the filter's own run with a fixed-interval smoother: each estimate uses all measurements.

The smoother is the modified Bryson-Frazier recursion (Bierman, Fixed interval smoothing with
discrete measurements, Int. J. Control 1973). It runs backwards through the scalar updates in the
filter's history with the filter's robust weights. It inverts no covariance.

`record_innovations` computes how constant errors of TDOAs and ranges change the innovations of a run.
The path is marginalized. The derivative of the state by each parameter follows the recorded
transitions and gains, as the state does (B. Friedland, Treatment of bias in recursive filtering,
IEEE Trans. Automatic Control 14, 1969). A fit of innovations to these derivatives therefore uses
all that the filter used: IMU, process noise, and every other measurement.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.flight import Flight, Imu, Truth
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import RADIO, EffectSet, true_samples

from .core import auxiliary, horizon, inertial, noise, plane, workspace
from .core.config import FilterConfig
from .core.history import RESET
from .core.hypotheses import YAW_STD
from .core.initialization import FEWEST_OF_YAW, YAW_SECONDS
from .core.memory import ODOMETRY, RESIDUAL, USED, joined, new_state, structured
from .core.state import ERROR_STATES, MOVING_STATES, inject
from .offline import Run, may_have_offset, run_offline, without_offset, without_unknown_offset
from .results import OF_ROW, Odometry

RANGE = "range"
LAGS = 64  # most ranges of one anchor over which their errors are compared
FEWEST_RANGES = 4 * LAGS  # of one anchor; fewer show no correlation
OUTLIER = 3.0  # standard deviations to which a residual is limited
# extent of anchors along their normal, over the next larger one, below which they lie near a plane
FLAT = 0.2
ANY_DISTANCE = 1000.0  # m, and s: longer than errors of ranges stay alike


def smooth(
    flight: Flight, config: FilterConfig | None = None, corrector: Corrector | None = None
) -> Run:
    """Run bias correction, filter and smoother on a Flight and return the smoothed Run.

    The odometry has the stamps of updates, thinned to odometry_rate. Pressures are not used. If the
    yaw is unknown, the smoother uses the final yaw hypothesis from the start. An unknown common
    range offset (`range_offset_std`) is treated the same way and needs a second smoothing run. If
    the flight has ranges and no TDOAs, their correlation length is measured first
    (`correlation_length`). A tag alone that sends few TDOAs is smoothed by `horizon.smooth`. The memory is 3.5 kB per update.

    Parameters
    ----------
    flight : Flight
        Recording.
    config : FilterConfig or None
        As for run_offline.
    corrector : Corrector or None
        As for run_offline.
    """
    config, offset = replace(config or FilterConfig(), **auxiliary.NO_PRESSURE), None
    unknown_yaw = config.use_imu and config.initial_yaw_std > YAW_STD
    if unknown_yaw or may_have_offset(flight, config):
        first = run_offline(flight, config, corrector)
        offset = first.range_offset
        if unknown_yaw:
            yaw = math.remainder(config.initial_yaw + first.yaw_offset, 2.0 * math.pi)
            config = replace(config, initial_yaw=yaw, initial_yaw_std=YAW_STD)
    config = replace(config, **auxiliary.NONE)
    value, std = offset or (0.0, 0.0)
    nearer = flight if offset is None else without_offset(flight, value)
    if _is_alone(flight, config):
        return _smoothed_alone(flight, config, corrector)
    run = _smoothed_run(nearer, config, corrector)
    if nearer.range is not None and not len(nearer.tdoa) and len(run.odometry):
        corrector = corrector or Corrector(flight.anchors)
        length = correlation_length(nearer, run.odometry, corrector.effects)
        seconds = alike(length, nearer.range.t)
        if seconds > config.tdoa_correlation_time and config.adapt_noise:
            config = replace(
                config, tdoa_correlation_time=seconds, tdoa_correlation_distance=ANY_DISTANCE
            )
            run = _smoothed_run(nearer, config, corrector)
    if offset is None:
        return run
    beside = _smoothed_run(without_offset(flight, value + std), config, corrector)
    return replace(
        run, odometry=_with_common_error(run.odometry, beside.odometry), range_offset=offset
    )


def alike(length: float, t: np.ndarray) -> float:
    """Return the tdoa_correlation_time, s, at which `length` ranges with stamps t count as one.

    It inverts the variance inflation of a range in a filter that has learned nothing from TDOAs.
    """
    period = (t[-1] - t[0]) / max(len(t) - 1, 1)
    return float(min((2.0 * max(length - 1.0, 0.0) / noise.SHARE) ** 2 * period, ANY_DISTANCE))


def correlation_length(flight: Flight, odometry: Odometry, effects: EffectSet) -> float:
    """Return how many ranges count as one, because errors of one anchor persist.

    Reflections and bodies in the way change over seconds, and each anchor has its own. The errors
    are ranges minus distances along the smoothed path, without the median of each anchor. An
    exponential correlation that falls to 1/e after k ranges of an anchor has the length 2 k.

    Parameters
    ----------
    flight : Flight
        Recording with ranges.
    odometry : Odometry
        Smoothed estimates.
    effects : EffectSet
        Known errors of the recording.
    """
    path = Truth(odometry.t, odometry.p, odometry.q)
    flight = replace(effects.correct_streams(flight), truth=path)
    samples, rows = true_samples(flight, RADIO[RANGE])
    ranges = getattr(flight, RANGE)
    left = ranges.d[rows] - samples.predicted() - effects.bias(samples)
    left[(samples.t < path.t[0]) | (samples.t > path.t[-1])] = np.nan
    products = np.zeros(LAGS)
    for anchor in np.unique(samples.b):
        own = left[samples.b == anchor]
        own = own[np.isfinite(own)]
        if len(own) < FEWEST_RANGES:
            continue
        own = own - np.median(own)
        limit = OUTLIER * 1.4826 * np.median(np.abs(own))
        own = np.clip(own, -limit, limit)
        products += [np.dot(own[: len(own) - lag], own[lag:]) for lag in range(LAGS)]
    fallen = np.flatnonzero(products < math.exp(-1.0) * products[0])
    if not products[0] > 0.0:
        return 1.0
    return 2.0 * float(fallen[0] if len(fallen) else LAGS)


def _is_alone(flight: Flight, config: FilterConfig) -> bool:
    """Return whether a tag sends few TDOAs, and no other sensor is used, or an IMU that is quiet."""
    rate = len(flight.tdoa) / max(flight.duration, 1e-9)
    imu = flight.imu if config.use_imu and not _is_quiet(flight.imu) else None
    headless = imu is None and config.initial_yaw_std > YAW_STD
    velocity = None if headless and rate < FEWEST_OF_YAW / YAW_SECONDS else flight.velocity
    measured = any(other is not None for other in (velocity, flight.range, flight.height, imu))
    return rate < horizon.BEGINS and config.adapt_noise and not measured


def _is_quiet(imu: Imu | None) -> bool:
    """Return whether a tag rests in the whole recording, by its inertial samples."""
    if imu is None or not len(imu.t):
        return True
    turning = np.sqrt(np.mean(imu.gyro**2, axis=0)) > inertial.QUIET_GYRO
    return not (turning | (imu.accel.std(axis=0) > inertial.QUIET_ACCEL)).any()


def _smoothed_alone(flight: Flight, config: FilterConfig, corrector: Corrector | None) -> Run:
    """Return the Run of a tag alone with few TDOAs, smoothed by `horizon.smooth`."""
    parts: list[np.ndarray] = []
    run = run_offline(flight, config, corrector, tdoas=parts)
    tdoas = np.unique(np.concatenate(parts))  # sorted by stamp, without repeats
    path = run.odometry
    begin = np.stack([np.interp(tdoas["t"], path.t, axis) for axis in path.p.T], axis=1)
    state = new_state(flight.anchors.positions)
    begins = [begin, *_on_both_sides(begin, flight.anchors.positions)]
    bounds = np.empty((2, 3))
    workspace.set_bounds(state.record.extent, config.workspace_margin, bounds)
    parameters = config.parameters()
    bounds = horizon.within(bounds, parameters[0], run.left_height)
    rows = horizon.smooth(tdoas, state.anchors, parameters, bounds, np.array(begins))
    if config.planar:
        plane.flatten_all(rows, parameters)
    number = np.floor(rows["t"] * config.odometry_rate)
    rows = rows[np.append(number[1:] != number[:-1], True)]
    last = np.maximum(np.searchsorted(path.t, rows["t"], side="right") - 1, 0)
    rows["x"][:, 6:] = np.hstack([path.q, path.accel_bias, path.gyro_bias])[last]
    rows["covariance"][:, 6:, 6:] = path.covariance[last, 6:, 6:]
    rows["rate"], rows["rate_variance"] = path.rate[last], path.rate_variance[last]
    return replace(run, odometry=_with_persistent(Odometry.from_rows(rows), path))


def _on_both_sides(path: np.ndarray, anchors: np.ndarray) -> list[np.ndarray]:
    """Return a path (n, 3), m, reflected to either side of anchors (N, 3) that lie near a plane.

    TDOAs of such anchors hardly distinguish the sides, so a path may cross to the wrong side. Other
    anchors give no path.
    """
    middle = anchors.mean(axis=0)
    _, extents, axes = np.linalg.svd(anchors - middle, full_matrices=False)
    if len(extents) < 3 or extents[2] > FLAT * extents[1]:
        return []
    height = ((path - middle) @ axes[2])[:, None]
    return [path + (sign * np.abs(height) - height) * axes[2] for sign in (-1.0, 1.0)]


def _smoothed_run(flight: Flight, config: FilterConfig, corrector: Corrector | None) -> Run:
    """Return the smoothed Run for a known yaw and a config changed by auxiliary.NONE."""
    records: list[np.ndarray] = []
    result = run_offline(flight, config, corrector, records)
    records = [part for part in records if len(part)]
    # stamp of the record before each array of records
    before = [-math.inf, *(part["t"][-1] for part in records)]
    adjoint, information = np.zeros(ERROR_STATES), np.zeros((ERROR_STATES, ERROR_STATES))
    rows = [np.empty(0, ODOMETRY)]
    for k in reversed(range(len(records))):
        room = np.zeros(len(records[k]), ODOMETRY)
        count = _backward(records[k], before[k], config.odometry_rate, adjoint, information, room)
        rows.append(room[len(room) - count :])
    smoothed = np.concatenate(rows[::-1])
    if config.planar:
        plane.flatten_all(smoothed, config.parameters())
    odometry = _with_persistent(Odometry.from_rows(smoothed), result.odometry)
    places = flight.anchors.positions
    return replace(result, odometry=_with_curvature(odometry, result.odometry, places))


def _with_persistent(smoothed: Odometry, online: Odometry) -> Odometry:
    """Return the smoothed Odometry with the covariance of errors that do not average out.

    The smoother does not average these errors out any more than the filter does. The covariance is
    therefore taken from the online estimate at the last stamp before.
    """
    if not len(online):
        return smoothed
    consider_covariance = online.consider_covariance[_last(online, smoothed)]
    covariance = smoothed.covariance.copy()
    covariance[:, :3, :3] += consider_covariance
    return replace(smoothed, covariance=covariance, consider_covariance=consider_covariance)


def _with_curvature(smoothed: Odometry, online: Odometry, anchors: np.ndarray) -> Odometry:
    """Return the smoothed Odometry with a covariance nearer to the online one where TDOAs are curved.

    The smoother takes TDOAs for linear. A position with the deviation s, at the distance r from the
    anchors, is off its linearized TDOAs by about s^2 / (2 r). The squared ratio of that to s is the
    share of the online covariance. It is nothing where the position is known to a metre.

    Parameters
    ----------
    smoothed, online : Odometry
        Estimates of the smoother and of the filter.
    anchors : (N, 3) array
        Positions, in m.
    """
    if not len(online):
        return smoothed
    last, middle = _last(online, smoothed), anchors.mean(axis=0)
    P, extent = online.covariance[last, :3, :3], np.sum(anchors.var(axis=0))
    squared = np.sum((online.p[last] - middle) ** 2, axis=1) + extent
    share = np.minimum(np.trace(P, axis1=1, axis2=2) / (4.0 * squared), 1.0)[:, None, None]
    covariance = smoothed.covariance.copy()
    covariance[:, :3, :3] += share * (P - covariance[:, :3, :3])
    return replace(smoothed, covariance=covariance)


def _last(online: Odometry, smoothed: Odometry) -> np.ndarray:
    """Return the place of the last online estimate before each smoothed one, (n,) int."""
    return np.maximum(np.searchsorted(online.t, smoothed.t, side="right") - 1, 0)


def _with_common_error(smoothed: Odometry, beside: Odometry) -> Odometry:
    """Return the smoothed Odometry with the covariance of an error that is constant in time.

    Parameters
    ----------
    smoothed : Odometry
        Smoothed estimates.
    beside : Odometry
        Smoothed estimates with the error larger by one standard deviation.
    """
    if not len(smoothed) or not len(beside):
        return smoothed
    off = (
        np.stack([np.interp(smoothed.t, beside.t, column) for column in beside.p.T], axis=1)
        - smoothed.p
    )
    common, covariance = off[:, :, None] * off[:, None, :], smoothed.covariance.copy()
    covariance[:, :3, :3] += common
    return replace(
        smoothed, covariance=covariance, consider_covariance=smoothed.consider_covariance + common
    )


@compiled
def _backward(
    records: np.ndarray,
    before: float,
    rate: float,
    adjoint: np.ndarray,
    information: np.ndarray,
    rows: np.ndarray,
) -> int:
    """Run the smoother backwards through records, and return the number of rows written.

    Parameters
    ----------
    records : (n,) array of RECORD
        History in the order of stamps.
    before : float
        Stamp of the record before these, in s.
    rate : float
        Output rate, in Hz.
    adjoint : (15,) array
        Bierman's lambda after the records; replaced by the value before them.
    information : (15, 15) array
        Bierman's Lambda after the records; replaced by the value before them.
    rows : (n,) array of ODOMETRY
        Filled from its end.
    """
    count, scratch = 0, np.empty(ERROR_STATES)
    for i in range(len(records) - 1, -1, -1):
        record = records[i]
        earlier = records[i - 1].t if i > 0 else before
        if np.floor(record.t * rate) != np.floor(earlier * rate):
            count += 1
            _smoothed(record, adjoint, information, rows[len(rows) - count])
        if record.kind == RESET:
            adjoint[:] = 0.0
            information[:, :] = 0.0
        else:
            horizon.through_update(record, adjoint, information, True, scratch)
            _through_prediction(record.transition, adjoint, information)
    return count


@compiled
def _smoothed(record: Record, adjoint: np.ndarray, information: np.ndarray, row: Record) -> None:
    """Write the smoothed state x - P lambda and covariance P - P Lambda P to a row of ODOMETRY."""
    P = record.P
    row.t = record.t
    row.rate[:], row.rate_variance[:] = np.nan, np.nan
    row.x[:] = record.x
    inject(row.x, -np.dot(P, adjoint), 1.0)
    covariance = P - np.dot(np.dot(P, information), P)
    row.covariance[:] = 0.5 * (covariance + covariance.T)[:9, :9]


@compiled
def _through_prediction(
    transition: np.ndarray, adjoint: np.ndarray, information: np.ndarray
) -> None:
    """Step `adjoint` and `information` backwards through one prediction.

    The equations are lambda <- Phi' lambda and Lambda <- Phi' Lambda Phi. `transition` holds the upper
    rows of Phi; the lower rows equal the identity.
    """
    Phi = np.eye(ERROR_STATES)
    Phi[:MOVING_STATES] = transition
    adjoint[:] = np.dot(Phi.T, adjoint)
    information[:] = np.dot(np.dot(Phi.T, information), Phi)


# names of streams: TDOAs, which are not in SENSORS, and ranges
TDOAS, RANGES = ("tdoa", "range")
NEEDED = "t", "kind", "transition", "jacobian", "gain", "innovation"  # fields of a history record
# s after which a parameter without further measurements no longer affects the estimate
FORGOTTEN = 10.0


@dataclass(frozen=True, eq=False)
class Innovations:
    """Store the innovations of some streams of one run.

    Attributes
    ----------
    streams : tuple of str
        Names of the streams.
    stream : (n,) int array
        Stream of each innovation, as a place in `streams`.
    rows : (n,) int array
        Row of the measurement in its stream. Only used measurements are listed, in the order of
        their stamps.
    t : (n,) array
        Stamps, in s.
    value : (n,) array
        Innovations, in m.
    variance : (n,) array
        Variance of the innovation, in m^2: of the prediction plus one measurement.
    run : Run
        Result of the filter.
    records : list of arrays
        History of the run; empty if no derivatives are wanted.
    of : list of (m,) int arrays
        For each record the place in `rows`, or -1 for other records.
    """

    streams: tuple[str, ...]
    stream: np.ndarray
    rows: np.ndarray
    t: np.ndarray
    value: np.ndarray
    variance: np.ndarray
    run: Run
    records: list
    of: list

    def places(self, stream: str) -> np.ndarray:
        """Return the places of the innovations of one stream, (m,) int."""
        return np.flatnonzero(self.stream == self.streams.index(stream))

    def by_bias(self, regressors: np.ndarray) -> np.ndarray:
        """Return the derivative of the innovations by parameters of a bias, (n, k).

        The measured values contain the bias, and the run did not model it. A correction of the bias
        changes the innovations by minus this. The result is what remains of the regressors after
        the filter has followed the bias. A bias that the position can follow does not change the
        innovations.

        Parameters
        ----------
        regressors : (n, k) array
            Derivative of the measured values by the parameters.
        """
        regressors = np.ascontiguousarray(regressors, dtype=float)
        out, states = np.zeros_like(regressors), np.zeros((2, ERROR_STATES, regressors.shape[1]))
        no_path = np.empty(0), np.empty((0, 3, regressors.shape[1]))
        for records, of in zip(self.records, self.of):
            _propagate(records, of, regressors, states, out, no_path, 0)
        return out

    def in_blocks(
        self,
        regressors: csr_array,
        block: np.ndarray,
        stamps: ArrayLike = (),
        positions: np.ndarray | None = None,
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield the result of `by_bias` for one block of measurements at a time.

        Each block costs only as much as the parameters that matter there. A parameter matters until
        FORGOTTEN s after the last measurement that depends on it.

        Parameters
        ----------
        regressors : (n, k) sparse array
            Stored by rows; as for `by_bias`.
        block : (n,) int array
            Ascending block number of each row.
        stamps : (m,) array
            Ascending stamps of positions, in s.
        positions : (m, 3, k) array or None
            Filled with the derivatives of the estimated position at the stamps, as of `by_bias`: a
            correction moves the estimate by minus this.

        Yields
        ------
        rows : slice
            Rows of the block.
        columns : (c,) int array
            Parameters that matter in the block.
        derivative : (rows, c) array
            Derivative of the innovations.
        """
        stamps, t = np.asarray(stamps, dtype=float), self.t
        ends = np.append(np.flatnonzero(np.diff(block)) + 1, len(block))
        state = np.zeros((ERROR_STATES, regressors.shape[1]))
        last = np.full(regressors.shape[1], -np.inf)
        pieces, passed, first = _pieces(self.records, self.of, ends), 0, 0
        for end, piece in zip(ends.tolist(), pieces):
            rows = slice(first, end)
            last[regressors.indices[regressors.indptr[first] : regressors.indptr[end]]] = t[end - 1]
            columns = np.flatnonzero(last >= t[first] - FORGOTTEN)
            states = np.zeros((2, ERROR_STATES, len(columns)))
            states[0], state[:] = state[:, columns], 0.0
            known = regressors[rows][:, columns].toarray()
            path = stamps, np.zeros((len(stamps), 3, len(columns)))
            out, before = np.zeros_like(known), passed
            for records, of in piece:
                own = np.where(of >= 0, of - first, -1)
                passed = _propagate(records, own, known, states, out, path, passed)
            state[:, columns] = states[0]
            if positions is not None and passed > before:
                positions[before:passed, :, columns] = path[1][before:passed]
            yield rows, columns, out
            first = end


def _pieces(
    records: Sequence[np.ndarray], of: Sequence[np.ndarray], ends: np.ndarray
) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Return [[(records, of)]] for each block of rows.

    A block includes all records before the first row of the next block.

    Parameters
    ----------
    records, of : sequence of arrays
        As in Innovations.
    ends : (b,) int array
        End of each block of rows, exclusive.
    """
    out: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in ends]
    now = 0
    for some, places in zip(records, of):
        number = np.maximum.accumulate(
            np.where(places >= 0, np.searchsorted(ends, places, side="right"), now)
        )
        for k in np.unique(number):
            first, last = np.searchsorted(number, [k, k + 1])
            out[k].append((some[first:last], places[first:last]))
        now = number[-1] if len(number) else now
    return out


class _Needed(list):
    """Collect arrays of a history, reduced to the fields that `_propagate` reads.

    This saves more than half of the memory.
    """

    def append(self, records: np.ndarray) -> None:
        super().append(repack_fields(records[[*NEEDED]]))


def record_innovations(
    flight: Flight,
    config: FilterConfig | None = None,
    corrector: Corrector | None = None,
    streams: Sequence[str] = (TDOAS,),
    derivatives: bool = True,
) -> Innovations:
    """Run bias correction and filter on a Flight without its pressure and return Innovations.

    An unknown common offset of all ranges (`range_offset_std`) is estimated first and subtracted.
    If ranges are among `streams`, the offset stays a parameter instead.

    Parameters
    ----------
    flight : Flight
        Recording.
    config : FilterConfig or None
        As for run_offline.
    corrector : Corrector or None
        As for run_offline.
    streams : sequence of str
        TDOAS, and names of SENSORS. Streams that the flight lacks or the filter does not use are
        ignored.
    derivatives : bool
        Whether to record the history, from which the Innovations compute derivatives.
    """
    corrector = corrector or Corrector(flight.anchors)
    config = replace(config or FilterConfig(), **auxiliary.NO_PRESSURE)
    if RANGES not in streams:
        flight = without_unknown_offset(flight, config, corrector)
    config = replace(config, **auxiliary.NONE)
    records = _Needed()
    run = run_offline(flight, config, corrector, records if derivatives else None)
    streams = [name for name in streams if name == TDOAS or name in run.sensors]
    corrected = corrector.effects.correct_streams(flight)
    of_tdoas = structured(RESIDUAL, *(getattr(run.residuals, name) for name in OF_ROW))
    sources = [of_tdoas if name == TDOAS else run.sensors[name] for name in streams]
    outcomes = joined(RESIDUAL, sources)
    stamps = np.concatenate([getattr(corrected, name).t for name in streams])
    used = np.flatnonzero(outcomes["verdict"] == USED)
    used = used[np.argsort(stamps[used], kind="stable")]
    t, value = stamps[used], outcomes["innovation"][used]
    first = np.cumsum([0, *map(len, sources[:-1])])
    stream = np.searchsorted(first, used, side="right") - 1
    return Innovations(
        tuple(streams),
        stream,
        used - first[stream],
        t,
        value,
        outcomes["variance"][used],
        run,
        records,
        _places_of(records, t, value),
    )


def _places_of(records: Sequence[np.ndarray], t: np.ndarray, value: np.ndarray) -> list[np.ndarray]:
    """Return Innovations.of for records and the stamps and values, (n,), of innovations."""
    waiting: dict[tuple[float, float], list[int]] = {}
    for place, key in enumerate(zip(t.tolist(), value.tolist()) if records else ()):
        waiting.setdefault(key, []).append(place)
    of = []
    for some in records:
        keys = zip(some["t"].tolist(), some["innovation"].tolist())
        of.append(
            np.array(
                [waiting[key].pop(0) if waiting.get(key) else -1 for key in keys], dtype=np.int64
            )
        )
    return of


@compiled
def _propagate(
    records: np.ndarray,
    of: np.ndarray,
    regressors: np.ndarray,
    states: np.ndarray,
    out: np.ndarray,
    path: tuple[np.ndarray, np.ndarray],
    passed: int,
) -> int:
    """Propagate derivatives through records and return how many of the stamps are passed.

    Parameters
    ----------
    records : (r,) array
        Records of the history.
    of : (r,) int array
        Row of `regressors` for each record, or -1.
    regressors : (n, k) array
        Derivative of the measured values by the parameters.
    states : (2, 15, k) array
        Derivative of the estimated state by the parameters, and room for the next one.
    out : (n, k) array
        Filled with derivatives of the innovations.
    path : ((m,) array, (m, 3, k) array)
        Stamps, in s, and position derivatives to fill.
    passed : int
        Number of stamps that are already passed.
    """
    stamps, positions = path[0], path[1]
    before, after = states[0], states[1]
    n = regressors.shape[1]
    change = np.empty(n)  # row by row below: loops over the parameters are vectorized
    for i in range(len(records)):
        record = records[i]
        while passed < len(stamps) and stamps[passed] < record.t:
            positions[passed] = before[:3]
            passed += 1
        if record.kind == RESET:
            before[:, :] = 0.0
            continue
        for r in range(ERROR_STATES):
            for j in range(n):
                after[r, j] = before[r, j] if r >= MOVING_STATES else 0.0
        for r in range(MOVING_STATES):
            for c in range(ERROR_STATES):
                step = record.transition[r, c]
                if step != 0.0:
                    for j in range(n):
                        after[r, j] += step * before[c, j]
        place = of[i]
        for j in range(n):
            change[j] = regressors[place, j] if place >= 0 else 0.0
        for c in range(ERROR_STATES):
            entry = record.jacobian[c]
            for j in range(n):
                change[j] -= entry * after[c, j]
        if place >= 0:
            out[place] = change
        for r in range(ERROR_STATES):
            gain = record.gain[r]
            for j in range(n):
                after[r, j] += gain * change[j]
        before[:, :] = after
    return passed
