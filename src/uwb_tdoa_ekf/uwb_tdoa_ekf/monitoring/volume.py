"""Whether the tag is where it can be located, and the filter's own covariance against what is
possible there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.flyable import FlyableVolume


class VolumeCheck:
    """Checks positions against a FlyableVolume, or says nothing without one."""

    def __init__(self, volume: FlyableVolume | None = None) -> None:
        self._volume = volume

    def trouble_at(
        self, anchors: Anchors, position: np.ndarray, covariance: np.ndarray
    ) -> tuple[str | None, dict[str, str]]:
        """(what is wrong, or None; {key: text}). anchors : Anchors; position (3,) m; covariance (3,
        3) m^2 of it.

        Efficiency is the variance of the bound of one round of TDOAs over that which the filter
        claims. The filter also uses earlier rounds and the inertial sensor: n says "as good as n
        independent rounds".
        """
        if self._volume is None:
            return None, {}
        if not self._volume.belongs_to(anchors):
            return "flyable_volume was made for other anchors: make it anew with plan", {
                "flyable": "unknown"
            }
        flyable = bool(self._volume.contains(position))
        bound, used = float(self._volume.bound_at(position)), 2 if self._volume.planar else 3
        values = {"flyable": "yes" if flyable else "no"}
        if np.isfinite(bound):
            claimed = float(np.sqrt(np.trace(covariance[:used, :used])))
            values |= {
                "bound of one round": f"{bound:.3f} m",
                "claimed by the filter": f"{claimed:.3f} m",
            }
            values |= {"efficiency": f"{(bound / max(claimed, 1e-9)) ** 2:.3g}"}
        if flyable:
            return None, values
        return (
            (
                "the tag is outside of the flyable volume: its position may be wrong by metres; "
                "fly it back"
            ),
            values,
        )
