"""How many TDOAs are plainly wrong?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from .base import Detection, Detector
from .series import series_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..channels import ChannelResiduals
    from .series import Series

LEAST = 0.3  # m
SPREADS = 5.0  # of what a pair scatters about the median of its neighbours in time
AROUND = (-4, -3, -2, -1, 1, 2, 3, 4)


class OutlierRateDetector(Detector):
    """Counts what is far from its neighbours in time, pair by pair."""

    effect = EFFECTS["outlier_rate"]

    def detect(self, residuals: Sequence[ChannelResiduals]) -> Detection | None:
        shares = [share for series in series_of(residuals) for share in _shares(series)]
        share, error = float(np.mean(shares)), float(np.std(shares) / np.sqrt(len(shares)))
        if share - 2.0 * error < self.effect.negligible:
            return None
        effect = self.effect({"share": share}, {"share": error}, "diagnose")
        return Detection(
            effect, "tdoa", {"standard_errors": round(float(share / max(error, 1e-9)), 1)}
        )


def _shares(series: Series) -> list[float]:
    """Share of outliers in every block."""
    r = series.residual
    away = np.abs(r - np.median(np.stack([np.roll(r, k) for k in AROUND]), axis=0))
    label = series.label()
    order, count = np.lexsort((away, label)), np.bincount(label)
    middle = order[np.cumsum(count) - (count + 1) // 2]  # the median of each pair
    limit = np.maximum(SPREADS * 1.4826 * away[middle], LEAST)[label]
    return [np.mean((away > limit)[series.block == k]) for k in np.unique(series.block)]
