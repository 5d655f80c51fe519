"""What a flight is compared with, and how well each coordinate of it is known.

One kind of reference, one file.
"""

from .base import Reference, ReferenceView
from .ground_truth import GroundTruth
from .heights import Heights
from .marks import Marks
from .nothing import Nothing
from .odometry import OdometryReference
from .path import OdometryPath

# Made of a FilterConfig and constraints
REFERENCES = {
    "truth": GroundTruth,
    "heights": Heights,
    "marks": Marks,
    "odometry": OdometryReference,
    "nothing": Nothing,
}

__all__ = [
    "REFERENCES",
    "GroundTruth",
    "Heights",
    "Marks",
    "Nothing",
    "OdometryReference",
    "OdometryPath",
    "Reference",
    "ReferenceView",
]
