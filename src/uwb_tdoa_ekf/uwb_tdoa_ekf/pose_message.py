"""A pose that somebody gives, as RViz does, in the terms of the filter."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseWithCovarianceStamped

    from uwb_tdoa_bias.ros.topics import Epoch

LARGEST = 1e16  # the square of what is far for an anchor, m^2


def pose_from_message(
    message: PoseWithCovarianceStamped, world: str, epoch: Epoch, newest: float
) -> tuple[float, np.ndarray, np.ndarray, float, float]:
    """(t s, p (3,) m, covariance (3, 3) m^2, yaw rad, its standard deviation rad) of a
    PoseWithCovarianceStamped.

    world : name of the world frame; epoch : Epoch; newest : s, stamp of the newest measurement,
        which a pose without
    stamp has. A coordinate, or the yaw, whose variance is 0 is not given, and NaN. Raises
    InputError.
    """
    frame = message.header.frame_id
    if frame not in ("", world):
        raise InputError(
            f"its frame is '{frame}', and the filter's is '{world}'; give it in that (RViz: "
            "Fixed Frame)."
        )
    stamp, p, q = message.header.stamp, message.pose.pose.position, message.pose.pose.orientation
    covariance = np.reshape(message.pose.covariance, (6, 6))
    variances = np.diag(covariance)
    numbers = [p.x, p.y, p.z, q.x, q.y, q.z, q.w, *covariance.ravel()]
    if not (np.abs(numbers) <= LARGEST).all() or (variances < 0.0).any():
        raise InputError(
            f"it holds numbers that are not finite or above {LARGEST:g}, or negative "
            "variances; give others."
        )
    if np.linalg.eigvalsh(0.5 * (covariance + covariance.T)[:3, :3]).min() < -1e-9:
        raise InputError(
            "its covariance is none: the correlations are larger than 1; give a smaller "
            "off-diagonal."
        )
    at = np.where(variances[:3] > 0.0, [p.x, p.y, p.z], math.nan)
    t = epoch.seconds(stamp) if stamp.sec or stamp.nanosec else newest
    if not math.isfinite(t):
        raise InputError(
            "it has no stamp, and there is no measurement whose time it could have; give it a "
            "stamp."
        )
    length = math.hypot(q.x, q.y, q.z, q.w)
    if not variances[5] > 0.0 or length < 0.5:
        return t, at, covariance[:3, :3], math.nan, math.nan
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), length**2 - 2.0 * (q.y**2 + q.z**2))
    return t, at, covariance[:3, :3], yaw, math.sqrt(variances[5])
