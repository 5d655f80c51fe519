"""Do errors outlast one measurement?"""

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

SURE = 4.0  # standard errors
LAGS = np.array(
    [0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5]
)  # s, edges of the bins of the autocovariance
CLIP = 5.0  # spreads that an outlier counts as
TIMES = np.geomspace(0.05, 5.0, 60)  # s, that are tried
FEWEST, FEWEST_BLOCKS = 50, 4


class NoiseCorrelationDetector(Detector):
    """Fits an exponential to the autocovariance of the pairs."""

    effect = EFFECTS["noise_correlation"]

    def detect(self, residuals: Sequence[ChannelResiduals]) -> Detection | None:
        sums = [
            _products(series) for series in series_of(residuals)
        ]  # per block: products and counts by lag
        product, count = (np.concatenate([s[k] for s in sums]) for k in range(2))
        filled = count.sum(axis=0) > FEWEST
        if filled.sum() < 2:
            return None
        middle = 0.5 * (LAGS[:-1] + LAGS[1:])[filled]
        covariance = product.sum(axis=0)[filled] / count.sum(axis=0)[filled]
        shortest = np.flatnonzero(filled)[0]
        known = count[:, shortest] > 5
        each = product[known, shortest] / count[known, shortest]
        error = np.std(each) / np.sqrt(max(len(each), 1))
        if len(each) < FEWEST_BLOCKS or covariance[0] < SURE * error or covariance[0] <= 0.0:
            return None
        shape = np.exp(-middle[None] / TIMES[:, None])
        power = np.maximum((shape @ covariance) / np.sum(shape**2, axis=1), 0.0)
        best = int(np.argmin(np.sum((covariance - power[:, None] * shape) ** 2, axis=1)))
        std = np.sqrt(0.5 * power[best])
        if std < self.effect.negligible:
            return None
        # The amplitude is known better than the time: rough figures from simulated flights of a
        # minute.
        errors = {"std": 0.1 * std, "time": 0.3 * TIMES[best]}
        effect = self.effect({"std": std, "time": TIMES[best]}, errors, "diagnose")
        return Detection(
            effect, "tdoa", {"standard_errors": round(float(covariance[0] / error), 1)}
        )


def _products(series: Series) -> tuple[np.ndarray, np.ndarray]:
    """(blocks, bins) sums of products of residuals of one pair, and their counts, by the time
    between them.
    """
    scale = 1.4826 * np.median(np.abs(series.residual))
    label = series.label()
    r = np.clip(series.residual, -CLIP * scale, CLIP * scale)
    r = r - (np.bincount(label, r) / np.bincount(label))[label]
    shape = series.block.max() + 1, len(LAGS) - 1
    product, count = np.zeros(shape), np.zeros(shape)
    rate = len(r) / max(label.max() + 1, 1) / max(np.ptp(series.t), 1.0)  # of one pair, Hz
    for lag in np.unique(np.geomspace(1, max(2, int(LAGS[-1] * rate)), 25).astype(int)):
        first, second = series.steps(lag)
        number = np.searchsorted(LAGS, series.t[second] - series.t[first], side="right") - 1
        good = (number >= 0) & (number < shape[1])
        at = series.block[first[good]] * shape[1] + number[good]
        product += np.bincount(at, (r[first] * r[second])[good], product.size).reshape(shape)
        count += np.bincount(at, minlength=count.size).reshape(shape)
    return product, count
