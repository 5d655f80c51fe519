# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correct estimated positions with a map of their bias.

The method follows Grasso et al., *Analysis and Accuracy Improvement of UWB-TDoA-Based Indoor
Positioning System* (Sensors 2022, 22, 9136)::

    from uwb_tdoa_ekf.debias import BiasMap, Part, fit
    bias_map = fit([Part(odometry.p, truth_p, odometry.covariance[:, :3, :3])], step=0.35)
    bias_map.save("map.npz")
    p, covariance, validity = BiasMap.load("map.npz").correct(p, covariance)
"""

from .bias_map import BiasMap
from .fit import Part, fit

__all__ = ["BiasMap", "Part", "fit"]
