"""From the filter's conventions to those of nav_msgs/Odometry (REP-105, and the comments of its definition).

The filter: position and velocity in the world, attitude error in the body frame. Odometry: pose in the parent (world)
frame with rotations about its fixed axes, twist in the child (body) frame.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.compiled import compiled

from .core.state import rotation


def to_odometry(q, v, covariance):
    """Velocity in the body frame, and the covariance of what an Odometry holds.

    q : (n, 4) x y z w, body to world; v : (n, 3) m/s, world; covariance : (n, 9, 9) of [p, v, attitude], the attitude
    in the body frame. Returns u = R(q)' v, (n, 3) m/s, and (n, 9, 9) of [position, rotation about the world's axes,
    u]. An attitude error dtheta is R dtheta in the world; with an error dv, u changes by R' dv + u x dtheta.
    """
    to_world = Rotation.from_quat(q).as_matrix()
    to_body = to_world.transpose(0, 2, 1)
    u = (to_body @ v[:, :, None])[:, :, 0]
    jacobian = np.zeros((len(q), 9, 9))
    jacobian[:, [0, 1, 2], [0, 1, 2]] = 1.0
    jacobian[:, 3:6, 6:] = to_world
    jacobian[:, 6:, 3:6] = to_body
    jacobian[:, [6, 6, 7, 7, 8, 8], [7, 8, 6, 8, 6, 7]] = u[:, [2, 1, 2, 0, 1, 0]] * (-1, 1, 1, -1, -1, 1)  # [u]x
    return u, jacobian @ covariance @ jacobian.transpose(0, 2, 1)


def rotation_std(q, covariance):
    """Standard deviations of the rotation about the world's axes, (n, 3) rad: those of to_odometry. Arguments as there,
    without v."""
    out = np.empty((len(q), 3))
    _rotation_std(np.ascontiguousarray(q), np.ascontiguousarray(covariance), out)
    return out


@compiled
def _rotation_std(q, covariance, out):
    R = np.empty((3, 3))
    for n in range(len(q)):
        rotation(q[n, 0], q[n, 1], q[n, 2], q[n, 3], R)
        for axis in range(3):
            variance = 0.0
            for i in range(3):
                for j in range(3):
                    variance += R[axis, i] * covariance[n, 6 + i, 6 + j] * R[axis, j]
            out[n, axis] = math.sqrt(variance)
