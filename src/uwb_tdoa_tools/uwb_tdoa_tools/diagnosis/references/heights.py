"""Heights alone are known: a range finder that looks down."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import AIDS, Truth
from uwb_tdoa_ekf.smoother import smooth

from .ground_truth import GroundTruth
from .nothing import without_truth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ..constraints import Constraint
    from .path import OdometryPath


class Heights(GroundTruth):
    """The path of the filter, smoothed, that uses the height; what is diagnosed and judged does
    without it.

    Most of the error of anchors at walls is in z, so that most of it is observable so. x and y of
    the path are what the filter makes of the uncorrected TDOAs: an error that is in them is not
    seen.
    """

    positions_known = (False, False, True)
    attitude_known = False
    words = "heights that a range finder measured; x and y are the filter's own"

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint | OdometryPath] = (),
    ) -> None:
        """config : FilterConfig; constraints are not needed."""
        self._config = config

    def prepare(self, flight: Flight) -> Flight:
        if flight.height is None or not len(flight.height):
            raise InputError(
                f"{flight.name}: holds no height to compare with; record a range finder, or "
                "give --no-truth."
            )
        alone = without_truth(flight)
        path = smooth(alone, self._config, Corrector(flight.anchors)).odometry
        return replace(alone.without(*AIDS), truth=Truth(path.t, path.p, path.q))
