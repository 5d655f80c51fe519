"""Another odometry or SLAM, whose frame is its own and drifts."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_ekf.smoother import smooth

from .ground_truth import GroundTruth
from .nothing import without_truth

ESTIMATE_STD = 0.3  # m, of the filter's own path beside which the frame is laid: errors of TDOAs that last for seconds
FEWEST = 5  # stamps to align with


class Odometry(GroundTruth):
    """The path of the odometry, laid beside that of the filter: turned about the vertical and moved as fits best, and then
    by as much as its frame may have drifted (a random walk, smoothed).

    What all of a flight has in common, a shift and a yaw, is the filter's own and cannot be seen.
    """

    attitude_known = False
    words = "another odometry, in a frame of its own that was laid beside the filter's path: a shift of all of it is not seen"

    def __init__(self, config=None, constraints=()):
        """config : FilterConfig; constraints : Paths."""
        self._config, self._paths = config, {one.flight: one for one in constraints if hasattr(one, "walk")}

    def prepare(self, flight):
        path = self._paths.get(flight.name)
        if path is None:
            raise InputError(f"{flight.name}: --odometry holds no path of it; record one, or give --no-truth.")
        alone = without_truth(flight)
        own = smooth(alone, self._config, Corrector(flight.anchors)).odometry
        t = path.stamps(float(flight.tdoa.t[0]))
        t = t[(t > own.t[0]) & (t < own.t[-1])]
        if len(t) < FEWEST:
            raise InputError(f"{flight.name}: its odometry is above the floor for {len(t)} stamps only; fly for half a minute.")
        estimate = np.stack([np.interp(t, own.t, column) for column in own.p.T], axis=1)
        p, (turn, shift) = path.aligned(t, estimate)
        walk = path.walk(t)
        drift = walk @ np.linalg.solve(walk + ESTIMATE_STD**2 * np.eye(len(t)), estimate - p)
        chosen = (own.t >= path.t[0]) & (own.t <= path.t[-1])
        moved = np.stack([np.interp(own.t[chosen], t, column) for column in drift.T], axis=1)
        return replace(alone, truth=Truth(own.t[chosen], turn.apply(path.at(own.t[chosen])) + shift + moved, own.q[chosen]))
