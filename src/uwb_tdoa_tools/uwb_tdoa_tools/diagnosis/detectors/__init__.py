# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Searches for effects that linear regression does not find, by family of effects."""

from .anchor import NlosDetector, switching
from .auxiliary import FloorStepDetector, VelocitySlipDetector
from .base import Detection, Detector
from .floor import FloorMultipathDetector
from .pair import NoiseCorrelationDetector, NoiseLevelDetector, OutlierRateDetector

DETECTORS = {
    detector.effect.name: detector
    for detector in (
        NlosDetector(),
        OutlierRateDetector(),
        NoiseLevelDetector(),
        NoiseCorrelationDetector(),
        FloorMultipathDetector(),
        FloorStepDetector(),
        VelocitySlipDetector(),
    )
}

__all__ = ["DETECTORS", "Detection", "Detector", "switching"]
