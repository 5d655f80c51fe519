"""The path of another odometry or SLAM, in a frame of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..constraints import Mark

SPACING = 2.0  # s between the stamps at which it is compared
ALOFT = (
    0.3  # m above where it was lowest from which on it counts: on the floor TDOAs are metres off
)
FRAME_STD = 10.0  # m: where its frame began, after it was laid beside another path
LASTING_STD = 0.3  # m, of an estimate from TDOAs, each axis: what lasts for seconds
MOST = 200  # stamps over which its common error is averaged
COMMON_STD = 0.3  # m, the same of what all of a flight has in common


@dataclass(frozen=True, eq=False)
class OdometryPath:
    """Where the tag was in a frame with z up, of unknown origin and yaw, that drifts as a random
    walk.

    flight : name; t (n,) s, clock of the flight; p (n, 3) m; drift : m per square root of a second.
    """

    flight: str
    t: np.ndarray
    p: np.ndarray
    drift: float

    def at(self, t: np.ndarray) -> np.ndarray:
        """(m, 3) m in its own frame."""
        return np.stack([np.interp(t, self.t, column) for column in self.p.T], axis=1)

    @property
    def aloft(self) -> tuple[float, float] | None:
        """(first, last) s: between which it was above where it was lowest by ALOFT; None if it
        never was.
        """
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
        """Where the tag was at stamps `wanted` (k,), in the frame of an estimate (m, 3) m at stamps
        t (m,) and of Marks: (k, 3) m; and standard deviation of what all of that is off by
        together, each axis, m.

        Turned about the vertical and moved as fits the estimate best; then by as much as the frame
        began elsewhere and has drifted, the mean of a random walk given the estimate, whose errors
        last, and the marks. begin : stamp of the first TDOA.
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
        """(k, n) m^2: covariance of one axis of where the frame is, at stamps one (k,) and other
        (n,).
        """
        since = np.minimum(one[:, None], other) - self.t[0]
        return FRAME_STD**2 + self.drift**2 * np.maximum(since, 0.0)
