"""Residuals and regressors as one table of a linear fit.

Neighbouring TDOAs are alike, so that hundreds a second are not hundreds of facts. They are averaged, pair by pair, over
cells of half a second, without the outliers of the cell; what likeness is left between cells is counted in fit.py.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.effects import EFFECTS

CELL = 0.5  # s, of TDOAs
FREE_CELL = 0.25  # s, within which an unknown position error is taken as constant
BLOCK = 5.0  # s, taken as independent of each other
CHANNELS = ("tdoa", "gyro", "accel")
OUTLIER = 4.0  # spreads within a cell


@dataclass
class Table:
    """n rows of a linear model y = X beta + noise.

    y (n,); channel (n,) place in CHANNELS; series (n,) pair or axis; block (n,) number of an independent block;
    flight (n,); t (n,) s since the start; count (n,) samples averaged; place (n, 3) m; columns {(effect, key): (n,)}.
    cells : per flight, the averaging, with which further TDOA columns can be made.
    """

    y: np.ndarray
    channel: np.ndarray
    series: np.ndarray
    block: np.ndarray
    flight: np.ndarray
    t: np.ndarray
    count: np.ndarray
    place: np.ndarray
    columns: dict
    cells: list = field(default_factory=list)

    def matrix(self, names):
        """(n, len(names)) of columns."""
        return np.stack([self.columns[name] for name in names], axis=1) if names else np.empty((len(self.y), 0))


class Cells:
    """How the TDOAs of one flight are averaged."""

    def __init__(self, residual, width=CELL, free=False):
        """residual : TdoaResidual; width : s; free : the position is only an estimate, whose error is projected out."""
        samples, chosen = residual.samples, np.flatnonzero(residual.airborne)
        n = len(samples.anchors)
        t = samples.t[chosen]
        cell = ((t - t[0]) / width).astype(np.int64)
        pair = samples.a[chosen].astype(np.int64) * n + samples.b[chosen]
        label = cell * n * n + pair
        y = residual.residual[chosen]
        order = np.lexsort((y, label))
        _, first, group, size = np.unique(label[order], return_index=True, return_inverse=True, return_counts=True)
        median = 0.5 * (y[order][first + (size - 1) // 2] + y[order][first + size // 2])
        away = np.abs(y[order] - median[group])
        crowded = size[group] >= 4
        spread = 1.4826 * np.median(away[crowded]) * 1.2 if crowded.sum() > 50 else np.inf
        good = (away <= OUTLIER * spread) & (np.abs(y[order]) < 20.0)
        self.rows = chosen[order][good]
        self.group = np.unique(group[good], return_inverse=True)[1]
        self.size = np.bincount(self.group).astype(float)
        self.white = spread
        self.t = self.mean(samples.t)
        start = np.searchsorted(self.group, np.arange(len(self.size)))
        self.pair = samples.a[self.rows][start] * n + samples.b[self.rows][start]
        self.cell = ((self.t - t[0]) / width).astype(np.int64)
        self._free = None
        if free:
            self._free = np.stack([self.mean(column) for column in residual.jacobian.T], axis=1)
            self._places = [np.flatnonzero(self.cell == c) for c in np.unique(self.cell)]

    def mean(self, values):
        """Means of per-TDOA values (n,) over the cells: (m,)."""
        return np.bincount(self.group, values[self.rows]) / self.size

    def means(self, values):
        """Columns (n, k) averaged, and without what an unknown position error would explain: (m, k)."""
        return self.free(np.stack([self.mean(np.nan_to_num(column)) for column in values.T], axis=1))

    def free(self, out):
        """Averages (m, k) without what an unknown position error would explain."""
        if self._free is not None:
            out = out.copy()
            root = np.sqrt(self.size)[:, None]
            for places in self._places:
                q = np.linalg.qr(root[places] * self._free[places])[0]
                scaled = root[places] * out[places]
                out[places] = (scaled - q @ (q.T @ scaled)) / root[places]
        return out


def candidates(found):
    """{(effect, group of keys)} worth a look in these FlightResiduals: list of (effect class, keys)."""
    samples = [f.tdoa.samples for f in found]
    anchors = _all_anchors([s.anchors for s in samples])
    heard = np.concatenate([s.anchors.ids[np.column_stack([s.a, s.b])] for s in samples])
    pairs, count = np.unique(heard, axis=0, return_counts=True)
    pairs = pairs[np.argsort(-count, kind="stable")]
    inertial = any(f.gyro is not None for f in found)
    out = []
    for effect in EFFECTS.values():
        if effect.fitted and ("tdoa" in effect.channels or inertial):
            out += [(effect, keys) for keys in effect.groups(anchors, pairs)]
    return out


def _all_anchors(several):
    """Anchors with every id of several Anchors, each in the first of its places."""
    ids, positions, orientations = (
        np.concatenate([getattr(one, name) for one in several]) for name in ("ids", "positions", "orientations")
    )
    first = np.unique(ids, return_index=True)[1]
    return Anchors(ids[first], positions[first], orientations[first], several[0].frame)


def build(found, wanted, model=()):
    """Table of several FlightResiduals for the (effect class, keys) in `wanted`, linearised about the effects in
    `model`."""
    names, here = {}, {effect.name: effect for effect in model}
    for effect, keys in wanted:
        here.setdefault(effect.name, effect())
        names.setdefault(effect.name, {}).update(dict.fromkeys(keys))
    names = [(here[name], tuple(keys)) for name, keys in names.items()]
    parts, block, cells = [], 0, []
    for number, one in enumerate(found):
        cell = Cells(one.tdoa, FREE_CELL if one.estimated else CELL, one.estimated)
        cells.append(cell)
        parts.append(_tdoa_part(one, cell, names, number))
        for place, (name, residual) in enumerate((("gyro", one.gyro), ("accel", one.accel)), start=1):
            if residual is not None:
                parts.append(_imu_part(residual, name, place, names, number))
        start = min(part["t"].min() for part in parts if part["flight"][0] == number)
        own = [part for part in parts if part["flight"][0] == number]
        for part in own:
            part["block"] = block + ((part["t"] - start) / BLOCK).astype(int)
        block = max(part["block"].max() for part in own) + 1
    columns = {}
    for effect, keys in names:
        for key in keys:
            name = (effect.name, key)
            columns[name] = np.concatenate([part["columns"].get(name, np.zeros(len(part["y"]))) for part in parts])
    merged = {
        key: np.concatenate([part[key] for part in parts])
        for key in ("y", "channel", "series", "block", "flight", "t", "count", "place")
    }
    return Table(**merged, columns=columns, cells=cells)


def _tdoa_part(one, cells, names, number):
    samples = one.tdoa.samples
    columns = {}
    for effect, keys in names:
        if "tdoa" not in effect.channels:
            continue
        values = cells.means(effect.regressors(samples, list(keys)))
        columns.update({(effect.name, key): values[:, k] for k, key in enumerate(keys)})
    m = len(cells.size)
    return {
        "y": cells.means(one.tdoa.residual[:, None])[:, 0],
        "channel": np.zeros(m, dtype=int),
        "series": cells.pair,
        "flight": np.full(m, number),
        "t": cells.t - samples.start,
        "count": cells.size,
        "columns": columns,
        "place": np.stack([cells.mean(column) for column in samples.p.T], axis=1),
    }


def _imu_part(residual, name, place, names, number):
    n = len(residual.t)
    columns = {}
    for effect, keys in names:
        if name not in effect.channels:
            continue
        if effect.name == "truth_time_offset":
            values = np.repeat(residual.change[:, :, None], len(keys), axis=2)
        else:
            # What is less noisy: the gyroscope itself, but for the accelerometer the truth. Noise in a regressor
            # shrinks it.
            values = effect.imu_regressors(name, residual.true + (name == "gyro") * residual.residual, list(keys))
            if effect.name == "imu_gravity":
                up = Rotation.from_quat(residual.samples.q).inv().apply([0.0, 0.0, 1.0])
                values = np.repeat(up[:, :, None], len(keys), axis=2)  # the true vertical, not the body's z
        columns.update({(effect.name, key): values[:, :, k].T.ravel() for k, key in enumerate(keys)})
    return {
        "y": residual.residual.T.ravel(),
        "channel": np.full(3 * n, place),
        "series": np.repeat(np.arange(3), n),
        "flight": np.full(3 * n, number),
        "t": np.tile(residual.t - residual.samples.start, 3),
        "count": np.ones(3 * n),
        "columns": columns,
        "place": np.tile(residual.samples.p, (3, 1)),
    }
