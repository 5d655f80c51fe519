"""The effects on noise: they have no bias to regress on, and are judged on what all other effects leave."""

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS

from .findings import Finding
from .rows import BLOCK

SURE = 4.0  # standard errors
NEAR = 0.3  # s, within which two TDOAs of a pair share their slow error
LEAST_OUTLIER = 0.3  # m
LAGS = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5])  # s, edges of the bins of the autocovariance


def findings(left):
    """[Finding] of outlier_rate, noise_level and noise_correlation in FlightResiduals `left`."""
    parts = [_series(one.tdoa) for one in left]
    return [f for f in (_outliers(parts), _level(parts, left[0]), _correlation(parts)) if f is not None]


def _series(tdoa):
    """dict of the airborne residuals sorted by pair and time: t, r, link, new (the pair begins here), block."""
    rows = np.flatnonzero(tdoa.airborne)
    samples = tdoa.samples
    pair = samples.a[rows] * 100000 + samples.b[rows]
    order = rows[np.lexsort((samples.t[rows], pair))]
    pair = samples.a[order] * 100000 + samples.b[order]
    t = samples.t[order]
    return {
        "t": t,
        "r": tdoa.residual[order],
        "pair": pair,
        "block": ((t - t.min()) / BLOCK).astype(int),
        "a": samples.a[order],
        "b": samples.b[order],
    }


def _steps(part, lag=1):
    """(places, following places) of one pair, `lag` apart in order."""
    first = np.flatnonzero(part["pair"][lag:] == part["pair"][:-lag])
    return first, first + lag


def _outliers(parts):
    shares = []
    for part in parts:
        r = part["r"]
        around = np.stack([np.roll(r, k) for k in (-4, -3, -2, -1, 1, 2, 3, 4)])
        away = np.abs(r - np.median(around, axis=0))
        label = np.unique(part["pair"], return_inverse=True)[1]
        order = np.lexsort((away, label))
        middle = order[np.cumsum(np.bincount(label)) - (np.bincount(label) + 1) // 2]  # the median of each pair
        limit = np.maximum(5.0 * 1.4826 * away[middle], LEAST_OUTLIER)[label]
        shares += [np.mean((away > limit)[part["block"] == k]) for k in np.unique(part["block"])]
    share, error = np.mean(shares), np.std(shares) / np.sqrt(len(shares))
    if share - 2.0 * error < EFFECTS["outlier_rate"].negligible:
        return None
    effect = EFFECTS["outlier_rate"]({"share": share}, {"share": error}, "diagnose")
    return Finding(effect, "tdoa", {"standard_errors": round(float(share / max(error, 1e-9)), 1)}, 0.0)


def _level(parts, first):
    ids = first.tdoa.samples.anchors.ids
    spread = {}
    for part in parts:
        one, two = _steps(part)
        near = part["t"][two] - part["t"][one] < NEAR
        step = (part["r"][two] - part["r"][one])[near]
        low, high = np.minimum(part["a"], part["b"])[one][near], np.maximum(part["a"], part["b"])[one][near]
        for link in np.unique(low * 1000 + high):
            spread.setdefault(int(link), []).append(step[low * 1000 + high == link])
    size = {link: np.concatenate(steps) for link, steps in spread.items()}
    size = {link: (1.4826 * np.median(np.abs(s)) / np.sqrt(2.0), len(s)) for link, s in size.items() if len(s) >= 30}
    if len(size) < 3:
        return None
    level = np.median([s for s, _ in size.values()])
    values, std, evidence = {}, {}, 0.0
    for link, (s, count) in size.items():
        error = 1.17 * s / np.sqrt(count)  # of a MAD; steps share their samples, hence not sqrt(2 count)
        extra = np.sqrt(max(s**2 - level**2, 0.0))
        if s > 1.25 * level and s - level > 5.0 * error and extra > EFFECTS["noise_level"].negligible:
            key = f"{ids[link // 1000]}-{ids[link % 1000]}"
            values[key], std[key] = extra, s * error / max(extra, 1e-9)
            evidence = max(evidence, (s - level) / error)
    if not values or len(values) > 0.4 * len(size):
        return None
    return Finding(
        EFFECTS["noise_level"](values, std, "diagnose"), "tdoa", {"standard_errors": round(float(evidence), 1)}, 0.0
    )


def _correlation(parts):
    sums = []  # per block: products and counts by lag
    for part in parts:
        scale = 1.4826 * np.median(np.abs(part["r"]))
        label = np.unique(part["pair"], return_inverse=True)[1]
        r = np.clip(part["r"], -5.0 * scale, 5.0 * scale)
        r = r - (np.bincount(label, r) / np.bincount(label))[label]
        blocks = part["block"].max() + 1
        product, count = np.zeros((blocks, len(LAGS) - 1)), np.zeros((blocks, len(LAGS) - 1))
        rate = len(r) / max(len(np.unique(label)), 1) / max(np.ptp(part["t"]), 1.0)  # of one pair, Hz
        for lag in np.unique(np.geomspace(1, max(2, int(LAGS[-1] * rate)), 25).astype(int)):
            one, two = _steps(part, lag)
            bin_ = np.searchsorted(LAGS, part["t"][two] - part["t"][one], side="right") - 1
            good = (bin_ >= 0) & (bin_ < len(LAGS) - 1)
            at = part["block"][one[good]] * (len(LAGS) - 1) + bin_[good]
            product += np.bincount(at, (r[one] * r[two])[good], product.size).reshape(product.shape)
            count += np.bincount(at, minlength=count.size).reshape(count.shape)
        sums.append((product, count))
    product, count = (np.concatenate([s[k] for s in sums]) for k in range(2))
    filled = count.sum(axis=0) > 50
    if filled.sum() < 2:
        return None
    middle = 0.5 * (LAGS[:-1] + LAGS[1:])[filled]
    cov = product.sum(axis=0)[filled] / count.sum(axis=0)[filled]
    early = product[:, np.flatnonzero(filled)[0]], count[:, np.flatnonzero(filled)[0]]
    known = early[1] > 5
    each = early[0][known] / early[1][known]
    error = np.std(each) / np.sqrt(max(len(each), 1))
    if len(each) < 4 or cov[0] < SURE * error or cov[0] <= 0.0:
        return None
    times = np.geomspace(0.05, 5.0, 60)
    shape = np.exp(-middle[None] / times[:, None])
    power = np.maximum((shape @ cov) / np.sum(shape**2, axis=1), 0.0)
    best = int(np.argmin(np.sum((cov - power[:, None] * shape) ** 2, axis=1)))
    std = np.sqrt(0.5 * power[best])
    if std < EFFECTS["noise_correlation"].negligible:
        return None
    values = {"std": std, "time": times[best]}
    # The amplitude is known better than the time: rough figures from simulated flights of a minute.
    effect = EFFECTS["noise_correlation"](values, {"std": 0.1 * std, "time": 0.3 * times[best]}, "diagnose")
    return Finding(effect, "tdoa", {"standard_errors": round(float(cov[0] / error), 1)}, 0.0)
