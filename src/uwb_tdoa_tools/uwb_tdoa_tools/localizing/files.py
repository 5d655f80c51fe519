"""A trajectory in files: TUM, CSV, a bag."""

from pathlib import Path

import numpy as np

from uwb_tdoa_bias.foundation.files import write_filled
from uwb_tdoa_ekf.frames import rotation_std
from uwb_tdoa_ekf.results import Odometry

COLUMNS = (
    "t",
    "x",
    "y",
    "z",
    "qx",
    "qy",
    "qz",
    "qw",
    "vx",
    "vy",
    "vz",
    "std_x",
    "std_y",
    "std_z",
    "std_vx",
    "std_vy",
    "std_vz",
    "std_yaw",
)


def write_csv(path: Path, odometry: Odometry) -> None:
    """Write an Odometry as CSV, a line for each estimate: s, m, quaternion from body to world, m/s,
    and standard deviations, m, m/s and rad, all in the world frame.
    """
    std = np.sqrt(np.einsum("nii->ni", odometry.covariance))
    yaw = rotation_std(odometry.q, odometry.covariance)[:, 2]
    rows = np.column_stack([odometry.t, odometry.p, odometry.q, odometry.v, std[:, :6], yaw])
    kinds = ["%.9f"] + ["%.6f"] * (len(COLUMNS) - 1)
    write_filled(
        path,
        lambda file: np.savetxt(
            file, rows, fmt=kinds, delimiter=",", header=",".join(COLUMNS), comments=""
        ),
    )
