"""How an error changes, and the share of a correction that flights support."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    Errors = dict[
        str, dict[float | None, float]
    ]  # {flight: {share, None for no correction: 3D RMSE of the filter, m}}


SAME = 0.005  # of the error: what rounds to no per cent


def gain(before: float, after: float) -> float:
    """Return the share of an error that is gone: above 0 where it falls, below 0 where it rises."""
    return 1.0 - after / before


def change_of(before: float, after: float) -> str:
    """Return how an error changes: "falls by 13 %", "rises by 20 %" or "stays"."""
    return by(gain(before, after))


def by(gained: float) -> str:
    """Return the same of a `gain`."""
    return (
        "stays"
        if abs(gained) < SAME
        else f"{'falls' if gained > 0.0 else 'rises'} by {100.0 * abs(gained):.0f} %"
    )


SHARES = 0.0, 0.5, 0.75, 1.0


@dataclass(frozen=True)
class Shrinkage:
    """What flights left out say. share : of the prediction that is to be taken out; errors :
    {flight: {share: 3D RMSE of the filter, m}}, under None without any correction.
    """

    share: float
    errors: Errors

    @property
    def gains(self) -> np.ndarray:
        """(n,): by how much the error of each flight gets smaller with the share, relative to that
        without correction.
        """
        return np.array([gain(of[None], of[self.share]) for of in self.errors.values()])

    def as_text(self) -> str:
        """One sentence."""
        gains = self.gains
        return (
            f"expected of flights like these: the 3D RMSE {by(gains.mean())} +- "
            f"{100.0 * _spread(gains):.0f} % "
            f"(of {len(gains)} flights, each left out; on the worst it {by(gains.min())}), "
            f"with {self.share:g} of what is predicted taken out"
        )

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        gains = self.gains
        errors = {
            name: {str(share): error for share, error in of.items()}
            for name, of in self.errors.items()
        }
        return {
            "share": self.share,
            "gain": gains.mean(),
            "spread": _spread(gains),
            "worst": gains.min(),
            "left_out": errors,
        }


def best_share(errors: Errors) -> float:
    """The share whose error, relative to that without correction, is smallest a standard deviation
    above its mean over the flights left out. errors : as of Shrinkage.

    The mean alone takes all of a model that gains much on three flights and loses a little on the
    fourth; the flights to come are more varied than these.
    """
    ratios = {
        share: np.array([of[share] / of[None] for of in errors.values()])
        for share in SHARES
        if all(share in of for of in errors.values())
    }
    return min(ratios, key=lambda share: ratios[share].mean() + _spread(ratios[share]))


def _spread(gains: np.ndarray) -> float:
    return float(gains.std(ddof=1)) if len(gains) > 1 else 0.0
