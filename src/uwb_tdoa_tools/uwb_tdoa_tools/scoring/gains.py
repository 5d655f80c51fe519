# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How an error changes, and the share of a correction that flights support."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

# {flight: {share, None for no correction: 3D RMSE of the filter, m}}
Errors = dict[str, dict[float | None, float]]

SAME = 0.005  # share of the error: a smaller change rounds to 0 %
LOSS = 0.03  # share of the error: a smaller loss may be risked for a larger expected gain
NO_DIFFERENCE = "no difference that these flights can show"
SHARES = 0.0, 0.5, 0.75, 1.0


def gain(before: float, after: float) -> float:
    """Return the relative reduction of an error; negative if the error rises."""
    return 1.0 - after / before


def change_in_words(before: float, after: float) -> str:
    """Return how an error changes: "falls by 13 %", "rises by 20 %" or "stays"."""
    return gain_in_words(gain(before, after))


def gain_in_words(gained: float) -> str:
    """Return a `gain` in the same words."""
    return (
        "stays"
        if abs(gained) < SAME
        else f"{'falls' if gained > 0.0 else 'rises'} by {100.0 * abs(gained):.0f} %"
    )


def clear_change(before: float, after: float, interval: Sequence[float] | None = None) -> int:
    """Return 1 if an error clearly falls, -1 if it clearly rises, and 0 otherwise.

    A change is clear if its `interval` excludes zero. A gain is clear, too, if more than LOSS is
    expected, and the probability of a loss above LOSS is below 2.5 %. Without an interval a change
    is clear from SAME on.

    Parameters
    ----------
    before, after : float
        The error, in one unit.
    interval : (low, high), optional
        95 % interval of the `gain`.
    """
    gained = gain(before, after) if before else 0.0
    low, high = (gained - SAME, gained + SAME) if interval is None else interval
    expected, half_width = 0.5 * (low + high), 0.5 * (high - low)
    # With the second condition a loss of LOSS lies outside of the interval.
    worth_the_risk = interval is not None and expected > LOSS and expected + LOSS > half_width
    falls, rises = low > 0.0 or worth_the_risk, high < 0.0
    return int(falls) - int(rises)


@dataclass(frozen=True)
class Shrinkage:
    """Share of a correction that cross-validation over flights supports.

    Attributes
    ----------
    share : share of the prediction to subtract.
    errors : {flight: {share: 3D RMSE of the filter, m}}; the key None is without correction.
    """

    share: float
    errors: Errors

    @property
    def gains(self) -> np.ndarray:
        """Return the `gain` of each flight with the share: (n,)."""
        return np.array([gain(of[None], of[self.share]) for of in self.errors.values()])

    def as_text(self) -> str:
        """Return the expected gain as one sentence."""
        gains = self.gains
        return (
            f"expected of flights like these: the 3D RMSE {gain_in_words(gains.mean())} +- "
            f"{100.0 * _spread(gains):.0f} % "
            f"(of {len(gains)} flights, each left out; on the worst it {gain_in_words(gains.min())}), "
            f"with {self.share:g} of what is predicted taken out"
        )

    @property
    def parts(self) -> tuple[float, float]:
        """Return mean gains: of the larger deviation alone, share 0, and of the subtraction beyond it."""
        pairs = [(None, 0.0), (0.0, self.share)]
        widened, subtracted = (
            float(np.mean([gain(of[one], of[other]) for of in self.errors.values()]))
            for one, other in pairs
        )
        return widened, subtracted

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
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
    """Return the share with the smallest relative error, one standard deviation above its mean.

    Mean and standard deviation are over the left-out flights in `errors`, see Shrinkage. Errors are
    relative to no correction. The mean alone would favour a model that gains much on three flights
    and harms the fourth. Future flights vary more than these.
    """
    ratios = {
        share: np.array([of[share] / of[None] for of in errors.values()])
        for share in SHARES
        if all(share in of for of in errors.values())
    }
    return min(ratios, key=lambda share: ratios[share].mean() + _spread(ratios[share]))


def _spread(gains: np.ndarray) -> float:
    return float(gains.std(ddof=1)) if len(gains) > 1 else 0.0
