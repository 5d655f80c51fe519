"""Have the signs of all TDOAs turned in flight? For tenths of a second the filter still is where the tag is."""

from __future__ import annotations

import numpy as np

LARGE = 0.75  # m, an innovation that shows something
GAIN = 0.35  # share of it that is left with the other sign
SHARE = 0.65  # of the large innovations, that must become so small; after a turn 0.68 to 0.99 in simulated flights
FEWEST = 10  # large innovations


def turned(innovation: np.ndarray, predicted: np.ndarray) -> bool:
    """Return whether the other sign explains what is large of the innovations (n,), m; predicted : (n,) m, at the place of the filter."""
    large = np.abs(innovation) > LARGE
    if np.count_nonzero(large) < FEWEST:
        return False
    left = np.abs(2.0 * predicted[large] + innovation[large])  # -d - predicted, of a measured d
    return bool(np.mean(left < GAIN * np.abs(innovation[large])) > SHARE)
