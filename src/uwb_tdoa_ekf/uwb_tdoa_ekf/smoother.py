"""Fixed-interval smoother over the filter's own run: every estimate from all measurements, before
and after it.

Modified Bryson-Frazier recursion (Bierman, Fixed interval smoothing with discrete measurements,
Int. J. Control 1973): backwards through the scalar updates of the filter's history, with its robust
weights, inverting no covariance.
"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

from .core import auxiliary, plane
from .core.config import FilterConfig
from .core.history import RESET
from .core.hypotheses import YAW_STD
from .core.memory import ODOMETRY
from .core.state import ERROR_STATES, MOVING_STATES, inject
from .offline import may_have_offset, run_offline, without_offset
from .results import Odometry

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.compiled import Record
    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.correction.corrector import Corrector

    from .offline import Run


def smooth(
    flight: Flight, config: FilterConfig | None = None, corrector: Corrector | None = None
) -> Run:
    """Run a Flight through bias correction, filter and smoother.

    Takes what run_offline takes and returns its Run with the odometry smoothed: at the stamps of
    updates, thinned to odometry_rate. Pressures are not used. If the yaw is unknown, the direction
    that the filter follows in the end counts from the beginning; so does the offset of all ranges,
    if it is unknown (`range_offset_std`): that takes a second smoothing. Memory: 3.5 kB per update.
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
    if offset is None:
        return _smoothed_run(flight, config, corrector)
    value, std = offset
    run, beside = (
        _smoothed_run(without_offset(flight, one), config, corrector)
        for one in (value, value + std)
    )
    return replace(
        run, odometry=_with_common_error(run.odometry, beside.odometry), range_offset=offset
    )


def _smoothed_run(flight: Flight, config: FilterConfig, corrector: Corrector | None) -> Run:
    """`smooth` where the yaw is known, and nothing of what `auxiliary.NONE` switches off is used."""
    records: list[np.ndarray] = []
    result = run_offline(flight, config, corrector, records)
    records = [part for part in records if len(part)]
    before = [-math.inf] + [
        part["t"][-1] for part in records
    ]  # stamp of the record before each array of them
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
    """The smoothed Odometry with what errors that do not average out make of its covariance:
    smoothing averages no more of them out than the filter does, so that it is the same as on line,
    at the last stamp before.
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
    """The smoothed Odometry with what an error that is the same all the time makes of its
    covariance; beside : Odometry with one standard deviation of that error more.
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
    """Through (n,) of RECORD from the end on; `before` : s, stamp of the record in front of them.

    adjoint (15,), information (15, 15): Bierman's lambda and Lambda, those behind the records,
    which become those in front of them. Fills (n,) of ODOMETRY from the end on, and returns how
    many.
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
    """Write x - P lambda and P - P Lambda P to one of ODOMETRY."""
    P = record.P
    correction = np.zeros(ERROR_STATES)  # -P lambda
    product = np.zeros((9, ERROR_STATES))  # upper rows of P Lambda
    for j in range(ERROR_STATES):
        for k in range(ERROR_STATES):
            correction[j] -= P[j, k] * adjoint[k]
    row.t = record.t
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
    """lambda <- C' lambda - h' y / S, Lambda <- C' Lambda C + h' h / S; C = I - K h, innovation y
    of variance S.
    """
    h, gain = record.row, record.gain
    information_gain = np.zeros(ERROR_STATES)  # Lambda K
    for j in range(ERROR_STATES):
        for k in range(ERROR_STATES):
            information_gain[j] += information[j, k] * gain[k]
    # K' lambda + y / S, K' Lambda K + 1 / S
    along, across = (record.innovation / record.variance, 1.0 / record.variance)
    for k in range(ERROR_STATES):
        along += gain[k] * adjoint[k]
        across += gain[k] * information_gain[k]
    for j in range(ERROR_STATES):
        adjoint[j] -= h[j] * along
        for k in range(ERROR_STATES):
            information[j, k] += (
                h[j] * h[k] * across - h[j] * information_gain[k] - information_gain[j] * h[k]
            )


@compiled
def _through_prediction(
    transition: np.ndarray, adjoint: np.ndarray, information: np.ndarray
) -> None:
    """lambda <- Phi' lambda, Lambda <- Phi' Lambda Phi; the lower rows of Phi are those of the
    identity.
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
