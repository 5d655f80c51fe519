"""The residual of every channel of a flight: measured minus what the model says at the true, or estimated, motion."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import EffectSet, Samples, samples_at
from uwb_tdoa_bias.effects.catalogue import ImuGravity
from uwb_tdoa_bias.effects.covariates import OF_IMU, ImuFeatures
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_bias.foundation.geometry import tdoa, tdoa_jacobian

from ..scoring.metrics import airborne, position_at

IMU_CELL = 0.25  # s; both sides of an inertial residual are averaged over it (accelerometer: a triangle twice as wide)
MARGIN = 0.5  # s left out at both ends of the airborne part
GRAVITY = 9.81
SHIFT = 0.05  # s, for derivatives by time, of what was measured: noise of the truth would shrink what is fitted to them
STILL_FORCE, STILL_RATE = 0.3, 0.1  # m/s^2 of vibration and rad/s, below which the vehicle stands


@dataclass(frozen=True)
class TdoaResidual:
    """TDOAs in the air: samples, the (n,) residual d - geometry - effects, m, and its (n, 3) derivative by the
    position.
    rows : (n,) places in flight.tdoa; airborne : (n,) bool, False for those near the floor before and after."""

    samples: Samples
    residual: np.ndarray
    jacobian: np.ndarray
    rows: np.ndarray
    airborne: np.ndarray


@dataclass(frozen=True)
class ImuResidual:
    """One inertial channel in cells: t (n,) s; residual (n, 3) in body axes; true (n, 3) what it should have read;
    change (n, 3) its rate of change (gyroscope only); covariates (n, len(OF_IMU)) means over the cell; samples :
    Samples of the motion, for poses.
    is_accel : False for the gyroscope."""

    t: np.ndarray
    residual: np.ndarray
    true: np.ndarray
    change: np.ndarray | None
    covariates: np.ndarray
    samples: Samples
    is_accel: bool = False


@dataclass(frozen=True)
class FlightResiduals:
    """All residuals of one flight. gyro, accel : ImuResidual or None. flight : with corrected streams; truth : what the
    residuals were taken at; estimated : that is no ground truth but the filter's estimate."""

    flight: object
    truth: Truth
    tdoa: TdoaResidual
    gyro: ImuResidual | None
    accel: ImuResidual | None
    estimated: bool = False


def residuals(flight, effects=EffectSet(), estimate=None):
    """FlightResiduals of a Flight under the model `effects`, at its ground truth, or at `estimate` (an Odometry).

    Raises InputError where there is neither.
    """
    flight = effects.correct_streams(flight)
    if estimate is not None:
        truth = Truth(estimate.t, estimate.p, estimate.q)
    elif flight.truth is None or len(flight.truth) < 2:
        raise InputError(f"{flight.name}: holds no ground truth to compare with; give --no-truth.")
    else:
        truth = flight.truth
    first, last = airborne(truth)
    first, last = first + MARGIN, last - MARGIN
    if last - first < 5.0:
        raise InputError(f"{flight.name}: only {last - first:.1f} s of it are in the air; 5 s are needed.")
    tdoas = _tdoa(flight, truth, effects, first, last)
    gyro = accel = None
    if flight.imu is not None and estimate is not None:
        gyro = _rest(flight, truth)
    elif flight.imu is not None and np.isfinite(truth.q).all(axis=1).sum() > 10:
        gyro, accel = _imu(flight, truth, effects, first, last)
    return FlightResiduals(flight, truth, tdoas, gyro, accel, estimate is not None)


def _tdoa(flight, truth, effects, first, last):
    raw = flight.tdoa
    a, b = flight.anchors.index(raw.a), flight.anchors.index(raw.b)
    inside = (raw.t >= truth.t[0]) & (raw.t <= truth.t[-1])
    rows = np.flatnonzero((a >= 0) & (b >= 0) & (a != b) & np.isfinite(raw.d) & inside)
    samples = samples_at(raw.t[rows], a[rows], b[rows], truth, flight.anchors, float(raw.t[0]))
    interval = np.diff(raw.t, prepend=raw.t[0])[rows]
    previous = np.concatenate([[-1], raw.b[:-1]])[rows]
    vibration = None
    if flight.imu is not None:
        features = ImuFeatures()(flight.imu.t, flight.imu.gyro, flight.imu.accel)
        vibration = np.interp(samples.t, flight.imu.t, features[:, OF_IMU.index("vibration")])
    extra = _extra(flight, samples.t)
    samples = replace(samples, interval=interval, previous=previous, vibration=vibration, extra=extra)
    position_a, position_b = samples.position_a, samples.position_b
    residual = raw.d[rows] - tdoa(samples.p, position_a, position_b) - effects.bias(samples)
    flown = (samples.t >= first) & (samples.t <= last)
    return TdoaResidual(samples, residual, tdoa_jacobian(samples.p, position_a, position_b), rows, flown)


def _extra(flight, t):
    """Whatever else the log holds, at the stamps t: {"stream.column": (n,)}. What a simulation tells of itself is no
    log."""
    out = {}
    for name, columns in flight.extra.items():
        stamps = np.asarray(columns.get("t", ()), dtype=float)
        if name.endswith("_truth") or len(stamps) < 10:
            continue
        for column, values in columns.items():
            values = np.asarray(values)
            if column != "t" and values.dtype.kind in "fiu" and np.ptp(values) > 0:
                out[f"{name}.{column}"] = np.interp(t, stamps, values.astype(float))
    return out


def _imu(flight, truth, effects, first, last):
    imu = flight.imu
    features = ImuFeatures()(imu.t, imu.gyro, imu.accel)
    low, high = max(first, imu.t[0], truth.t[0]) + IMU_CELL, min(last, imu.t[-1], truth.t[-1]) - IMU_CELL
    edges = np.arange(low + SHIFT, high - SHIFT, IMU_CELL)
    centres = 0.5 * (edges[:-1] + edges[1:])
    inner = edges[1:-1]
    covariates = _means(imu.t, features, edges)
    rate = _true_rate(truth, edges)
    ends = [_means(imu.t, imu.gyro, edges + shift) for shift in (-SHIFT, SHIFT)]
    change = (ends[1] - ends[0]) / (2.0 * SHIFT)
    measured = _means(imu.t, imu.gyro, edges)
    gyro = ImuResidual(centres, measured - rate, rate, change, covariates, _poses(flight, truth, centres))

    at = _poses(flight, truth, inner)
    flown = np.flatnonzero((imu.t >= edges[0]) & (imu.t <= edges[-1]))
    t, accel = imu.t[flown], imu.accel[flown]
    world = Rotation.from_quat(_poses(flight, truth, t, False).q).apply(accel)
    turn = Rotation.from_quat(at.q).inv()
    p = position_at(edges, truth)
    acceleration = (p[2:] - 2.0 * p[1:-1] + p[:-2]) / IMU_CELL**2
    true = turn.apply(acceleration + [0.0, 0.0, GRAVITY])
    felt = turn.apply(_triangle(t, world, edges))
    excess = sum(effect.excess for effect in effects.effects if isinstance(effect, ImuGravity))
    felt -= excess * (turn.apply([0.0, 0.0, 1.0]) - [0.0, 0.0, 1.0])  # here the vertical is known; see ImuGravity
    average = 0.5 * (covariates[1:] + covariates[:-1])
    return gyro, ImuResidual(inner, felt - true, true, None, average, at, True)


def _rest(flight, truth):
    """The gyroscope before take-off, where the true rate is known without ground truth: ImuResidual, or None."""
    imu = flight.imu
    edges = np.arange(imu.t[0], imu.t[-1], IMU_CELL)
    features = ImuFeatures()(imu.t, imu.gyro, imu.accel)
    covariates, mean = _means(imu.t, features, edges), _means(imu.t, imu.gyro, edges)
    moving = (covariates[:, OF_IMU.index("vibration")] > STILL_FORCE) | (np.abs(mean).max(axis=1) > STILL_RATE)
    still = np.flatnonzero(np.cumsum(moving) == 0)[:-1]
    if len(still) < 4:
        return None
    centres, none = 0.5 * (edges[:-1] + edges[1:])[still], np.zeros((len(still), 3))
    return ImuResidual(centres, mean[still], none, none, covariates[still], _poses(flight, truth, centres))


def _poses(flight, truth, t, motion=True):
    none = np.zeros(len(t), dtype=int)
    return samples_at(t, none, none, truth, flight.anchors, float(flight.tdoa.t[0]), motion)


def _means(t, values, edges):
    """Means of (n, k) values over the intervals between edges: the integral of the linear interpolation."""
    dt = np.diff(t)[:, None]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]) * dt, axis=0)])
    at = np.stack([np.interp(edges, t, column) for column in total.T], axis=1)
    return np.diff(at, axis=0) / np.diff(edges)[:, None]


def _triangle(t, values, edges):
    """Means of (n, 3) values with the triangular window over two intervals, for every inner edge. With it, the mean
    of a second derivative is the second difference of the function: both sides of the accelerometer's residual see
    the same filter."""
    place = np.searchsorted(edges, t, side="right") - 1
    width = IMU_CELL
    out = np.zeros((len(edges), 3))
    total = np.zeros(len(edges))
    inside = (place >= 0) & (place < len(edges) - 1)
    part = np.where(inside, (t - edges[np.clip(place, 0, len(edges) - 1)]) / width, 0.0)
    for shift, weight in ((0, 1.0 - part), (1, part)):
        rows = place[inside] + shift
        total += np.bincount(rows, weight[inside], len(edges))
        for k in range(3):
            out[:, k] += np.bincount(rows, weight[inside] * values[inside, k], len(edges))
    return out[1:-1] / np.maximum(total[1:-1, None], 1e-9)


def _true_rate(truth, edges):
    """Mean turning rate in body axes between edges, (n, 3) rad/s: sums of the turns from pose to pose."""
    known = np.isfinite(truth.q).all(axis=1)
    t, first = np.unique(truth.t[known], return_index=True)
    turns = Rotation.from_quat(truth.q[known][first])
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    at = np.stack([np.interp(edges, t, column) for column in total.T], axis=1)
    return np.diff(at, axis=0) / np.diff(edges)[:, None]
