# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Provide estimates to fly by: of the filter, as the nodes run it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import Model
from uwb_tdoa_bias.effects import EffectSet, StreamCorrector
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.results import Odometry, concatenated, poses_of

from .mission import Pose
from .simulator import Streams

_NO_VECTORS = np.empty((0, 3))
NO_ODOMETRY = Odometry(
    np.empty(0),
    _NO_VECTORS,
    _NO_VECTORS,
    np.empty((0, 4)),
    _NO_VECTORS,
    _NO_VECTORS,
    np.empty((0, 9, 9)),
    np.empty((0, 3, 3)),
)


class EstimateSource:
    """Provide the estimate that a vehicle flies by."""

    def __init__(self) -> None:
        # (t s, p (3,), v (3,), q (4,), covariance of p (3, 3)) of each estimate
        self._rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Set the position and the yaw at a time.

        Parameters
        ----------
        t : float
            s.
        p : numpy.ndarray
            (3,), m.
        std : float
            Standard deviation of position, m, and yaw, rad.
        yaw : float
            rad, NaN if unknown.
        """
        raise NotImplementedError

    def take(self, streams: Streams) -> None:
        """Process the samples that have arrived."""
        raise NotImplementedError

    @property
    def why(self) -> str:
        """Return the reason for which the estimate cannot be used, or ""."""
        return ""

    @property
    def pose(self) -> Pose | None:
        """Return (t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate, or None."""
        return self._rows[-1][:4] if self._rows else None

    @property
    def deviation(self) -> float:
        """Return its largest standard deviation of a coordinate, m, or inf without an estimate."""
        return math.sqrt(self._rows[-1][4].diagonal().max()) if self._rows else math.inf

    @property
    def odometry(self) -> Odometry:
        """Return all estimates, without rates. Only the position has a covariance."""
        if not self._rows:
            return NO_ODOMETRY
        t, p, v, q, of_position = map(np.array, zip(*self._rows))
        covariance = np.zeros((len(t), 9, 9))
        covariance[:, :3, :3] = of_position
        zero = np.zeros(p.shape)
        return Odometry(t, p, v, q, zero, zero, covariance, np.zeros((len(t), 3, 3)))


class OwnFilter(EstimateSource):
    """Run `Corrector` and `Estimator` as bias_node and ekf_node do.

    Attributes
    ----------
    estimator : Estimator
    newest : Odometry or None
        The last output.
    """

    def __init__(
        self,
        anchors: Anchors,
        config: FilterConfig,
        effects: EffectSet | None = None,
        network: Model | None = None,
    ) -> None:
        """Set up the filter and its corrections.

        Parameters
        ----------
        anchors : Anchors
        config : FilterConfig
        effects : EffectSet, optional
        network : Model, optional
            Corrections of the measurements.
        """
        super().__init__()
        effects = effects or EffectSet()
        self._anchors = anchors
        self._streams = StreamCorrector(effects.effects)
        self._corrector = Corrector(anchors, effects, network)
        self.estimator = Estimator(anchors, config, effects=effects)
        self._parts = [NO_ODOMETRY]
        self.newest: Odometry | None = None

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        self.estimator.set_pose(t, p, std**2 * np.eye(3), yaw, std)

    def take(self, streams: Streams) -> None:
        for name, part in streams.items():
            if len(part.t):
                self._add(name, self._streams.correct(name, part))
        odometry, _ = self.estimator.advance()
        if not len(odometry):
            return
        self._parts.append(odometry)
        self.newest = odometry
        self._rows = [  # the newest alone: _parts hold all
            (
                odometry.t[-1],
                odometry.p[-1],
                odometry.v[-1],
                odometry.q[-1],
                odometry.covariance[-1, :3, :3],
            )
        ]
        if not self._corrector.idle:
            self._corrector.add_pose(*poses_of(odometry))

    def _add(self, name: str, part: Any) -> None:
        """Give a part of one stream to the filter, and correct the bias of TDOAs."""
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
    def odometry(self) -> Odometry:
        """Return all estimates."""
        return concatenated(self._parts)
