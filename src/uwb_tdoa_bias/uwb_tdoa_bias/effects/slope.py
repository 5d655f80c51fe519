"""How the bias of TDOAs changes with the state of the filter: what an update must know where the
bias changes within the estimate's error.

Statistical linearisation: the straight line between the ends of a symmetric step, and the variance
of what the line leaves, with a step as long as the filter may be off (Sarkka, Bayesian Filtering
and Smoothing, 2013, section 5.3, with the central differences of the divided-difference filter,
Norgaard, Poulsen and Ravn, Automatica 2000).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .fading import faded
from .motion import Motion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .base import Effect
    from .samples import Samples

REACH = 0.3  # m and m/s to either side
N_STATES = 6  # position and velocity of the tag, world axes


def slope_of(
    effects: Iterable[Effect], samples: Samples
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(bias (n,) m, slope (n, 6), m per m of position and per m/s of velocity, deviation from it
    (n,) m) of the sum of those Effects that have `states`, at Samples; 0 where it is not known.
    """
    groups: dict[tuple[int, ...], list[Effect]] = {}
    n = len(samples)
    bias, slope, power = np.zeros(n), np.zeros((n, N_STATES)), np.zeros(n)
    for effect in effects:
        if effect.states:
            groups.setdefault(effect.states, []).append(effect)
    for states, group in groups.items():
        moved = _moved(samples, states)
        here, *sides = sum(
            (_known(faded(effect, moved)[0]) for effect in group), np.zeros(len(moved))
        ).reshape(-1, n)
        bias += here
        for k, (down, up) in zip(states, zip(sides[::2], sides[1::2])):
            slope[:, k] += (up - down) / (2.0 * REACH)
            power += 2.0 * (0.5 * (up + down) - here) ** 2
    return bias, slope, np.sqrt(power)


def _known(bias: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(bias), bias, 0.0)


def state_of(samples: Samples) -> np.ndarray:
    """Position and velocity that Samples are at: (n, 6) m, m/s; 0 for what is not known."""
    velocity = np.zeros_like(samples.p) if samples.motion is None else samples.motion.velocity
    return np.nan_to_num(np.hstack([samples.p, velocity]))


def _moved(samples: Samples, states: tuple[int, ...]) -> Samples:
    """The Samples, and all of them with each of some states less and more by REACH, one after the
    other.
    """
    n, out = len(samples), samples.repeated(1 + 2 * len(states))
    position = out.p.copy()
    velocity = np.zeros_like(position) if out.motion is None else out.motion.velocity.copy()
    for number, state in enumerate(states):
        of = position if state < 3 else velocity
        for side, step in enumerate((-REACH, REACH)):
            first = (1 + 2 * number + side) * n
            of[first : first + n, state % 3] += step
    if out.motion is None:
        return replace(out, p=position)
    return replace(
        out, p=position, motion=Motion(velocity, out.motion.acceleration, out.motion.rate)
    )
