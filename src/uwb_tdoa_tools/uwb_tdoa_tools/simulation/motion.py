"""How a vehicle moves, exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class ExactMotion:
    """Exact motion at n instants, body frame x forward, y left, z up in a z-up world.

    p, v, a : (n, 3) m, m/s, m/s^2, world; q : (n, 4) x y z w, body to world; body_rates : (n, 3)
        rad/s, body;
    specific_force : (n, 3) m/s^2, body.
    """

    p: np.ndarray
    v: np.ndarray
    a: np.ndarray
    q: np.ndarray
    body_rates: np.ndarray
    specific_force: np.ndarray


class Flyable(Protocol):
    """What `simulate` moves."""

    def motion(self, t: np.ndarray) -> ExactMotion:
        """The ExactMotion at stamps t, (n,) s."""

    def motors(self, t: np.ndarray) -> np.ndarray:
        """Whether the motors turn at stamps t: (n,) bool."""
