"""From the filter's conventions to those of nav_msgs/Odometry (REP-105, and the comments of its definition).

The filter: position and velocity in the world, attitude error in the body frame. Odometry: pose in the parent (world)
frame with rotations about its fixed axes, twist in the child (body) frame.
"""

import numpy as np
from scipy.spatial.transform import Rotation


def pose_covariance(q, covariance):
    """Covariance of position and rotation about the fixed axes X, Y, Z of the world.

    q : (n, 4) x y z w, body to world; covariance : (n, 9, 9) of [p, v, attitude], the attitude's in the body frame.
    Returns (n, 6, 6), m and rad. A rotation dtheta in the body frame is R(q) dtheta in the world.
    """
    jacobian = np.zeros((len(q), 6, 9))
    jacobian[:, :3, :3] = np.eye(3)
    jacobian[:, 3:, 6:] = Rotation.from_quat(q).as_matrix()
    return jacobian @ covariance @ jacobian.transpose(0, 2, 1)


def body_velocity(q, v, covariance):
    """Velocity in the body frame, (n, 3) m/s, and its covariance, (n, 3, 3).

    q, covariance : as in pose_covariance; v : (n, 3) m/s, world. With an error dv the velocity R(q)' v changes by
    R' dv, with an error of the attitude by (R' v) x dtheta.
    """
    to_body = Rotation.from_quat(q).as_matrix().transpose(0, 2, 1)
    u = np.einsum("nij,nj->ni", to_body, v)
    jacobian = np.zeros((len(q), 3, 9))
    jacobian[:, :, 3:6] = to_body
    jacobian[:, [0, 0, 1, 1, 2, 2], [7, 8, 6, 8, 6, 7]] = u[:, [2, 1, 2, 0, 1, 0]] * (-1, 1, 1, -1, -1, 1)  # [u]x
    return u, jacobian @ covariance @ jacobian.transpose(0, 2, 1)
