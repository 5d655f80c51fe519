"""Is the floor near? No sample in the air shows it."""

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from .base import Detection, Detector

BIN = 1.0  # s, taken as independent
FEWEST_BINS, FEWEST = 4, 50
SURE = 5.0  # standard errors
RATIO = 2.0  # to the scatter in the air, above which it is noise of its own
NEAR = 0.2  # strength of the effect that counts as near the floor
WILD = 20.0  # m that an outlier counts as


class FloorMultipathDetector(Detector):
    """Size from the regression of what is near the floor on the effect's shape if that is sure, else from how much more
    the residuals scatter than in the air."""

    effect = EFFECTS["floor_multipath"]

    def detect(self, residuals):
        sums, low, high, strengths = [], [], [], []
        for part in (flight["tdoa"] for flight in residuals if "tdoa" in flight):
            samples, r = part.samples, np.clip(part.residual, -WILD, WILD)
            strength = self.effect.strength(samples.p[:, 2])
            near = strength > NEAR
            if part.innovations is not None or near.sum() < FEWEST or part.airborne.sum() < FEWEST:
                continue  # where it stands is not known, or it was not there
            x = self.effect().regressors(samples, ("size",))[near, 0]
            bins = np.unique(((samples.t[near] - samples.start) / BIN).astype(int), return_inverse=True)[1]
            sums.append(np.stack([np.bincount(bins, x * r[near]), np.bincount(bins, x * x)], axis=1))
            low.append(r[near])
            high.append(r[part.airborne])
            strengths.append(strength[near])
        if sum(map(len, sums)) < FEWEST_BINS:
            return None
        sums, low, high = np.concatenate(sums), np.concatenate(low), np.concatenate(high)
        size = sums[:, 0].sum() / max(sums[:, 1].sum(), 1e-12)
        error = np.sqrt(np.sum((sums[:, 0] - size * sums[:, 1]) ** 2)) / max(sums[:, 1].sum(), 1e-12)
        air, floor = (1.4826 * np.median(np.abs(part)) for part in (high, low))
        evidence = {
            "standard_errors": round(float(size / max(error, 1e-9)), 1),
            "scatter_over_air": round(float(floor / air), 1),
        }
        if size < SURE * error:
            if floor < RATIO * air:
                return None
            size = np.sqrt(max(floor**2 - air**2, 0.0) / np.mean(np.concatenate(strengths) ** 2))
        if size < self.effect.negligible:
            return None
        effect = self.effect({"size": min(size, self.effect.bound)}, {"size": max(error, 1e-6)}, "diagnose")
        return Detection(effect, "tdoa", evidence)
