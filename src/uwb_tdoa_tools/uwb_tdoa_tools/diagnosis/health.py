# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Health figures of each channel and of the filter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .channels import CHANNELS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..scoring.metrics import Score
    from .channels import ChannelResiduals
    from .channels.base import Figures

KEYS = ("pairs", "anchors", "axes", "cross_correlation")  # figures of channels


def health(residuals: Sequence[ChannelResiduals], scores: Sequence[Score] = ()) -> Figures:
    """Return figures of residuals and of the filter, each a list of dicts.

    The keys are "pairs", "anchors", "axes", "cross_correlation" and "filter".

    residuals : [{channel: ChannelResidual}], one per flight
    scores : Score of each flight, for NIS (expected 1) and NEES (expected 3)
    """
    out: Figures = {key: [] for key in KEYS}
    for name, channel in CHANNELS.items():
        parts = [flight[name] for flight in residuals if name in flight]
        for key, items in channel.health(parts).items() if parts else ():
            out[key] += items
    return {**out, "filter": [_filter(score) for score in scores]}


def _filter(score: Score) -> dict[str, Any]:
    return {
        "flight": score.name,
        "nis_mean": float(score.nis.mean()),
        "nis_below_3.84": float(np.mean(score.nis < 3.84)),  # 95 % if the filter is consistent
        "nees_mean": float(np.mean(score.nees)),
        "nees_below_7.81": float(np.mean(score.nees < 7.81)),
    }
