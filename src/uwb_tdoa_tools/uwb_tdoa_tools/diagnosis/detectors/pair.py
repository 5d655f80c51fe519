# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detectors of noise: correlated errors, noisy pairs and outliers, in residuals in the air."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from ...clock import numbered
from ..channels import ChannelResiduals, tdoa_parts
from ..channels.figures import rows_by_value
from ..channels.radio import TdoaResidual
from ..regression.table import BLOCK
from .base import Detection, Detector

# noise_correlation
SURE_CORRELATION = 4.0  # standard errors of the autocovariance at the shortest lag
LAGS = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5])  # s, edges of bins of lags
CLIP = 5.0  # spreads, limit of a residual
TIMES = np.geomspace(0.05, 5.0, 60)  # s, correlation times that are tried
FEWEST, FEWEST_BLOCKS = 50, 4  # fewest products in a bin of lags, and fewest blocks of time
# noise_level
NEAR = 0.3  # s, two TDOAs of a pair that are nearer share their slow error
FEWEST_STEPS, FEWEST_LINKS = 30, 3  # fewest steps of a pair, and fewest pairs
# smallest noise of a noisy pair: ratio to the median of all pairs, and standard errors above it
RATIO, SURE_LEVEL = 1.25, 5.0
MOST = 0.4  # share of noisy pairs; if there are more, no pair is an exception
# outlier_rate
LEAST = 0.3  # m, smallest outlier
# smallest outlier in spreads of the pair; deviation from the median of neighbours in time
SPREADS = 5.0
AROUND = (-4, -3, -2, -1, 1, 2, 3, 4)  # offsets of the neighbours in time


@dataclass(frozen=True)
class Series:
    """TDOA residuals in the air, sorted by pair and time.

    t : (n,) s; residual : (n,) m; a, b : (n,) rows of anchors
    pair : (n,) number of the ordered pair, from 0 without gaps
    block : (n,) number of the block of 5 s
    """

    t: np.ndarray
    residual: np.ndarray
    a: np.ndarray
    b: np.ndarray
    pair: np.ndarray
    block: np.ndarray

    @classmethod
    def of(cls, part: TdoaResidual) -> Series:
        """Return the Series of a TdoaResidual."""
        samples, rows = part.samples, np.flatnonzero(part.airborne)
        label = samples.a[rows] * 100000 + samples.b[rows]
        order = np.lexsort((samples.t[rows], label))
        rows, label = rows[order], label[order]
        t, a, b = samples.t[rows], samples.a[rows], samples.b[rows]
        pair = np.unique(label, return_inverse=True)[1]
        return cls(t, part.residual[rows], a, b, pair, numbered(t, BLOCK))

    def steps(self, lag: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return (rows, later rows) of the same pair, `lag` apart in order."""
        first = np.flatnonzero(self.pair[lag:] == self.pair[:-lag])
        return first, first + lag


def series_of(residuals: Sequence[ChannelResiduals]) -> list[Series]:
    """Return the Series of the TDOA residuals of each flight."""
    return [Series.of(part) for part in tdoa_parts(residuals)]


class NoiseCorrelationDetector(Detector):
    """Fit an exponential to the autocovariance of residuals of pairs."""

    effect = EFFECTS["noise_correlation"]

    def detect(self, residuals: Sequence[ChannelResiduals]) -> Detection | None:
        sums = [_products(series) for series in series_of(residuals)]
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
        if (
            len(each) < FEWEST_BLOCKS
            or covariance[0] < SURE_CORRELATION * error
            or covariance[0] <= 0.0
        ):
            return None
        shape = np.exp(-middle[None] / TIMES[:, None])
        power = np.maximum((shape @ covariance) / np.sum(shape**2, axis=1), 0.0)
        best = int(np.argmin(np.sum((covariance - power[:, None] * shape) ** 2, axis=1)))
        std = np.sqrt(0.5 * power[best])
        if std < self.effect.row.negligible:
            return None
        # Rough standard errors, from simulated flights of one minute.
        errors = {"std": 0.1 * std, "time": 0.3 * TIMES[best]}
        effect = self.effect({"std": std, "time": TIMES[best]}, errors, "diagnose")
        return Detection(
            effect, "tdoa", {"standard_errors": round(float(covariance[0] / error), 1)}
        )


def _products(series: Series) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of products of residuals of one pair by block and lag, and their counts."""
    scale = 1.4826 * np.median(np.abs(series.residual))
    label = series.pair
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


class NoiseLevelDetector(Detector):
    """Compare the steps from one TDOA of a pair to the next with the steps of all pairs."""

    effect = EFFECTS["noise_level"]

    def detect(self, residuals: Sequence[ChannelResiduals]) -> Detection | None:
        ids = tdoa_parts(residuals)[0].samples.anchors.ids
        steps: dict[int, list[np.ndarray]] = {}
        for series in series_of(residuals):
            first, second = series.steps()
            near = series.t[second] - series.t[first] < NEAR
            step = (series.residual[second] - series.residual[first])[near]
            a, b = series.a[first][near], series.b[first][near]
            link = np.minimum(a, b) * len(ids) + np.maximum(a, b)
            for number, rows in rows_by_value(link):
                steps.setdefault(number, []).append(step[rows])
        joined = {link: np.concatenate(several) for link, several in steps.items()}
        size = {
            link: (1.4826 * np.median(np.abs(s)) / np.sqrt(2.0), len(s))
            for link, s in joined.items()
            if len(s) >= FEWEST_STEPS
        }
        if len(size) < FEWEST_LINKS:
            return None
        level = np.median([s for s, _ in size.values()])
        values, std, evidence = {}, {}, 0.0
        for link, (s, count) in size.items():
            error = 1.17 * s / np.sqrt(count)  # of a MAD; steps share samples: not sqrt(2 count)
            extra = np.sqrt(max(s**2 - level**2, 0.0))
            if (
                s > RATIO * level
                and s - level > SURE_LEVEL * error
                and extra > self.effect.row.negligible
            ):
                key = f"{ids[link // len(ids)]}-{ids[link % len(ids)]}"
                values[key], std[key] = extra, s * error / max(extra, 1e-9)
                evidence = max(evidence, (s - level) / error)
        if not values or len(values) > MOST * len(size):
            return None
        effect = self.effect(values, std, "diagnose")
        return Detection(effect, "tdoa", {"standard_errors": round(float(evidence), 1)})


class OutlierRateDetector(Detector):
    """Count TDOAs that are far from their neighbours in time, pair by pair."""

    effect = EFFECTS["outlier_rate"]

    def detect(self, residuals: Sequence[ChannelResiduals]) -> Detection | None:
        shares = [share for series in series_of(residuals) for share in _shares(series)]
        share, error = float(np.mean(shares)), float(np.std(shares) / np.sqrt(len(shares)))
        if share - 2.0 * error < self.effect.row.negligible:
            return None
        effect = self.effect({"share": share}, {"share": error}, "diagnose")
        return Detection(
            effect, "tdoa", {"standard_errors": round(float(share / max(error, 1e-9)), 1)}
        )


def _shares(series: Series) -> list[float]:
    """Return the share of outliers in every block."""
    r = series.residual
    away = np.abs(r - np.median(np.stack([np.roll(r, k) for k in AROUND]), axis=0))
    label = series.pair
    order, count = np.lexsort((away, label)), np.bincount(label)
    middle = order[np.cumsum(count) - (count + 1) // 2]  # the median of each pair
    limit = np.maximum(SPREADS * 1.4826 * away[middle], LEAST)[label]
    return [np.mean((away > limit)[series.block == k]) for k in np.unique(series.block)]
