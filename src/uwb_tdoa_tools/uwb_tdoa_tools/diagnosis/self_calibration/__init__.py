# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Self-calibration: positions and delays of anchors from flights without ground truth.

`self_calibrate` is the only entry point. `survey`, `calibrate` and `diagnose` use it where the
position errors are unknown.
"""

from .prior import Tape
from .solve import SelfCalibration, self_calibrate

__all__ = ["SelfCalibration", "Tape", "self_calibrate"]
