"""Have the signs of all TDOAs turned in flight?

For tenths of a second the filter still is where the tag is.
"""

from __future__ import annotations

import numpy as np

LARGE = 0.75  # m, by which a TDOA changes with its sign, below which it shows nothing
GAIN = 0.35  # share of that change that may be left with the other sign
# Shares of the TDOAs that show something: those that the other sign must explain, and those that
# the present one may explain. After a
# turn these were 0.66 to 1.0 and 0.0 in simulated flights; near a floor, where anchors are metres
# late, 0.67 and 0.3
SHARE, PRESENT = 0.6, 0.1
FEWEST = 10  # TDOAs that show something


def turned(innovation: np.ndarray, predicted: np.ndarray) -> bool:
    """Return whether the other sign explains the innovations (n,), m; predicted : (n,) m, at the
    place of the filter.

    All TDOAs that are far from zero are asked, those that the filter explains, too. Where a few
    anchors are late, as near a floor, most TDOAs contradict a turn.
    """
    change = np.abs(2.0 * predicted)
    asked = change > LARGE
    if np.count_nonzero(asked) < FEWEST:
        return False
    small = GAIN * change[asked]
    left = np.abs(2.0 * predicted[asked] + innovation[asked])  # -d - predicted, of a measured d
    return bool(
        np.mean(left < small) > SHARE and np.mean(np.abs(innovation[asked]) < small) < PRESENT
    )
