"""The estimate of a recording: bias correction and filter as the nodes would run them, or smoothed."""

from dataclasses import dataclass

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.tag import TagLeverArm
from uwb_tdoa_bias.foundation.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import Run, run_offline
from uwb_tdoa_ekf.smoother import smooth


@dataclass(frozen=True)
class FlightEstimator:
    """estimator(flight) is the Run over a Flight; its ground truth is not used. Can be pickled.

    config : FilterConfig; effects, network : what the TDOAs are corrected with, or None; smoothed :
        use what came after each
    estimate too.
    """

    config: FilterConfig | None = None
    effects: EffectSet | None = None
    network: Network | None = None
    smoothed: bool = False

    def __call__(self, flight: Flight) -> Run:
        engine = smooth if self.smoothed else run_offline
        return engine(
            flight,
            self.config,
            Corrector(flight.anchors, with_antenna(self.effects, flight), self.network),
        )

    @property
    def correction(self) -> str:
        """What it corrects with, in words."""
        names = "+".join(part.name for part in (self.effects, self.network) if part)
        return names or "nothing (neither effects nor a network are in use)"


def with_antenna(effects: EffectSet | None, flight: Flight) -> EffectSet | None:
    """An EffectSet, or None, and the lever arm of the antenna that the recording of a Flight gives,
    unless it holds one.
    """
    arm, known = flight.meta.get("antenna"), effects.effects if effects else ()
    if not arm or not any(arm) or any(effect.name == TagLeverArm.name for effect in known):
        return effects
    return EffectSet((*known, TagLeverArm(values=dict(zip("xyz", arm)))))
