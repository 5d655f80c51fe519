"""No reference: the filter's own estimate is all there is."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_ekf.core import auxiliary
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import without_unknown_offset
from uwb_tdoa_ekf.sensitivity import RANGES, TDOAS, record_innovations

from ...scoring.metrics import judged_part
from ...scoring.phases import AIRBORNE
from .base import Reference, ReferenceView

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_bias.foundation.flight import Flight

    from ..constraints import Constraint

FLOWN_SHARE = 0.25  # of the time between the first and the last pose in the air; less is no flight
TRUTHS = "_truth"  # how streams are called in which a simulation tells what was true


def without_truth(flight: Flight) -> Flight:
    """The Flight without anything of where it really was."""
    extra = {name: stream for name, stream in flight.extra.items() if not name.endswith(TRUTHS)}
    return replace(flight, truth=None, extra=extra)


class Nothing(Reference):
    """Residuals are the innovations of the filter, of TDOAs, or of ranges in a flight without any;
    what the path follows of an effect is taken out of its regressors, with all that the filter
    knows of the path. An offset of all ranges is taken out before: it would bend the path, and
    `self_calibrate` estimates it.
    """

    positions_known = (False, False, False)
    attitude_known = False
    tells_errors = False
    words = "nothing but the flights themselves"

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint] = (),
        streams: Sequence[str] = (),
    ) -> None:
        """config : FilterConfig; constraints : what is known beside (`diagnosis/constraints`);
        streams : whose innovations are residuals, as of `record_innovations`; their offset stays in
        the ranges then. None: as said above.
        """
        self._config, self.constraints, self._streams = (
            config or FilterConfig(),
            tuple(constraints),
            tuple(streams),
        )

    def prepare(self, flight: Flight) -> Flight:
        return without_truth(flight)

    def on_floor(self, poses: Truth) -> bool:
        """Return whether poses are those of a vehicle that never leaves the floor: an estimate of
        its height is above that of a flight now and then, and not for long.
        """
        part, first, last = judged_part(poses)
        if self._config.planar or part != "in_the_air":
            return True
        inside = (poses.t >= first) & (poses.t <= last)
        return bool(np.mean(poses.p[inside, 2] > AIRBORNE) < FLOWN_SHARE)

    def span(self, flight: Flight, poses: Truth) -> tuple[float, float]:
        flat = replace(poses, p=poses.p * [1.0, 1.0, 0.0]) if self.on_floor(poses) else poses
        return super().span(flight, flat)

    def view(self, flight: Flight, effects: EffectSet) -> ReferenceView:
        config, streams, by = self._config, self._streams, Corrector(flight.anchors, effects)
        if not streams:
            flight = without_unknown_offset(flight, config, by)
            config = replace(config, **auxiliary.NONE)  # it has been found
            streams = (TDOAS,) if len(flight.tdoa) else (RANGES,)
        innovations = record_innovations(flight, config, by, streams)
        estimate = innovations.run.odometry
        return ReferenceView(Truth(estimate.t, estimate.p, estimate.q), innovations)
