"""Have the signs of all TDOAs turned in flight? For tenths of a second the filter still is where the tag is."""

from __future__ import annotations

import numpy as np

LARGE = 0.75  # m, by which a TDOA changes with its sign, below which it shows nothing
GAIN = 0.35  # share of that change that may be left with the other sign
SHARE = 0.5  # of the TDOAs that show something, which the other sign must explain
FEWEST = 10  # TDOAs that show something


def turned(innovation: np.ndarray, predicted: np.ndarray) -> bool:
    """Return whether the other sign explains the innovations (n,), m; predicted : (n,) m, at the place of the filter.

    All TDOAs that are far from zero are asked, those that the filter explains, too. Where a few anchors are late, as near a floor, most
    TDOAs contradict a turn.
    """
    change = np.abs(2.0 * predicted)
    asked = change > LARGE
    if np.count_nonzero(asked) < FEWEST:
        return False
    left = np.abs(2.0 * predicted[asked] + innovation[asked])  # -d - predicted, of a measured d
    return bool(np.mean(left < GAIN * change[asked]) > SHARE)
