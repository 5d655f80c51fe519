# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the Monitor on a recording, with the results of ekf_node and their times."""

from __future__ import annotations

from itertools import pairwise
import math
from typing import TYPE_CHECKING

import numpy as np

from ..core.initialization import LOST_TIME
from ..results import rows_of
from .monitor import Event, Monitor

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.effects.effect_set import Covariance

    from ..results import Odometry, Residuals


def watched(
    anchors: Anchors,
    odometry: Odometry,
    residuals: Residuals,
    calibrated: Covariance | None = None,
    restarts: Sequence[float] = (),
) -> list[Event]:
    """Return the Events of a recording.

    Parameters
    ----------
    anchors : Anchors
        Anchors in the world frame.
    odometry : Odometry
        Estimates.
    residuals : Residuals
        Outcome of each TDOA.
    calibrated : Covariance or None
        As for Monitor.
    restarts : sequence of float
        Stamps at which the filter restarts, in s.
    """
    events: list[Event] = []
    for low, high in pairwise([-math.inf, *restarts, math.inf]):
        monitor, t = (
            Monitor(anchors, calibrated),
            np.sort(residuals.t[(residuals.t >= low) & (residuals.t < high)]),
        )
        for begin, end in pairwise([low, *t[1:][np.diff(t) > LOST_TIME].tolist(), high]):
            heard = rows_of(residuals, _between(residuals.t, begin, end))
            monitor.add(rows_of(odometry, _between(odometry.t, begin, end)), heard)
            monitor.update(float(heard.t[-1]) if len(heard) else low)
        events += monitor.history
    return events


def _between(t: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the places of stamps t (n,), in s, with low <= t < high, sorted by stamp."""
    order = np.argsort(t, kind="stable")
    return np.asarray(order[(t[order] >= low) & (t[order] < high)])
