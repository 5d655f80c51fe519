"""The gyroscope."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects.covariates import OF_IMU

from .inertial import CELL, ImuResidual, Inertial, cells_in_the_air, features_of, means

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.flight import Imu, Truth

    from .base import Comparison

# s, for derivatives by time, of what was measured: noise of the truth would shrink what is fitted
# to them
SHIFT = 0.05
STILL_FORCE, STILL_RATE = 0.3, 0.1  # m/s^2 of vibration and rad/s, below which the vehicle stands
STILL_CHANGE = 0.02  # rad/s, the same of what is measured less what was measured at the start
BEGINNING = 2  # cells before, in which it may begin to turn
RATES = [column for column, name in enumerate(OF_IMU) if name.startswith("rate_")]
TURNING = [OF_IMU.index("turning_rate"), *RATES]
# of the variance of a measured rate, that must be true turns: of a rover none of roll and pitch is
TRUE_SHARE = 0.5
FEWEST_CELLS = 4


class Gyro(Inertial):
    """Turning rates, averaged over cells, minus the mean of the true turns; before take-off alone
    where no attitude is known: a vehicle that stands does not turn.
    """

    name = "gyro"
    unit = "rad/s"
    needs = "a gyroscope, and ground truth of the attitude or some seconds at rest before take-off"
    stream = "imu"
    negligible = 5e-4

    def residual(self, comparison: Comparison) -> ImuResidual | None:
        imu, poses = comparison.flight.imu, comparison.poses
        if imu is None:
            return None
        if not comparison.reference.attitude_known:
            return self._at_rest(comparison, imu)
        if not comparison.attitude_known:
            return None
        edges = cells_in_the_air(comparison, imu, SHIFT)
        measured, true = means(imu.t, imu.gyro, edges), _true_rates(poses, edges)
        before, after = (means(imu.t, imu.gyro, edges + shift) for shift in (-SHIFT, SHIFT))
        middles = 0.5 * (edges[:-1] + edges[1:])
        features, change = means(imu.t, features_of(imu), edges), (after - before) / (2.0 * SHIFT)
        still = ~_turns(measured, true)
        reading = np.where(
            still, 0.0, measured
        )  # where it does not turn, what it measures is the residual: a function of itself
        features[:, RATES], change[:, still] = np.where(still, 0.0, features[:, RATES]), 0.0
        if not _turns(
            *(np.linalg.norm(rates, axis=1, keepdims=True) for rates in (measured, true))
        )[0]:
            features[:, OF_IMU.index("turning_rate")] = 0.0
        samples = self._samples(comparison, middles, reading, features, change)
        return ImuResidual(
            samples, measured - true - comparison.effects.uncorrected(samples), self.unit
        )

    def _at_rest(self, comparison: Comparison, imu: Imu) -> ImuResidual | None:
        edges = np.arange(imu.t[0], imu.t[-1], CELL)
        features, measured = means(imu.t, features_of(imu), edges), means(imu.t, imu.gyro, edges)
        moving = features[:, OF_IMU.index("vibration")] > STILL_FORCE
        moving |= np.abs(measured).max(axis=1) > STILL_RATE
        moving |= (
            np.abs(measured - np.median(measured[:FEWEST_CELLS], axis=0)).max(axis=1) > STILL_CHANGE
        )
        still = np.flatnonzero(np.cumsum(moving) == 0)[:-BEGINNING]
        if len(still) < FEWEST_CELLS:
            return None
        middles, measured, features = (
            0.5 * (edges[:-1] + edges[1:])[still],
            measured[still],
            features[still],
        )
        features[:, TURNING] = (
            # it does not turn: what it measures is the residual, which would be a function of
            # itself
            0.0
        )
        nothing = np.zeros_like(measured)
        samples = self._samples(comparison, middles, nothing, features, nothing)
        return ImuResidual(samples, measured - comparison.effects.uncorrected(samples), self.unit)


def _turns(measured: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(k,) bool: whether measured rates (n, k) change because true ones, (n, k), do."""
    one, other = measured - measured.mean(axis=0), true - true.mean(axis=0)
    turns: np.ndarray = np.sum(one * other, axis=0) > TRUE_SHARE * np.sum(one**2, axis=0)
    return turns


def _true_rates(truth: Truth, edges: np.ndarray) -> np.ndarray:
    """Mean turning rates in body axes between edges, (n, 3) rad/s: sums of the turns from pose to
    pose.
    """
    known = np.isfinite(truth.q).all(axis=1)
    t, first = np.unique(truth.t[known], return_index=True)
    turns = Rotation.from_quat(truth.q[known][first])
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    at = np.stack([np.interp(edges, t, column) for column in total.T], axis=1)
    return np.diff(at, axis=0) / np.diff(edges)[:, None]
