# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Plan an installation: precision, failure, accuracy, and better anchor layouts.

    from uwb_tdoa_tools.planning.precision import Installation
    from uwb_tdoa_tools.planning.maps import Hall
    from uwb_tdoa_tools.planning.maps import Demand, Grid
    result = Hall(Installation(anchors), Demand()).chart(Grid.slice((-3, 3), (-4, 4), 1.2, 0.1))

After Grasso, Innocente, Tai, Haas and Dizqah, Sensors 2022, 22, 9136, in two and three dimensions.
"""
