# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find missing systematic effects in residuals.

from uwb_tdoa_tools.diagnosis import diagnose
diagnosis = diagnose(flights, holdout)

The result has findings, effects, and validation figures before and after.

The package has five concepts, each with a folder or module and a small interface. A *reference* is
the path that a flight is compared with. A *constraint* is knowledge besides TDOAs for a calibration
without ground truth. A *channel* is one kind of measurement, with its residual. An *effect*
(uwb_tdoa_bias.effects) is a systematic error of channels. A *detector* searches for an effect that
no regression finds. The other modules use these interfaces only.
"""

from .diagnose import diagnose, with_noise
from .result import Diagnosis

__all__ = ["Diagnosis", "diagnose", "with_noise"]
