# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Smooth the filter's own run with a fixed-interval smoother: each estimate uses all measurements.

The smoother is the modified Bryson-Frazier recursion (Bierman, Fixed interval smoothing with
discrete measurements, Int. J. Control 1973). It runs backwards through the scalar updates in the
filter's history with the filter's robust weights. It inverts no covariance.
"""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import RADIO, EffectSet, true_samples

from .core import auxiliary, noise, plane
from .core.config import FilterConfig
from .core.history import RESET
from .core.hypotheses import YAW_STD
from .core.memory import ODOMETRY
from .core.state import ERROR_STATES, MOVING_STATES, inject
from .offline import Run, may_have_offset, run_offline, without_offset
from .results import Odometry

RANGE = "range"
LAGS = 64  # most ranges of one anchor over which their errors are compared
FEWEST_RANGES = 4 * LAGS  # of one anchor; fewer show no correlation
OUTLIER = 3.0  # standard deviations to which a residual is limited
ANY_DISTANCE = 1000.0  # m, and s: longer than errors of ranges stay alike


def smooth(
    flight: Flight, config: FilterConfig | None = None, corrector: Corrector | None = None
) -> Run:
    """Run bias correction, filter and smoother on a Flight and return the smoothed Run.

    The odometry has the stamps of updates, thinned to odometry_rate. Pressures are not used. If the
    yaw is unknown, the smoother uses the final yaw hypothesis from the start. An unknown common
    range offset (`range_offset_std`) is treated the same way and needs a second smoothing run. If
    the flight has ranges and no TDOAs, their correlation length is measured first
    (`correlation_length`). The memory is 3.5 kB per update.

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
    return replace(result, odometry=_with_persistent(Odometry.from_rows(smoothed), result.odometry))


def _with_persistent(smoothed: Odometry, online: Odometry) -> Odometry:
    """Return the smoothed Odometry with the covariance of errors that do not average out.

    The smoother does not average these errors out any more than the filter does. The covariance is
    therefore taken from the online estimate at the last stamp before.
    """
    if not len(online):
        return smoothed
    consider_covariance = online.consider_covariance[
        np.maximum(np.searchsorted(online.t, smoothed.t, side="right") - 1, 0)
    ]
    covariance = smoothed.covariance.copy()
    covariance[:, :3, :3] += consider_covariance
    return replace(smoothed, covariance=covariance, consider_covariance=consider_covariance)


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
    """Run the smoother backwards through records and return the number of rows written.

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
    count = 0
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
            _through_update(record, adjoint, information)
            _through_prediction(record.transition, adjoint, information)
    return count


@compiled
def _smoothed(record: Record, adjoint: np.ndarray, information: np.ndarray, row: Record) -> None:
    """Write the smoothed state x - P lambda and covariance P - P Lambda P to a row of ODOMETRY."""
    P = record.P
    correction = np.zeros(ERROR_STATES)  # -P lambda
    product = np.zeros((9, ERROR_STATES))  # upper rows of P Lambda
    for j in range(ERROR_STATES):
        for k in range(ERROR_STATES):
            correction[j] -= P[j, k] * adjoint[k]
    row.t = record.t
    row.rate[:], row.rate_variance[:] = np.nan, np.nan
    row.x[:] = record.x
    inject(row.x, correction, 1.0)
    for i in range(9):
        for k in range(ERROR_STATES):
            for j in range(ERROR_STATES):
                product[i, j] += P[i, k] * information[k, j]
    for i in range(9):
        for j in range(i, 9):
            reduction = 0.0
            for k in range(ERROR_STATES):
                reduction += product[i, k] * P[k, j]
            row.covariance[i, j] = row.covariance[j, i] = P[i, j] - reduction


@compiled
def _through_update(record: Record, adjoint: np.ndarray, information: np.ndarray) -> None:
    """Step `adjoint` and `information` backwards through one scalar update.

    The equations are lambda <- C' lambda - h' y / S and Lambda <- C' Lambda C + h' h / S with C = I -
    K h. In the code:

    - lambda, Lambda: adjoint, information
    - h, K: record.jacobian, record.gain
    - y, S: record.innovation and its record.variance
    """
    h, gain = record.jacobian, record.gain
    information_gain = np.zeros(ERROR_STATES)  # Lambda K
    for j in range(ERROR_STATES):
        for k in range(ERROR_STATES):
            information_gain[j] += information[j, k] * gain[k]
    # factors of h' and of h' h: K' lambda + y / S, and K' Lambda K + 1 / S
    adjoint_factor = record.innovation / record.variance
    information_factor = 1.0 / record.variance
    for k in range(ERROR_STATES):
        adjoint_factor += gain[k] * adjoint[k]
        information_factor += gain[k] * information_gain[k]
    for j in range(ERROR_STATES):
        adjoint[j] -= h[j] * adjoint_factor
        for k in range(ERROR_STATES):
            information[j, k] += (
                h[j] * h[k] * information_factor
                - h[j] * information_gain[k]
                - information_gain[j] * h[k]
            )


@compiled
def _through_prediction(
    transition: np.ndarray, adjoint: np.ndarray, information: np.ndarray
) -> None:
    """Step `adjoint` and `information` backwards through one prediction.

    The equations are lambda <- Phi' lambda and Lambda <- Phi' Lambda Phi. `transition` holds the upper
    rows of Phi; the lower rows equal the identity.
    """
    before = adjoint.copy()
    product = np.zeros((ERROR_STATES, ERROR_STATES))  # Lambda Phi
    for i in range(ERROR_STATES):
        product[i, MOVING_STATES:] = information[i, MOVING_STATES:]
        for k in range(MOVING_STATES):
            for j in range(ERROR_STATES):
                product[i, j] += information[i, k] * transition[k, j]
    adjoint[:MOVING_STATES] = 0.0
    information[:MOVING_STATES] = 0.0
    information[MOVING_STATES:] = product[MOVING_STATES:]
    for k in range(MOVING_STATES):
        for i in range(ERROR_STATES):
            adjoint[i] += transition[k, i] * before[k]
            for j in range(ERROR_STATES):
                information[i, j] += transition[k, i] * product[k, j]
