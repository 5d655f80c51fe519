"""Self-calibration: positions and delays of anchors from flights of which nobody knows the path.

One entrance, `self_calibrate`, whoever asks: `survey`, `calibrate`, and `diagnose` where no
reference tells errors.
"""

from .solve import SelfCalibration, self_calibrate
from .tape import Tape

__all__ = ["SelfCalibration", "Tape", "self_calibrate"]
