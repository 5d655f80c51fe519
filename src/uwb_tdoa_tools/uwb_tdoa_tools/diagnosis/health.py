"""Health of every channel: of pairs, anchors and axes."""

import numpy as np

from uwb_tdoa_ekf.core.engine import REJECTED, USED

LAG_TIMES = (0.1, 0.5, 1.0, 2.0)  # s


def health(residuals, runs=(), scores=()):
    """What [{channel: ChannelResidual}] look like: {"pairs", "anchors", "axes", "cross_correlation", "filter"}.

    Each pair, anchor and axis: bias (median), spread (1.48 MAD), tails (share beyond 4 spreads), autocorrelation at
    0.1 to
    2 s, count. runs, scores : Run and Score of each flight, for NIS (1 is honest) and NEES (3 is honest).
    """
    parts = [flight["tdoa"] for flight in residuals]
    tdoa, anchors = _joined(parts), parts[0].samples.anchors.ids
    pairs = {}
    for label in np.unique(tdoa["pair"]):
        mine = tdoa["pair"] == label
        name = f"{anchors[label // 1000]}-{anchors[label % 1000]}"
        pairs[name] = {"pair": name, **_figures(tdoa["t"][mine], tdoa["r"][mine])}
    each = []
    for row, anchor in enumerate(anchors.tolist()):
        late = np.concatenate([tdoa["r"][tdoa["pair"] % 1000 == row], -tdoa["r"][tdoa["pair"] // 1000 == row]])
        if len(late):
            each.append({"anchor": anchor, **_figures(None, late)})
    axes = []
    for sensor in ("gyro", "accel"):
        parts = [flight[sensor] for flight in residuals if sensor in flight]
        for k, axis in enumerate("xyz") if parts else ():
            t = np.concatenate([part.samples.t + 1e4 * number for number, part in enumerate(parts)])
            axes.append({"axis": f"{sensor}.{axis}", **_figures(t, np.concatenate([p.residual[:, k] for p in parts]))})
    return {
        "pairs": list(pairs.values()),
        "anchors": each,
        "axes": axes,
        "cross_correlation": _crossed(tdoa, anchors),
        "filter": [_filter(run, score) for run, score in zip(runs, scores)],
    }


def _joined(parts):
    t, r, pair = [], [], []
    for number, part in enumerate(parts):
        chosen = part.airborne
        t.append(part.samples.t[chosen] + 1e4 * number)
        r.append(part.residual[chosen])
        pair.append(part.samples.a[chosen] * 1000 + part.samples.b[chosen])
    return {"t": np.concatenate(t), "r": np.concatenate(r), "pair": np.concatenate(pair)}


def _figures(t, r):
    bias = float(np.median(r))
    spread = float(1.4826 * np.median(np.abs(r - bias)))
    out = {
        "count": len(r),
        "bias": bias,
        "spread": spread,
        "tails": float(np.mean(np.abs(r - bias) > 4.0 * max(spread, 1e-12))),
    }
    if t is not None and len(t) > 50:
        out["autocorrelation"] = {f"{lag:g} s": autocorrelation(t, r, lag) for lag in LAG_TIMES}
    return out


def autocorrelation(t, r, lag):
    """Correlation of a series r at rising stamps t with itself `lag` seconds later; None without such pairs."""
    r = np.clip(r - np.median(r), *np.array([-5.0, 5.0]) * max(1.4826 * np.median(np.abs(r - np.median(r))), 1e-12))
    later = np.searchsorted(t, t + lag)
    inside = later < len(t)
    first, second = np.flatnonzero(inside), later[inside]
    near = np.abs(t[second] - t[first] - lag) < 0.3 * lag
    if near.sum() < 20 or np.mean(r**2) == 0.0:
        return None
    return float(np.mean(r[first[near]] * r[second[near]]) / np.mean(r**2))


def _crossed(tdoa, anchors):
    """The strongest correlations between half-second means of two pairs: [{"pairs", "correlation"}]."""
    labels, place = np.unique(tdoa["pair"], return_inverse=True)
    cell = np.unique((tdoa["t"] * 2.0).astype(int), return_inverse=True)[1]
    shape = (cell.max() + 1, len(labels))
    at = cell * len(labels) + place
    count = np.bincount(at, minlength=shape[0] * shape[1]).reshape(shape)
    mean = np.bincount(at, tdoa["r"], shape[0] * shape[1]).reshape(shape) / np.maximum(count, 1)
    out = []
    for i in range(len(labels)):
        for k in range(i):
            both = (count[:, i] > 0) & (count[:, k] > 0)
            if both.sum() > 20 and mean[both, i].std() > 0.0 and mean[both, k].std() > 0.0:
                rho = float(np.corrcoef(mean[both, i], mean[both, k])[0, 1])
                names = [f"{anchors[x // 1000]}-{anchors[x % 1000]}" for x in (labels[k], labels[i])]
                out.append({"pairs": names, "correlation": round(rho, 3)})
    return sorted(out, key=lambda item: -abs(item["correlation"]))[:10]


def _filter(run, score):
    reached = (run.residuals.verdict == USED) | (run.residuals.verdict == REJECTED)
    nis = run.residuals.innovation[reached] ** 2 / run.residuals.variance[reached]
    return {
        "flight": score.name,
        "nis_mean": float(nis.mean()),
        "nis_below_3.84": float(np.mean(nis < 3.84)),  # 95 % of an honest one
        "nees_mean": float(np.mean(score.nees)),
        "nees_below_7.81": float(np.mean(score.nees < 7.81)),
    }
