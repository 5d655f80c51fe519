"""What is known beside TDOAs and IMU, for a calibration without ground truth. One kind, one file.

Of flights (`flight` is the name of one): `stamps(begin)`, s, ascending, at which it asks where the
tag was, and `equations(t, estimate, covariance, moved)`. Of the anchors themselves (`flight` is
None): `equations(anchors, columns)`. Each gives (gram (k, k), vector (k,)) of normal equations of
what the anchors' coordinates, anchor by anchor, the delays, and further parameters are off by.
"""

from .distance import Distance
from .mark import Mark

Constraint = Distance | Mark

__all__ = ["Constraint", "Distance", "Mark"]
