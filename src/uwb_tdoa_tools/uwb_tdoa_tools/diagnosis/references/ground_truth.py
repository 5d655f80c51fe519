"""Motion capture: every pose is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uwb_tdoa_bias.effects.stamp_error import shifted
from uwb_tdoa_bias.foundation.errors import InputError

from ...scoring.alignment import NONE
from ...scoring.evaluation import align_truth
from .base import Reference, ReferenceView

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ..constraints import Constraint
    from .path import OdometryPath


class GroundTruth(Reference):
    """The ground truth that the recording holds."""

    words = "the recorded ground truth"
    knows_floor = True

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint | OdometryPath] = (),
        align: str = NONE,
    ) -> None:
        """config : FilterConfig and constraints, which no known pose needs; align : as of
        `align_truth`.
        """
        self._align = align

    def prepare(self, flight: Flight) -> Flight:
        if flight.truth is None or len(flight.truth) < 2:
            raise InputError(
                f"{flight.name}: holds no ground truth to compare with; give --no-truth."
            )
        return flight

    def settled(
        self, flight: Flight, base: EffectSet, config: FilterConfig | None = None
    ) -> tuple[Flight, tuple[str, ...]]:
        return align_truth(flight, base, config, self._align)

    def view(self, flight: Flight, effects: EffectSet) -> ReferenceView:
        truth = shifted(flight, "truth", -effects.stamp_offset("truth")).truth
        assert truth is not None  # `prepare` has refused a flight without
        return ReferenceView(truth)
