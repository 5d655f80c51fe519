# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the Monitor on a recording, with the results of ekf_node and their times."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
import math

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects.effect_set import Covariance

from ..core.initialization import LOST_TIME
from ..results import Odometry, Residuals, rows_of
from .monitor import Event, Monitor, Part


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
    odometry, residuals = _sorted(odometry), _sorted(residuals)
    events: list[Event] = []
    for low, high in pairwise([-math.inf, *restarts, math.inf]):
        monitor, t = Monitor(anchors, calibrated), _between(residuals, low, high).t
        for begin, end in pairwise([low, *t[1:][np.diff(t) > LOST_TIME].tolist(), high]):
            heard = _between(residuals, begin, end)
            monitor.add(_between(odometry, begin, end), heard)
            monitor.update(float(heard.t[-1]) if len(heard) else low)
        events += monitor.history
    return events


def _sorted(part: Part) -> Part:
    """Return Odometry or Residuals in the order of their stamps."""
    return rows_of(part, np.argsort(part.t, kind="stable"))


def _between(part: Part, low: float, high: float) -> Part:
    """Return the rows of sorted Odometry or Residuals with stamps from `low` to `high`, in s."""
    return rows_of(part, slice(*np.searchsorted(part.t, [low, high])))
