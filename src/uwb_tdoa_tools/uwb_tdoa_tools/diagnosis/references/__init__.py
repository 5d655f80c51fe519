"""What a flight is compared with, and how well each coordinate of it is known. One kind of reference, one file."""

from .base import Reference, View
from .ground_truth import GroundTruth
from .heights import Heights
from .nothing import Nothing

REFERENCES = {"truth": GroundTruth, "heights": Heights, "nothing": Nothing}  # made of a FilterConfig

__all__ = ["REFERENCES", "GroundTruth", "Heights", "Nothing", "Reference", "View"]
