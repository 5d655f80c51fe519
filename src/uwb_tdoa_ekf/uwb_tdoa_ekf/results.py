"""What the filter says: estimates, and what became of each TDOA."""

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
OF_ROW = "innovation", "variance", "weight", "verdict"  # of memory.RESIDUAL


@dataclass(frozen=True)
class Residuals:
    """What became of each TDOA. t (n,) s; a, b (n,) anchor ids; innovation (n,) m and variance (n,)
    m^2, NaN unless used, rejected or compensated by the filter; weight (n,) 0 to 1; verdict (n,) a
    key of VERDICTS.
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
        """Of TDOAs stamped t (n,) s, between anchors a and b (n,), and what became of them, (n,) of
        memory.RESIDUAL.
        """
        return cls(t, a, b, *(rows[name] for name in OF_ROW))

    @classmethod
    def refused(
        cls, t: np.ndarray, a: np.ndarray, b: np.ndarray, verdict: int | np.ndarray
    ) -> Residuals:
        """Of TDOAs that the filter did not get: t (n,) s; a, b (n,) ids; verdict : that of all, or
        (n,).
        """
        n = len(t)
        unknown = np.full(n, math.nan)
        return cls(t, a, b, unknown, unknown, np.zeros(n), np.full(n, verdict, np.uint8))

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class Odometry:
    """Estimates. t (n,) s; p (n, 3) m; v (n, 3) m/s, world; q (n, 4) x y z w, body to world;
    accel_bias (n, 3) m/s^2 and gyro_bias (n, 3) rad/s, body; covariance (n, 9, 9) of [p, v,
    attitude], the attitude's in the body frame, rad; persistent (n, 3, 3) m^2, what of the
    position's covariance errors that do not average out make.
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
        """From (n,) of memory.ODOMETRY."""
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


# a dataclass of arrays of one length: Odometry, Residuals, a stream of a Flight
Arrays = TypeVar("Arrays", bound=Sized)


def rows_of(part: Arrays, rows: np.ndarray | slice) -> Arrays:
    """Some rows of a dataclass of arrays of one length."""
    return type(part)(*(column[rows] for column in vars(part).values()))


def concatenated(parts: Sequence[Arrays]) -> Arrays:
    """One dataclass of arrays of several, at least one."""
    parts = [part for part in parts if len(part)] or parts[:1]
    return (
        parts[0]
        if len(parts) == 1
        else type(parts[0])(*map(np.concatenate, zip(*(vars(part).values() for part in parts))))
    )
