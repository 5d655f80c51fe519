"""Is the floor near? Effect floor_multipath, which no airborne sample shows."""

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from .findings import Finding

BIN = 1.0  # s, taken as independent
LEAST = 4  # bins
SURE = 5.0  # standard errors
SPREAD = 2.0  # times the spread in the air that is noise of its own


def finding(left):
    """A Finding of floor_multipath in FlightResiduals `left`, or None. Below 0.4 m: size from the regression on its
    shape if that is sure, else from how much more the residuals scatter than in the air."""
    kind = EFFECTS["floor_multipath"]
    if left[0].estimated:
        return None
    sums, low, high, strengths = [], [], [], []
    for one in left:
        samples, r = one.tdoa.samples, np.clip(one.tdoa.residual, -20.0, 20.0)
        strength = kind.strength(samples.p[:, 2])
        near = strength > 0.2
        if near.sum() < 50 or one.tdoa.airborne.sum() < 50:
            continue
        x = kind().regressors(samples, ("size",))[near, 0]
        bins = np.unique(((samples.t[near] - samples.start) / BIN).astype(int), return_inverse=True)[1]
        sums.append(np.stack([np.bincount(bins, x * r[near]), np.bincount(bins, x * x)], axis=1))
        low.append(r[near])
        high.append(r[one.tdoa.airborne])
        strengths.append(strength[near])
    if not sums or sum(map(len, sums)) < LEAST:
        return None
    sums, low, high = np.concatenate(sums), np.concatenate(low), np.concatenate(high)
    size = sums[:, 0].sum() / max(sums[:, 1].sum(), 1e-12)
    error = np.sqrt(np.sum((sums[:, 0] - size * sums[:, 1]) ** 2)) / max(sums[:, 1].sum(), 1e-12)
    air, floor = (1.4826 * np.median(np.abs(part)) for part in (high, low))
    evidence = {
        "standard_errors": round(float(size / max(error, 1e-9)), 1),
        "spread_over_air": round(float(floor / air), 1),
    }
    if size < SURE * error:
        if floor < SPREAD * air:
            return None
        size = np.sqrt(max(floor**2 - air**2, 0.0) / np.mean(np.concatenate(strengths) ** 2))
    if size < kind.negligible:
        return None
    effect = kind({"size": min(size, kind.bound)}, {"size": max(error, 1e-6)}, "diagnose")
    return Finding(effect, "tdoa", evidence, 0.0)
