"""What the Monitor finds in a recording: the same that ekf_node does, with times."""

from __future__ import annotations

from itertools import pairwise
import math
from typing import TYPE_CHECKING

import numpy as np

from ..results import rows_of
from .monitor import GAP, Event, Monitor

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
    """Return the Events of the Odometry and the Residuals of a recording.

    calibrated : as of a Monitor; restarts : s, stamps at which the filter starts anew.
    """
    events: list[Event] = []
    for low, high in pairwise([-math.inf, *restarts, math.inf]):
        monitor, t = (
            Monitor(anchors, calibrated),
            np.sort(residuals.t[(residuals.t >= low) & (residuals.t < high)]),
        )
        for begin, end in pairwise([low, *t[1:][np.diff(t) > GAP].tolist(), high]):
            heard = rows_of(residuals, _between(residuals.t, begin, end))
            monitor.add(rows_of(odometry, _between(odometry.t, begin, end)), heard)
            monitor.update(float(heard.t[-1]) if len(heard) else low)
        events += monitor.history
    return events


def _between(t: np.ndarray, low: float, high: float) -> np.ndarray:
    """Places of the stamps t (n,) s from one on and before another, in order."""
    order = np.argsort(t, kind="stable")
    return np.asarray(order[(t[order] >= low) & (t[order] < high)])
