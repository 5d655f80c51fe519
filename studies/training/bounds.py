# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A bound for any model of the pose, and the share of the errors that repeats at the same place."""

from types import SimpleNamespace

import numpy as np

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.correction.corrector import Correction
from uwb_tdoa_bias.correction.model import NETWORK
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.scoring.metrics import Score, position_at, scored_phase
from uwb_tdoa_tools.training.labels import LARGEST_ERROR

CELL = 0.3  # m, size of the cells in which residuals of two flights are compared


def rmse(flight, corrector=None):
    """3D RMSE of the filter's estimate on a Flight, m."""
    return Score(
        flight.name, run_offline(flight, corrector=corrector).odometry, flight.truth
    ).row()["rmse_3d"]


def oracle(flight, window):
    """A substitute for a Corrector that gets the error of each TDOA from the ground truth.

    The error is the running median of the errors of a pair over `window` s. This is a bound for
    every model that does not follow the error faster.
    """
    data, anchors, truth = flight.tdoa, flight.anchors, flight.truth
    a, b = anchors.index(data.a), anchors.index(data.b)
    p = position_at(data.t, truth)
    error = data.d - tdoa(p, anchors.positions[a], anchors.positions[b])
    _, first, last = scored_phase(truth)
    bias, sane = (
        np.zeros(len(data)),
        (np.abs(error) <= LARGEST_ERROR) & (data.t >= first) & (data.t <= last),
    )
    pair = a * len(anchors) + b
    for one in np.unique(pair):
        rows = np.flatnonzero(pair == one)
        good = rows[sane[rows]]
        starts, ends = (
            np.searchsorted(data.t[good], data.t[rows] + half)
            for half in (-0.5 * window, 0.5 * window)
        )
        bias[rows] = [np.median(error[good[i:k]]) if k > i else 0.0 for i, k in zip(starts, ends)]
    table = {key: value for key, value in zip(zip(data.t, data.a, data.b, data.d), bias)}

    def correct(t, a, b, d):
        keys = zip(t, anchors.ids[a], anchors.ids[b], d)
        told = np.array([table[key] for key in keys]) if len(t) else np.zeros(0)
        return Correction.flat(d, told, np.zeros(len(t)), np.full(len(t), NETWORK, dtype=np.uint8))

    def nothing(*pose):
        return None

    return SimpleNamespace(
        idle=False,
        uses_pose=False,
        lag=np.inf,
        effects=EffectSet(),
        left_to_filter=EffectSet(),
        correct=correct,
        add_pose=nothing,
        reset=nothing,
    )


def repeatability(one, other):
    """Correlation of the errors of two flights at the same place: (correlation, cells compared).

    It compares the medians per pair of anchors and cell of 0.3 m that both flew through.
    one, other : Labels
    """
    maps = []
    for labels in (one, other):
        s = labels.samples
        cell = np.floor(s.p / CELL).astype(int)
        keys = np.column_stack([s.anchors.ids[s.a], s.anchors.ids[s.b], cell])
        kinds, which = np.unique(keys, axis=0, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        parts = np.split(labels.error[order], np.cumsum(np.bincount(which.ravel()))[:-1])
        maps.append(
            {
                tuple(kind): np.median(part)
                for kind, part in zip(kinds.tolist(), parts)
                if len(part) >= 5
            }
        )
    shared = sorted(set(maps[0]) & set(maps[1]))
    if len(shared) < 20:
        return float("nan"), len(shared)
    return float(np.corrcoef(*([each[key] for key in shared] for each in maps))[0, 1]), len(shared)
