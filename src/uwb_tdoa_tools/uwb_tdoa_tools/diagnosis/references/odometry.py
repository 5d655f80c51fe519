"""Another odometry or SLAM, whose frame is its own and drifts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_ekf.smoother import smooth

from ...clock import grid
from .ground_truth import GroundTruth
from .nothing import without_truth
from .path import SPACING, OdometryPath

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ..constraints import Constraint

FEWEST = 5  # stamps to lay it beside the filter's path


class OdometryReference(GroundTruth):
    """The path of the odometry, laid beside that of the filter, and through marks where there are
    any.

    What all of a flight has in common, a shift and a yaw, is the filter's own and cannot be seen,
    but for marks: where it took off and landed is enough.
    """

    attitude_known = False
    knows_floor = False  # the path begins and ends above it

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint | OdometryPath] = (),
    ) -> None:
        """config : FilterConfig; constraints : OdometryPaths, and Marks that lie on them."""
        self._config, self._paths = (
            config,
            {one.flight: one for one in constraints if isinstance(one, OdometryPath)},
        )
        self._marks = [
            one
            for one in constraints
            if one.flight is not None and not isinstance(one, OdometryPath)
        ]
        through = (
            "laid through marks"
            if self._marks
            else "laid beside the filter's path: a shift of all of a flight is not seen"
        )
        self._shift_std: dict[str, float] = {}
        self.words = f"another odometry in a frame of its own, {through}"

    def prepare(self, flight: Flight) -> Flight:
        path = self._paths.get(flight.name)
        if path is None:
            raise InputError(
                f"{flight.name}: --odometry holds no path of it; record one, or give --no-truth."
            )
        alone, begin = without_truth(flight), float(flight.tdoa.t[0])
        own = smooth(alone, self._config, Corrector(flight.anchors)).odometry
        first, last = path.aloft or (
            0.0,
            0.0,
        )  # by itself: laid a little too high, the time on the floor would count as in the air
        chosen = (own.t >= first) & (own.t <= last)
        t = (
            grid(own.t[chosen][0], own.t[chosen][-1], SPACING, own.t[chosen])
            if chosen.any()
            else np.empty(0)
        )
        if len(t) < FEWEST:
            raise InputError(
                f"{flight.name}: its odometry is above the floor for {len(t)} stamps only; "
                "fly for half a minute."
            )
        estimate = np.stack([np.interp(t, own.t, column) for column in own.p.T], axis=1)
        marks = [mark for mark in self._marks if mark.flight == flight.name]
        p, self._shift_std[flight.name] = path.laid(t, estimate, marks, begin, own.t[chosen])
        return replace(alone, truth=Truth(own.t[chosen], p, own.q[chosen]))

    def shift_std(self, name: str) -> np.ndarray:
        return np.full(3, self._shift_std[name])
