"""Who tells the controller where it is: our filter, as the nodes run it, or somebody else's, built
as a shared library.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, StreamCorrector
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.frames import poses_of
from uwb_tdoa_ekf.results import Odometry, concatenated

from .peer import Peer, events

if TYPE_CHECKING:
    from pathlib import Path

    from uwb_tdoa_bias.correction.network import Network
    from uwb_tdoa_bias.foundation.anchors import Anchors
    from uwb_tdoa_ekf.core.config import FilterConfig

    from .mission import Pose
    from .simulator import SensorReadings

NOTHING = Odometry(
    np.empty(0),
    np.empty((0, 3)),
    np.empty((0, 3)),
    np.empty((0, 4)),
    np.empty((0, 3)),
    np.empty((0, 3)),
    np.empty((0, 9, 9)),
    np.empty((0, 3, 3)),
)


class EstimateSource(Protocol):
    """Who tells where a vehicle is. why : what keeps it from being flown by, in words, "" for
    nothing.
    """

    @property
    def why(self) -> str: ...

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Tell that it is at p (3,) m at t, s, to so many m, and points along yaw, to as many rad;
        NaN: nobody knows.
        """

    def take(self, measured: SensorReadings) -> None:
        """Take what arrived."""

    @property
    def pose(self) -> Pose | None:
        """The newest estimate."""

    @property
    def deviation(self) -> float:
        """Largest standard deviation of a coordinate of it, m; inf without one."""

    @property
    def odometry(self) -> Odometry:
        """All that came out."""


class OurFilter:
    """`Corrector` and `Estimator`, as in bias_node and ekf_node, behind the calls that a flight
    needs: an EstimateSource. estimator : Estimator; newest : Odometry, the last that came out, or
    None.
    """

    why = ""

    def __init__(
        self,
        anchors: Anchors,
        config: FilterConfig,
        effects: EffectSet | None = None,
        network: Network | None = None,
    ) -> None:
        """anchors : Anchors; config : FilterConfig; effects : EffectSet, and network : Network, to
        correct what was measured with, or None.
        """
        effects = effects or EffectSet()
        self._anchors, self._streams, self._corrector = (
            anchors,
            StreamCorrector(effects.effects),
            Corrector(anchors, effects, network),
        )
        self.estimator = Estimator(anchors, config, effects=effects)
        self._parts = [NOTHING]
        self.newest: Odometry | None = None

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Tell that it is at p (3,) m at t, s, to so many m, and points along yaw, to as many rad;
        NaN: nobody knows.
        """
        self.estimator.set_pose(t, p, std**2 * np.eye(3), yaw, std)

    def take(self, measured: SensorReadings) -> None:
        """Take what arrived: SensorReadings."""
        for name, part in measured.streams.items():
            if len(part.t):
                self._add(name, self._streams.correct(name, part))
        odometry, _ = self.estimator.advance()
        if len(odometry):
            self._parts.append(odometry)
            self.newest = odometry
            if not self._corrector.idle:
                self._corrector.add_pose(*poses_of(odometry))

    def _add(self, name: str, part: Any) -> None:
        """Give the filter a part of a stream that is corrected, but for the bias of TDOAs."""
        if name == "imu":
            self.estimator.add_imu(part.t, part.gyro, part.accel)
        elif name == "tdoa":
            known = self._corrector.correct(
                part.t, self._anchors.index(part.a), self._anchors.index(part.b), part.d
            )
            self.estimator.add_tdoa(
                part.t,
                part.a,
                part.b,
                known.corrected,
                known.std**2 + part.variance,
                known.slope,
                known.state,
            )
        else:
            self.estimator.add(name, part)

    @property
    def pose(self) -> Pose | None:
        """(t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate, or None."""
        if self.newest is None:
            return None
        return self.newest.t[-1], self.newest.p[-1], self.newest.v[-1], self.newest.q[-1]

    @property
    def deviation(self) -> float:
        """Largest standard deviation of a coordinate of the newest estimate, m; inf without one."""
        if self.newest is None:
            return math.inf
        P = self.newest.covariance[-1]
        return math.sqrt(max(P[0, 0], P[1, 1], P[2, 2]))

    @property
    def odometry(self) -> Odometry:
        """Odometry, all that came out."""
        return concatenated(self._parts)


class TheirFilter:
    """A Peer behind the same calls.

    It gets place and yaw at the start, knows no effects, and says nothing of its covariance.
    """

    deviation = 0.0  # m; nobody knows
    why = ""

    def __init__(
        self, library: str | Path, anchors: Anchors, yaw: float, place: np.ndarray | None = None
    ) -> None:
        """library : path; anchors : Anchors; yaw : rad; place : (3,) m, or None.

        Raises InputError.
        """
        self._peer, self._anchors = Peer(library, own=True), anchors
        q = np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])
        self._peer.start(anchors.positions, np.full(3, np.nan) if place is None else place, q)
        self._states: list[Pose] = []
        self._newest: Pose | None = None

    def take(self, measured: SensorReadings) -> None:
        """Take what arrived: SensorReadings, of which other sensors are passed over."""
        both = np.concatenate(events(measured.imu, measured.tdoa, self._anchors))
        if len(both):
            self._peer.run(both[np.argsort(both["t"], kind="stable")])
            self._states.append((float(both["t"].max()), *self._peer.state()))
            if all(np.isfinite(part).all() for part in self._states[-1]):
                self._newest = self._states[-1]

    @property
    def pose(self) -> Pose | None:
        """(t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate that is one, or None."""
        return self._newest

    @property
    def odometry(self) -> Odometry:
        """Odometry, all that came out; covariances NaN."""
        if not self._states:
            return NOTHING
        t, p, v, q = map(np.array, zip(*self._states))
        return Odometry(
            t,
            p,
            v,
            q,
            np.zeros(p.shape),
            np.zeros(p.shape),
            np.full((len(t), 9, 9), np.nan),
            np.zeros((len(t), 3, 3)),
        )
