# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Robust losses: they reduce the weight of large residuals.

A loss rho(e) of the normalised residual e gives iteratively re-weighted least squares. The weight
is rho'(e) / e, 1 at e = 0. Source: MacTavish and Barfoot, At all costs: a comparison of robust cost
functions for camera correspondence outliers, 2015, table I.
"""

from __future__ import annotations

import math

from .compiled import compiled

LOSSES = ("geman_mcclure", "huber", "cauchy")
GEMAN_MCCLURE, HUBER, CAUCHY = range(3)  # places in LOSSES


@compiled
def weight(loss: int, e: float, scale: float) -> float:
    """Return the weight rho'(e) / e of a residual, 0 to 1; compiled.

    Parameters
    ----------
    loss : place in LOSSES
    e : normalised residual
    scale : residual where the loss bends, unit of e
    """
    u = (e / scale) ** 2
    if loss == GEMAN_MCCLURE:
        return 1.0 / ((1.0 + u) * (1.0 + u))
    if loss == HUBER:
        return 1.0 if u <= 1.0 else 1.0 / math.sqrt(u)
    return 1.0 / (1.0 + u)


@compiled
def geman_mcclure_loss(e: float, scale: float) -> float:
    """Return 2 rho(e) / scale^2 of Geman and McClure, 0 to 1; compiled.

    e, scale : as for `weight`
    """
    u = (e / scale) ** 2
    return u / (1.0 + u)
