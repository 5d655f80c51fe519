# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Channels of gyroscope and accelerometer: residuals of means over cells, axis by axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Imu, Truth
from uwb_tdoa_bias.effects import ImuSamples
from uwb_tdoa_bias.effects.samples import OF_IMU
from uwb_tdoa_ekf.core.state import GRAVITY

from .base import Comparison
from .sensor import CELL, AxesChannel, AxesResidual
from .views import CovariateView, extra_at, extra_names, views_of_axes

# s, half the step of time derivatives of measured rates: true rates are noisy, and noise in
# a regressor shrinks the estimate
SHIFT = 0.05
STILL_FORCE, STILL_RATE = 0.3, 0.1  # m/s^2 of vibration and rad/s, of a vehicle at rest
STILL_CHANGE = 0.02  # rad/s, the same for the change of the rate since the start
BEGINNING = 2  # cells before a motion that do not count as rest
RATES = [column for column, name in enumerate(OF_IMU) if name.startswith("rate_")]
TURNING = [OF_IMU.index("turning_rate"), *RATES]
TRUE_SHARE = 0.5  # of the variance of a measured rate; with a smaller true share it does not turn
FEWEST_CELLS = 4  # cells at the start that define the rate at rest; fewest cells at rest
OF_POSE = ("x", "y", "height", "speed", "climb_rate", "acceleration")  # covariates of TDOAs too


class Inertial(AxesChannel):
    """The channel of an inertial sensor."""

    stream = "imu"
    axes = (".x", ".y", ".z")

    def covariates(self, residuals: Sequence[AxesResidual]) -> Sequence[str]:
        return (*OF_IMU, *OF_POSE, *extra_names([part.samples for part in residuals]))

    def views(self, residuals: Sequence[AxesResidual]) -> list[CovariateView]:
        axis = np.concatenate([np.repeat(np.arange(3), len(part.samples)) for part in residuals])
        values = {}
        for name in self.covariates(residuals):
            known = (part.covariate(name) for part in residuals)
            values[name] = np.concatenate([np.tile(one, 3) for one in known if one is not None])
        return views_of_axes(self.labels, values, axis)

    def _samples(
        self,
        comparison: Comparison,
        t: np.ndarray,
        reading: np.ndarray,
        features: np.ndarray,
        time_derivative: np.ndarray | None = None,
    ) -> ImuSamples:
        """Return ImuSamples of this channel at the middles t (n,), s, of cells."""
        track = comparison.track
        q = track.attitudes(t)
        up = np.full((len(t), 3), [0.0, 0.0, 1.0])
        known = np.isfinite(q).all(axis=1)
        if known.any():
            up[known] = Rotation.from_quat(q[known]).inv().apply([0.0, 0.0, 1.0])
        return ImuSamples(
            self.name,
            t,
            track.positions(t),
            comparison.start,
            reading,
            time_derivative,
            up,
            track.motion(t),
            features,
            extra_at(comparison.flight, t),
        )


class Gyro(Inertial):
    """Mean turning rates of cells minus the true rates.

    Without a known attitude only cells before take-off count: a vehicle at rest does not turn.
    """

    name = "gyro"
    unit = "rad/s"
    needs = "a gyroscope, and ground truth of the attitude or some seconds at rest before take-off"
    negligible = 5e-4

    def residual(self, comparison: Comparison) -> AxesResidual | None:
        imu, poses = comparison.flight.imu, comparison.poses
        if imu is None:
            return None
        if not comparison.reference.attitude_known:
            return self._at_rest(comparison, imu)
        if not comparison.attitude_known:
            return None
        edges = cells_in_the_air(comparison, imu)
        measured = means(imu.t, imu.gyro, edges)
        true = _true_rates(poses, edges)
        features = means(imu.t, comparison.imu_features, edges)
        before, after = (means(imu.t, imu.gyro, edges + shift) for shift in (-SHIFT, SHIFT))
        derivative = (after - before) / (2 * SHIFT)
        # About an axis without turns the measured rate is the residual: a function of itself.
        still = ~_turns(measured, true)
        reading = np.where(still, 0.0, measured)
        derivative[:, still] = 0.0
        features[:, RATES] = np.where(still, 0.0, features[:, RATES])
        speeds = (np.linalg.norm(rates, axis=1, keepdims=True) for rates in (measured, true))
        if not _turns(*speeds)[0]:
            features[:, OF_IMU.index("turning_rate")] = 0.0
        middles = 0.5 * (edges[:-1] + edges[1:])
        samples = self._samples(comparison, middles, reading, features, derivative)
        error = measured - true - comparison.effects.uncorrected(samples)
        return AxesResidual(samples, error, self.labels, self.unit)

    def _at_rest(self, comparison: Comparison, imu: Imu) -> AxesResidual | None:
        edges = np.arange(imu.t[0], imu.t[-1], CELL)
        features = means(imu.t, comparison.imu_features, edges)
        measured = means(imu.t, imu.gyro, edges)
        change = measured - np.median(measured[:FEWEST_CELLS], axis=0)
        moving = features[:, OF_IMU.index("vibration")] > STILL_FORCE
        moving |= np.abs(measured).max(axis=1) > STILL_RATE
        moving |= np.abs(change).max(axis=1) > STILL_CHANGE
        still = np.flatnonzero(np.cumsum(moving) == 0)[:-BEGINNING]
        if len(still) < FEWEST_CELLS:
            return None
        middles = 0.5 * (edges[:-1] + edges[1:])[still]
        measured, features = measured[still], features[still]
        features[:, TURNING] = 0.0  # the measured rate is the residual
        nothing = np.zeros_like(measured)
        samples = self._samples(comparison, middles, nothing, features, nothing)
        error = measured - comparison.effects.uncorrected(samples)
        return AxesResidual(samples, error, self.labels, self.unit)


def _turns(measured: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return whether measured rates (n, k) follow true ones (n, k), (k,) bool."""
    one, other = measured - measured.mean(axis=0), true - true.mean(axis=0)
    turns: np.ndarray = np.sum(one * other, axis=0) > TRUE_SHARE * np.sum(one**2, axis=0)
    return turns


def _true_rates(truth: Truth, edges: np.ndarray) -> np.ndarray:
    """Return mean turning rates between edges, (n, 3) rad/s, body, from pose to pose."""
    known = np.isfinite(truth.q).all(axis=1)
    t, first = np.unique(truth.t[known], return_index=True)
    turns = Rotation.from_quat(truth.q[known][first])
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    at = np.stack([np.interp(edges, t, column) for column in total.T], axis=1)
    return np.diff(at, axis=0) / np.diff(edges)[:, None]


class Accel(Inertial):
    """Specific force, averaged with a triangular window, minus the true specific force.

    The second difference of true positions is the same average of the true acceleration.
    """

    name = "accel"
    unit = "m/s^2"
    needs = "an accelerometer, and ground truth of position and attitude"
    negligible = 0.01

    def residual(self, comparison: Comparison) -> AxesResidual | None:
        imu = comparison.flight.imu
        if imu is None or not (
            comparison.attitude_known and all(comparison.reference.positions_known)
        ):
            return None
        track, edges = comparison.track, cells_in_the_air(comparison, imu)
        middles = edges[1:-1]
        to_body = Rotation.from_quat(track.attitudes(middles)).inv()
        positions = track.positions(edges)
        acceleration = (positions[2:] - 2.0 * positions[1:-1] + positions[:-2]) / CELL**2
        true = to_body.apply(acceleration + [0.0, 0.0, GRAVITY])
        flown = (imu.t >= edges[0]) & (imu.t <= edges[-1])
        world = Rotation.from_quat(track.attitudes(imu.t[flown])).apply(imu.accel[flown])
        measured = to_body.apply(_triangular_means(imu.t[flown], world, edges))
        features = means(imu.t, comparison.imu_features, edges)
        force = _apart(measured, true, comparison.poses)
        samples = self._samples(comparison, middles, force, 0.5 * (features[1:] + features[:-1]))
        measured = measured - comparison.effects.uncorrected(samples)
        return AxesResidual(samples, measured - true, self.labels, self.unit)


def _apart(measured: np.ndarray, true: np.ndarray, truth: Truth) -> np.ndarray:
    """Return forces (n, 3), m/s^2, whose noise is not that of `measured - true`, both (n, 3).

    Noise that a regressor shares with the residual looks like a scale. The mean that is weighted by
    inverse variances shares none (Deming 1943). Third differences of the Truth show the noise of a
    position, changes of the residual from cell to cell show the noise of both.
    """
    of_position = float(_spread(np.diff(truth.p, 3, axis=0).ravel())) ** 2 / 20.0
    both = _spread(np.diff(measured - true, axis=0)) ** 2
    of_true = np.minimum(of_position / CELL**4, both / 20.0)
    of_measured = np.maximum((both - 20.0 * of_true) / 1.5, 1e-12)
    share = 6.0 * of_true / (6.0 * of_true + of_measured)
    return share * measured + (1.0 - share) * true


def _spread(values: np.ndarray) -> np.ndarray:
    """Return robust standard deviations of the columns of values."""
    spread: np.ndarray = 1.4826 * np.median(np.abs(values), axis=0)
    return spread


def _triangular_means(t: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return means of values (n, 3) with a triangular window about every inner edge.

    The mean of a second derivative with this window is a second difference.
    """
    place = np.searchsorted(edges, t, side="right") - 1
    out, total = np.zeros((len(edges), 3)), np.zeros(len(edges))
    inside = (place >= 0) & (place < len(edges) - 1)
    part = np.where(inside, (t - edges[np.clip(place, 0, len(edges) - 1)]) / CELL, 0.0)
    for shift, weight in ((0, 1.0 - part), (1, part)):
        rows = place[inside] + shift
        total += np.bincount(rows, weight[inside], len(edges))
        for k in range(3):
            out[:, k] += np.bincount(rows, weight[inside] * values[inside, k], len(edges))
    return out[1:-1] / np.maximum(total[1:-1, None], 1e-9)


def cells_in_the_air(comparison: Comparison, imu: Imu) -> np.ndarray:
    """Return the edges of cells, s, within the span, the Imu and the reference.

    These also cover SHIFT beyond both ends.
    """
    poses, (first, last) = comparison.poses, comparison.span
    low = max(first, imu.t[0], poses.t[0]) + CELL + SHIFT
    high = min(last, imu.t[-1], poses.t[-1]) - CELL - SHIFT
    return np.arange(low, high, CELL)


def means(t: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return means of interpolated values (n, k) over the intervals between edges."""
    dt = np.diff(t)[:, None]
    total = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]) * dt, axis=0)]
    )
    at = np.stack([np.interp(edges, t, column) for column in total.T], axis=1)
    return np.diff(at, axis=0) / np.diff(edges)[:, None]
