# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimate a recording: bias correction and filter as in the nodes, or smoothed."""

from dataclasses import dataclass

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import Corrector, orientation_remarks
from uwb_tdoa_bias.correction.model import Model
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.tag import TagLeverArm
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import Run, run_offline
from uwb_tdoa_ekf.smoother import smooth


@dataclass(frozen=True)
class FlightEstimator:
    """Estimate a Flight without its ground truth: estimator(flight) is the Run. Can be pickled.

    Attributes
    ----------
    config : FilterConfig or None
        Parameters of the filter.
    effects : EffectSet or None
        Effects to correct the TDOAs for.
    network : Model or None
        Bias network to correct the TDOAs with.
    smoothed : bool
        Use later measurements for each estimate too.
    """

    config: FilterConfig | None = None
    effects: EffectSet | None = None
    network: Model | None = None
    smoothed: bool = False

    def __call__(self, flight: Flight) -> Run:
        engine = smooth if self.smoothed else run_offline
        if self.network:
            self.network.require(flight.anchors)
        effects = with_antenna(self.effects, flight, self.network)
        return engine(flight, self.config, Corrector(flight.anchors, effects, self.network))

    def remarks(self, anchors: Anchors) -> list[str]:
        """Return a sentence if a part of the correction needs more than the Anchors hold, else []."""
        return orientation_remarks(anchors, self.effects, self.network)

    @property
    def correction(self) -> str:
        """Describe the correction in words."""
        names = "+".join(part.name for part in (self.effects, self.network) if part)
        return names or "nothing (neither effects nor a network are in use)"


def with_antenna(
    effects: EffectSet | None, flight: Flight, network: Model | None = None
) -> EffectSet | None:
    """Return the EffectSet; without a lever arm of the antenna, add that of the recording.

    network : may hold the lever arm, too
    """
    arm, known = flight.meta.get("antenna"), effects.effects if effects else ()
    names = (*(network.holds if network else ()), *(effect.name for effect in known))
    if not arm or not any(arm) or TagLeverArm.name in names:
        return effects
    return EffectSet((*known, TagLeverArm(values=dict(zip("xyz", arm)))))
