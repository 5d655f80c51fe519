# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A first map of anchors whose positions are unknown, from flights or from distances.

`map_anchors` is the only entry point. Recordings and measured distances become an `Observations`.
`least_squares` finds the maps that explain them. `verdict` states how far the best map can be off, and
accepts it or names what is missing.
"""

from .observations import Observations, observe
from .verdict import FirstMap, map_anchors

__all__ = ["FirstMap", "Observations", "map_anchors", "observe"]
