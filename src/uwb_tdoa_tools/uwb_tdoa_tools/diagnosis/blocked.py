"""Search for an anchor that was blocked for a while, or from a region: effect nlos."""

import numpy as np

from .select import Candidate

BIN = 1.0  # s
SHORTEST = 2  # bins
LONGEST = 0.7  # share of a flight; what lasts longer is an anchor_delay
RADII = (0.6, 1.0, 1.5)  # m
CENTRES = 60


def blocked_anchors(anchors, floor_price=2.0):
    """The search for `select`: function (table, fit, chosen) -> [Candidate]; anchors : Anchors."""
    ids = anchors.ids.tolist()

    def search(table, now, chosen):
        taken = {key.partition(".")[0] for one in chosen if one.effect == "nlos" for key in one.keys}
        rows = np.flatnonzero(table.channel == 0)
        a, b = table.series[rows] // len(ids), table.series[rows] % len(ids)
        root = now.weight[rows] / (now.scale[0] ** 2 * now.inflation[0])
        out = []
        for row, name in enumerate(ids):
            if str(name) in taken:
                continue
            x = 1.0 * (b == row) - 1.0 * (a == row)
            score, power = x * root * now.residual[rows], x * x * root
            for best in (_interval(table, rows, score, power), _region(table, rows, score, power)):
                if best is not None and best[0] > 10.0:
                    out.append(_candidate(table, rows, x, str(name), *best[1:]))
        return out

    return search


def _candidate(table, rows, x, anchor, mask, fixed, extra):
    column = np.zeros(len(table.y))
    column[rows] = x * mask
    for number, cells in enumerate(table.cells):
        mine = rows[table.flight[rows] == number]
        column[mine] = cells.free(column[mine][:, None])[:, 0]
    key = f"{anchor}.delay"
    name = (f"nlos#{anchor},{','.join(f'{value:.2f}' for value in fixed.values())}", key)
    table.columns[name] = column
    return Candidate("nlos", (name,), {f"{anchor}.{part}": value for part, value in fixed.items()}, extra)


def _interval(table, rows, score, power):
    """Best (gain, mask, values, price) over intervals of one flight. (Only a flight alone has a time of its own.)"""
    if table.flight.max() > 0:
        return None
    t = table.t[rows]
    first = t.min()
    bins = ((t - first) / BIN).astype(int)
    n = bins.max() + 1
    total = np.concatenate([[0.0], np.cumsum(np.bincount(bins, score, n))])
    known = np.concatenate([[0.0], np.cumsum(np.bincount(bins, power, n))])
    i, j = np.triu_indices(n + 1, SHORTEST)
    short = (j - i) <= LONGEST * n
    i, j = i[short], j[short]
    u = np.maximum(total[j] - total[i], 0.0)
    gain = u**2 / (known[j] - known[i] + 4.0)
    if len(gain) == 0:
        return None
    best = int(np.argmax(gain))
    start, end = float(first + i[best] * BIN), float(first + j[best] * BIN)
    mask = (bins >= i[best]) & (bins < j[best])
    return gain[best], mask, {"start": start, "end": end}, 2.0 * np.log(len(gain))


def _region(table, rows, score, power):
    """Best (gain, mask, values, price) over spheres about places that were flown."""
    place = table.place[rows]
    centres = place[:: max(1, len(place) // CENTRES)]
    away = np.linalg.norm(place[None] - centres[:, None], axis=2)
    best = None
    for radius in RADII:
        mask = away <= radius
        u, v = np.maximum(mask @ score, 0.0), mask @ power
        gain = np.where(mask.mean(axis=1) <= LONGEST, u**2 / (v + 4.0), 0.0)
        k = int(np.argmax(gain))
        if best is None or gain[k] > best[0]:
            fixed = {**dict(zip("xyz", centres[k].tolist())), "radius": radius}
            best = gain[k], mask[k], fixed, 2.0 * np.log(len(centres) * len(RADII))
    return best
