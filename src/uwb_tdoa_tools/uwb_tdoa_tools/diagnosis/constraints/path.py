"""The path of another odometry or SLAM, in a frame of its own."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

SPACING = 2.0  # s between the stamps at which it is compared
ALOFT = 0.3  # m above where it was lowest from which on it counts: on the floor TDOAs are metres off
FRAME_STD, YAW_STD = 100.0, 3.0  # m and rad: of its frame nothing is known but where up is


@dataclass(frozen=True, eq=False)
class Path:
    """Where the tag was in a frame with z up, of unknown origin and yaw, that drifts as a random walk.

    flight : name; t (n,) s, clock of the flight; p (n, 3) m; drift : m per square root of a second.
    """

    flight: str
    t: np.ndarray
    p: np.ndarray
    drift: float

    def at(self, t):
        """(m, 3) m in its own frame."""
        return np.stack([np.interp(t, self.t, column) for column in self.p.T], axis=1)

    def stamps(self, begin):
        """(m,) s, SPACING apart, while it was aloft. begin : stamp of the first TDOA, s."""
        aloft = self.t[self.p[:, 2] > self.p[:, 2].min() + ALOFT]
        return np.arange(max(aloft[0], begin), aloft[-1], SPACING) if len(aloft) else np.zeros(0)

    def aligned(self, t, estimate):
        """Its positions at stamps t (m,) in the frame of an estimate (m, 3) of them, m, and (Rotation, (3,) m) to there:
        least squares, about the vertical only."""
        p = self.at(t)
        mean, centre = p.mean(axis=0), estimate.mean(axis=0)
        one, other = (p - mean)[:, :2], (estimate - centre)[:, :2]
        yaw = np.arctan2(np.sum(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]), np.sum(one * other))
        turn = Rotation.from_euler("z", yaw)
        shift = centre - turn.apply(mean)
        return turn.apply(p) + shift, (turn, shift)

    def walk(self, t):
        """(m, m) m^2: covariance of one axis of what its frame has drifted and where it began, at stamps t."""
        since = t - t[0]
        return self.drift**2 * np.minimum(since[:, None], since) + FRAME_STD**2

    def equations(self, t, estimate, covariance, moved):
        """The estimate less the path, aligned, is what the parameters do to it, and the drift. As of Mark."""
        p, _ = self.aligned(t, estimate)
        m = len(t)
        whole = np.einsum("ij,kl->ikjl", self.walk(t), np.eye(3)).reshape(3 * m, 3 * m)
        for k in range(3):
            whole[k::3, k::3] += np.diag(covariance[:, k, k])
        about = p - p.mean(axis=0)
        turned = np.stack([-about[:, 1], about[:, 0], np.zeros(m)], axis=1).ravel()
        whole += YAW_STD**2 * np.outer(turned, turned)
        columns = moved.reshape(3 * m, -1)
        weighted = np.linalg.solve(whole, np.column_stack([columns, (estimate - p).ravel()]))
        return columns.T @ weighted[:, :-1], columns.T @ weighted[:, -1]
