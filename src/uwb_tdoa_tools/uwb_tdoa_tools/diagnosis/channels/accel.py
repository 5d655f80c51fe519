"""The accelerometer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.core.state import GRAVITY

from .inertial import CELL, ImuResidual, Inertial, cells_in_the_air, features_of, means

if TYPE_CHECKING:
    from .base import Comparison

SHIFT = 0.05  # s; the cells are those of the gyroscope


class Accel(Inertial):
    """Specific force, averaged with a triangular window, minus the second difference of the true
    positions, which is the same average of the true acceleration.
    """

    name = "accel"
    unit = "m/s^2"
    needs = "an accelerometer, and ground truth of position and attitude"
    stream = "imu"
    negligible = 0.01

    def residual(self, comparison: Comparison) -> ImuResidual | None:
        imu = comparison.flight.imu
        if imu is None or not (
            comparison.attitude_known and all(comparison.reference.positions_known)
        ):
            return None
        track, edges = comparison.track, cells_in_the_air(comparison, imu, SHIFT)
        middles = edges[1:-1]
        to_body = Rotation.from_quat(track.attitudes(middles)).inv()
        positions = track.positions(edges)
        acceleration = (positions[2:] - 2.0 * positions[1:-1] + positions[:-2]) / CELL**2
        true = to_body.apply(acceleration + [0.0, 0.0, GRAVITY])
        flown = (imu.t >= edges[0]) & (imu.t <= edges[-1])
        world = Rotation.from_quat(track.attitudes(imu.t[flown])).apply(imu.accel[flown])
        measured = to_body.apply(_triangular_means(imu.t[flown], world, edges))
        features = means(imu.t, features_of(imu), edges)
        samples = self._samples(comparison, middles, true, 0.5 * (features[1:] + features[:-1]))
        measured = measured - comparison.effects.uncorrected(samples)
        return ImuResidual(samples, measured - true, self.unit)


def _triangular_means(t: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Means of (n, 3) values with the triangular window over two intervals, for every inner edge.
    With it, the mean of a second derivative is the second difference of the function: both sides of
    the residual see the same filter.
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
