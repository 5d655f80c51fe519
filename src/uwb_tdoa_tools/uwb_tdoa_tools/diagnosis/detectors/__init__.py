"""Searches for effects that no regression finds. One effect, one file of its name."""

from .base import Detection, Detector
from .floor_multipath import FloorMultipathDetector
from .floor_step import FloorStepDetector
from .nlos import NlosDetector
from .noise_correlation import NoiseCorrelationDetector
from .noise_level import NoiseLevelDetector
from .outlier_rate import OutlierRateDetector
from .velocity_slip import VelocitySlipDetector

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

__all__ = ["DETECTORS", "Detection", "Detector"]
