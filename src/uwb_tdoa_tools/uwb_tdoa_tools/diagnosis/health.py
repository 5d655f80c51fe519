"""Health of every channel, and of the filter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.sensors import LOCATING
from uwb_tdoa_ekf.results import VERDICTS

from .channels import CHANNELS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_ekf.offline import Run

    from ..scoring.metrics import Score
    from .channels import ChannelResiduals
    from .channels.base import Figures

KEYS = ("pairs", "anchors", "axes", "cross_correlation")  # of what channels tell
REACHED = [value for value, name in VERDICTS.items() if name in ("used", "rejected")]


def health(
    residuals: Sequence[ChannelResiduals], runs: Sequence[Run] = (), scores: Sequence[Score] = ()
) -> Figures:
    """What [{channel: ChannelResidual}] look like: {"pairs", "anchors", "axes",
    "cross_correlation", "filter"}, each a list of dicts. runs, scores : Run and Score of each
    flight, for NIS (1 is honest) and NEES (3 is honest).
    """
    out: Figures = {key: [] for key in KEYS}
    for name, channel in CHANNELS.items():
        parts = [flight[name] for flight in residuals if name in flight]
        for key, items in channel.health(parts).items() if parts else ():
            out[key] += items
    return {**out, "filter": [_filter(run, score) for run, score in zip(runs, scores)]}


def _filter(run: Run, score: Score) -> dict[str, Any]:
    of_tdoas = run.residuals.verdict, run.residuals.innovation, run.residuals.variance
    of_aids = [
        [run.aids[name][field] for field in ("verdict", "innovation", "variance")]
        for name in LOCATING
        if name in run.aids
    ]
    verdict, innovation, variance = map(np.concatenate, zip(of_tdoas, *of_aids))
    reached = np.isin(verdict, REACHED)
    nis = innovation[reached] ** 2 / variance[reached]
    return {
        "flight": score.name,
        "nis_mean": float(nis.mean()),
        "nis_below_3.84": float(np.mean(nis < 3.84)),  # 95 % of an honest one
        "nees_mean": float(np.mean(score.nees)),
        "nees_below_7.81": float(np.mean(score.nees < 7.81)),
    }
