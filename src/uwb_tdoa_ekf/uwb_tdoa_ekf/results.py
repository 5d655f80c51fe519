# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Define the results of the filter: estimates, and the outcome of each TDOA."""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import dataclass
import math
from typing import TypeVar

import numpy as np

from .core.memory import COMPENSATED, INVALID, LATE, REJECTED, REPEATED, STARTUP, USED

VERDICTS = {
    USED: "used",
    REJECTED: "rejected",
    LATE: "late",
    INVALID: "invalid",
    STARTUP: "startup",
    COMPENSATED: "compensated",
    REPEATED: "repeated",
}
OF_ROW = "innovation", "variance", "weight", "verdict"  # fields of memory.RESIDUAL


@dataclass(frozen=True)
class Residuals:
    """Store the outcome of each TDOA.

    Attributes
    ----------
    t : (n,) array
        Stamps, in s.
    a, b : (n,) array
        Anchor ids.
    innovation : (n,) array
        Innovation, in m. NaN unless the filter used, rejected or compensated the TDOA.
    variance : (n,) array
        Variance of the innovation, in m^2, NaN where the innovation is.
    weight : (n,) array
        Robust weight, 0 to 1.
    verdict : (n,) array
        Keys of VERDICTS.
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    innovation: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    verdict: np.ndarray

    @classmethod
    def from_rows(cls, t: np.ndarray, a: np.ndarray, b: np.ndarray, rows: np.ndarray) -> Residuals:
        """Return the Residuals of TDOAs from (n,) of memory.RESIDUAL.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s.
        a, b : (n,) array
            Anchor ids.
        rows : (n,) array of memory.RESIDUAL
            Outcomes.
        """
        return cls(t, a, b, *(rows[name] for name in OF_ROW))

    @classmethod
    def refused(
        cls, t: np.ndarray, a: np.ndarray, b: np.ndarray, verdict: int | np.ndarray
    ) -> Residuals:
        """Return the Residuals of TDOAs that did not reach the filter.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s.
        a, b : (n,) array
            Anchor ids.
        verdict : int or (n,) array
            Verdict of all, or of each.
        """
        n = len(t)
        unknown = np.full(n, math.nan)
        return cls(t, a, b, unknown, unknown, np.zeros(n), np.full(n, verdict, np.uint8))

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class Odometry:
    """Store estimates of the filter.

    Attributes
    ----------
    t : (n,) array
        Stamps, in s.
    p : (n, 3) array
        Position in the world frame, in m.
    v : (n, 3) array
        Velocity in the world frame, in m/s.
    q : (n, 4) array
        Quaternions x y z w, body to world.
    accel_bias : (n, 3) array
        Accelerometer bias in the body frame, in m/s^2.
    gyro_bias : (n, 3) array
        Gyroscope bias in the body frame, in rad/s.
    covariance : (n, 9, 9) array
        Covariance of [p, v, attitude], the attitude error in the body frame, in rad.
    consider_covariance : (n, 3, 3) array
        Part of the position covariance from errors that do not average out, in m^2.
    """

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    accel_bias: np.ndarray
    gyro_bias: np.ndarray
    covariance: np.ndarray
    consider_covariance: np.ndarray

    @classmethod
    def from_rows(cls, rows: np.ndarray) -> Odometry:
        """Return the Odometry of (n,) of memory.ODOMETRY."""
        x = rows["x"]
        return cls(
            rows["t"],
            x[:, :3],
            x[:, 3:6],
            x[:, 6:10],
            x[:, 10:13],
            x[:, 13:],
            rows["covariance"],
            rows["consider_covariance"],
        )

    def __len__(self) -> int:
        return len(self.t)


# a dataclass of arrays of equal length: Odometry, Residuals, a stream of a Flight
Arrays = TypeVar("Arrays", bound=Sized)


def rows_of(part: Arrays, rows: np.ndarray | slice) -> Arrays:
    """Return selected rows of a dataclass of arrays of equal length."""
    return type(part)(*(column[rows] for column in vars(part).values()))


def concatenated(parts: Sequence[Arrays]) -> Arrays:
    """Return the concatenation of several dataclasses of arrays, at least one."""
    parts = [part for part in parts if len(part)] or parts[:1]
    return (
        parts[0]
        if len(parts) == 1
        else type(parts[0])(*map(np.concatenate, zip(*(vars(part).values() for part in parts))))
    )
