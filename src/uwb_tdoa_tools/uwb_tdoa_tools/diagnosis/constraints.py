# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Constraints: knowledge besides TDOAs and IMU for a calibration without ground truth.

A constraint of a flight (`flight` is its name) has `stamps(begin)` and `equations(t, estimate,
covariance, moved)`. It needs the estimate at these ascending stamps, s. A constraint of anchors
(`flight` is None) has `equations(anchors, columns)`. Both return (gram (k, k), vector (k,)) of
normal equations. The unknowns are the errors of the anchor coordinates, anchor by anchor, then
delays, then further parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors

WITHIN = 5  # stamps of a mark over which the estimate is averaged
ALOFT = 0.3  # m above its lowest point, from which a path counts: on the floor TDOAs err by metres
FRAME_STD = 10.0  # m, of the origin of the frame of a path after it was fitted to another one
LASTING_STD = 0.3  # m, each axis, of the error of an estimate from TDOAs that lasts for seconds
COMMON_STD = 0.3  # m, each axis, of its error that lasts for a flight
MOST = 200  # stamps over which the common error of a path is averaged


@dataclass(frozen=True)
class Distance:
    """A distance between the anchors of ids a and b, by laser or by radio, with std, m."""

    a: int
    b: int
    distance: float
    std: float
    flight: ClassVar[None] = None  # of no flight

    def equations(self, anchors: Anchors, columns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return normal equations of the shifts of both anchors along their line.

        columns : number of parameters
        """
        first, second = anchors.index(np.array([self.a, self.b]))
        line = anchors.positions[first] - anchors.positions[second]
        length = max(float(np.linalg.norm(line)), 1e-6)
        row = np.zeros(columns)
        row[3 * first : 3 * first + 3] = line / length
        row[3 * second : 3 * second + 3] = -line / length
        return np.outer(row, row) / self.std**2, row * (self.distance - length) / self.std**2


@dataclass(frozen=True)
class Mark:
    """A surveyed mean position of the tag from `first` to `last`, s after the first TDOA.

    flight : name; position : (3,) m, world; std : m, each axis
    """

    flight: str
    first: float
    last: float
    position: tuple[float, ...]
    std: float

    def stamps(self, begin: float) -> np.ndarray:
        """Return stamps, (m,) s. begin : stamp of the first TDOA, s."""
        return begin + np.linspace(self.first, self.last, WITHIN)

    def equations(
        self, t: np.ndarray, estimate: np.ndarray, covariance: np.ndarray, jacobian: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return normal equations of the error of the estimate, averaged over the mark.

        t : (m,) s, `stamps`; estimate : (m, 3) m; covariance : (m, 3, 3) m^2
        jacobian : (m, 3, k) derivative of the estimate by the parameters, errors that the run did
            not model. A correction of an error moves the estimate by minus this.
        """
        off, columns = self.off(estimate, jacobian)
        weight = 1.0 / (np.diag(covariance[WITHIN // 2]) + self.std**2)
        return (columns * weight[:, None]).T @ columns, columns.T @ (weight * off)

    def off(self, estimate: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (estimate minus mark (3,) m, its derivative by the parameters (3, k)).

        Both are means over the mark, with arguments as of `equations`.
        """
        return estimate.mean(axis=0) - self.position, jacobian.mean(axis=0)


@dataclass(frozen=True, eq=False)
class OdometryPath:
    """The path of another odometry or SLAM, whose frame has z up and drifts as a random walk.

    Origin and yaw of the frame are unknown.

    flight : name; t : (n,) s, clock of the flight; p : (n, 3) m; drift : m per square root of s
    """

    flight: str
    t: np.ndarray
    p: np.ndarray
    drift: float

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return positions in its own frame, (m, 3) m, at stamps t (m,), s."""
        return np.stack([np.interp(t, self.t, column) for column in self.p.T], axis=1)

    @property
    def aloft(self) -> tuple[float, float] | None:
        """Return the (first, last) stamp, s, ALOFT above its lowest point; None without any."""
        high = self.t[self.p[:, 2] > self.p[:, 2].min() + ALOFT]
        return (float(high[0]), float(high[-1])) if len(high) else None

    def laid(
        self,
        t: np.ndarray,
        estimate: np.ndarray,
        marks: Sequence[Mark],
        begin: float,
        wanted: np.ndarray,
    ) -> tuple[np.ndarray, float]:
        """Return the path at stamps `wanted`, (k, 3) m, world, and the std of its common shift, m.

        The path is turned about the vertical and shifted to fit the estimate. Then its start and
        drift are corrected by the posterior mean of a random walk. The estimate and the marks are
        its data.

        t : (m,) s; estimate : (m, 3) m, world, at t; begin : stamp of the first TDOA, s
        """
        there = self.at(t)
        one, other = ((p - p.mean(axis=0))[:, :2] for p in (there, estimate))
        yaw = np.arctan2(
            np.sum(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]), np.sum(one * other)
        )
        turn = Rotation.from_euler("z", yaw)
        shift = estimate.mean(axis=0) - turn.apply(there).mean(axis=0)
        stamps = [mark.stamps(begin) for mark in marks]
        away = [
            mark.position - (turn.apply(self.at(s)) + shift).mean(axis=0)
            for mark, s in zip(marks, stamps)
        ]
        away = np.concatenate([estimate - turn.apply(there) - shift, np.reshape(away, (-1, 3))])
        known = np.concatenate([t, [s.mean() for s in stamps]])
        m = len(t)
        noise = np.diag(
            np.concatenate([np.full(m, LASTING_STD), [mark.std for mark in marks]]) ** 2.0
        )
        noise[:m, :m] += COMMON_STD**2
        information = np.linalg.inv(self._walk(known, known) + noise)
        cross, some = self._walk(wanted, known), wanted[:: -(-len(wanted) // MOST)]
        mean = self._walk(some, known).mean(axis=0)
        std = np.sqrt(self._walk(some, some).mean() - mean @ information @ mean)
        return turn.apply(self.at(wanted)) + shift + cross @ (information @ away), float(std)

    def _walk(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the covariance of the frame between two sets of stamps, each axis, (k, n) m^2."""
        since = np.minimum(one[:, None], other) - self.t[0]
        return FRAME_STD**2 + self.drift**2 * np.maximum(since, 0.0)


Constraint = Distance | Mark
