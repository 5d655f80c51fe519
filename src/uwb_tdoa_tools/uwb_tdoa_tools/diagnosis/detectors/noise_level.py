"""Is a pair noisier than the others?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from ..channels import tdoa_parts
from ..channels.figures import rows_by_value
from .base import Detection, Detector
from .series import series_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..channels import ChannelResiduals

NEAR = 0.3  # s, within which two TDOAs of a pair share their slow error
FEWEST, FEWEST_LINKS = 30, 3
RATIO, SURE = 1.25, 5.0  # to the median of all pairs, and standard errors above it
MOST = 0.4  # share of the pairs; if more are noisy, that is how it is


class NoiseLevelDetector(Detector):
    """Compares the steps from one TDOA of a pair to the next."""

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
            if len(s) >= FEWEST
        }
        if len(size) < FEWEST_LINKS:
            return None
        level = np.median([s for s, _ in size.values()])
        values, std, evidence = {}, {}, 0.0
        for link, (s, count) in size.items():
            error = (
                1.17 * s / np.sqrt(count)
            )  # of a MAD; steps share their samples, hence not sqrt(2 count)
            extra = np.sqrt(max(s**2 - level**2, 0.0))
            if s > RATIO * level and s - level > SURE * error and extra > self.effect.negligible:
                key = f"{ids[link // len(ids)]}-{ids[link % len(ids)]}"
                values[key], std[key] = extra, s * error / max(extra, 1e-9)
                evidence = max(evidence, (s - level) / error)
        if not values or len(values) > MOST * len(size):
            return None
        effect = self.effect(values, std, "diagnose")
        return Detection(effect, "tdoa", {"standard_errors": round(float(evidence), 1)})
