"""Searches for effects that no regression finds. One effect, one file of its name."""

from .base import Detection, Detector
from .floor_multipath import FloorMultipathDetector
from .nlos import NlosDetector
from .noise_correlation import NoiseCorrelationDetector
from .noise_level import NoiseLevelDetector
from .outlier_rate import OutlierRateDetector

DETECTORS = {
    detector.effect.name: detector
    for detector in (
        NlosDetector(), OutlierRateDetector(), NoiseLevelDetector(), NoiseCorrelationDetector(),
        FloorMultipathDetector(),
    )
}  # fmt: skip

__all__ = ["DETECTORS", "Detection", "Detector"]
