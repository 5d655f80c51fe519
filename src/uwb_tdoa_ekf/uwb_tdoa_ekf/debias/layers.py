"""The filter layers of Grasso et al. (Sensors 2022, 22, 9136), appendix C, which come before the
debiasing.

They found no gain in precision from them, nor do we (docs/debiasing.md); they are here for whoever
wants to look further.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

_ADAMS_MOULTON = np.array([251.0, 646.0, -264.0, 106.0, -19.0]) / 720.0  # newest first, eq. A27


@dataclass(frozen=True)
class LayerConfig:
    """Which layers, in the paper's order; all are off by default.

    saturate : limit steps of velocity and position (A19 - A25); max_speed : (3,) m/s along x, y, z;
        max_acceleration :
        m/s^2
    smooth : share q of the newest position in the weighted mean of the last `history` + 1 (A26); 1
        for no smoothing
    adams_moulton : mix in what the velocities predict (A27 - A29); flipping_speed : (3,) m/s at
        which they begin to
        count; least_weight : alpha_min, that of the estimate itself at high speed
    """

    saturate: bool = False
    max_speed: tuple = (3.0, 3.0, 3.0)
    max_acceleration: float = 10.0
    smooth: float = 1.0
    history: int = 4
    adams_moulton: bool = False
    flipping_speed: tuple = (1.0, 1.0, 1.0)
    least_weight: float = 0.5

    def __post_init__(self) -> None:
        for name in ("max_speed", "flipping_speed"):
            value = getattr(self, name)
            if np.shape(value) != (3,) or not all(0.0 < speed < np.inf for speed in value):
                raise InputError(
                    f"{name}: {value!r} must be three numbers of m/s above 0, along x, y and z."
                )
        if not 0.0 < self.max_acceleration < np.inf:
            raise InputError(
                f"max_acceleration: {self.max_acceleration!r} must be a number of m/s^2 above 0."
            )
        for name, low in (("smooth", 1e-6), ("least_weight", 0.0)):
            if not low <= getattr(self, name) <= 1.0:
                raise InputError(
                    f"{name}: {getattr(self, name)!r} must be a share from {low:g} to 1."
                )
        if not 1 <= self.history <= 1000:
            raise InputError(f"history: {self.history!r} must be a whole number from 1 to 1000.")


class Layers:
    """Takes one estimate after the other; remembers what the formulas need."""

    def __init__(self, config: LayerConfig) -> None:
        self._config = config
        self.reset()

    @property
    def idle(self) -> bool:
        """Whether positions pass unchanged."""
        return not (
            self._config.saturate or self._config.smooth < 1.0 or self._config.adams_moulton
        )

    def reset(self) -> None:
        """Forget the past: after a gap, or when time has gone back."""
        self._t: float | None = None
        self._p: deque[np.ndarray] = deque(maxlen=self._config.history + 1)  # newest first
        self._v: deque[np.ndarray] = deque(maxlen=len(_ADAMS_MOULTON))

    def filter(self, t: float, p: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Position (3,) m of the estimate at stamp t, s, with position p (3,) m and velocity v (3,)
        m/s, world frame.
        """
        config = self._config
        dt = 0.0 if self._t is None else t - self._t
        if config.saturate and dt > 0.0:
            p, v = _saturated(p, v, self._p[0], self._v[0], dt, config)
        before = self._p[0] if self._p else p
        self._t = t
        self._p.appendleft(p)
        self._v.appendleft(v)
        out = _smoothed(np.array(self._p), config.smooth) if config.smooth < 1.0 else p
        if config.adams_moulton and len(self._v) == len(_ADAMS_MOULTON):
            predicted = before + dt * (_ADAMS_MOULTON @ np.array(self._v))  # A27
            # A29: the formula has an acceleration; the text, which makes sense, and the caption of
            # figure A5 the speed.
            slow = np.exp(-0.5 * (v / np.array(config.flipping_speed)) ** 2)
            weight = slow * (1.0 - config.least_weight) + config.least_weight
            out = weight * out + (1.0 - weight) * predicted  # A28
        return out


def _saturated(
    p: np.ndarray,
    v: np.ndarray,
    last_p: np.ndarray,
    last_v: np.ndarray,
    dt: float,
    config: LayerConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity whose steps are possible (A19 - A25). The paper limits a velocity from
    above; here also from below.
    """
    limit = np.array(config.max_speed)
    change = v - last_v
    v = np.clip(
        last_v + _scale(dt * config.max_acceleration, change) * change, -limit, limit
    )  # A21, A22
    step = p - last_p
    return last_p + _scale(dt * limit, step) * step, v  # A24, A25


def _scale(limit: float | np.ndarray, vector: np.ndarray) -> float | np.ndarray:
    """min(limit / |vector|, 1), which is 1 for no vector at all."""
    length = np.linalg.norm(vector)
    return np.minimum(limit / length, 1.0) if length > 0.0 else 1.0


def _smoothed(history: np.ndarray, share: float) -> np.ndarray:
    """A26: weighted mean of positions (n + 1, 3), the newest first."""
    n = len(history) - 1
    weights = share * (1.0 - share) ** np.arange(n + 1)
    weights[n] = (1.0 - share) ** n
    return weights @ history
