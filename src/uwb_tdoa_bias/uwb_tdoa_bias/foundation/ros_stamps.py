"""Stamps and attitudes of messages as numbers, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from builtin_interfaces.msg import Time
import numpy as np

if TYPE_CHECKING:
    from geometry_msgs.msg import Quaternion


class Epoch:
    """Stamps as float seconds, exact to the nanosecond: counted from the whole second of the first
    stamp.

    Seconds since 1970 in a float64 are only good to 2e-7 s. Exact for 48 days before and after the
    first stamp.
    """

    def __init__(self) -> None:
        self._second: int = None  # type: ignore[assignment]  # of the first stamp, once there is one

    def seconds(self, stamp: Time) -> float:
        """Float s of a builtin_interfaces/Time."""
        if self._second is None:
            self._second = stamp.sec
        return (stamp.sec - self._second) + 1e-9 * stamp.nanosec

    def seconds_of(self, sec: np.ndarray, nanosec: np.ndarray) -> np.ndarray:
        """Float s, (n,), of the two parts of stamps, (n,) each."""
        if self._second is None:
            self._second = int(sec[0])
        return (sec.astype(np.int64) - self._second) + 1e-9 * nanosec

    def parts(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What `seconds_of` was given, to the nanosecond, of t (n,) s."""
        second, nanosecond = np.divmod(np.round(t * 1e9).astype(np.int64), 10**9)
        return self._second + second, nanosecond

    @property
    def begin(self) -> int:
        """Stamp, s, of what `seconds` gives as 0."""
        return self._second or 0

    def stamp(self, t: float) -> Time:
        """builtin_interfaces/Time of float s: what `seconds` was given, to the nanosecond."""
        second, nanosecond = divmod(round(t * 1e9), 10**9)
        return Time(sec=self._second + second, nanosec=nanosecond)


def orientation_of(q: Quaternion) -> tuple[float, float, float, float]:
    """Tuple x y z w of a geometry_msgs/Quaternion; NaN for (0, 0, 0, 0), which says: not known."""
    values = (q.x, q.y, q.z, q.w)
    return values if any(values) else (np.nan, np.nan, np.nan, np.nan)
