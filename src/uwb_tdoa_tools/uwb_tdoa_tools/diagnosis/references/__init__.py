"""What a flight is compared with, and how well each coordinate of it is known. One kind of reference, one file."""

from .base import Reference, View
from .ground_truth import GroundTruth
from .nothing import Nothing

__all__ = ["GroundTruth", "Nothing", "Reference", "View"]
