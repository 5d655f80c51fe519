# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The paths that networks are trained on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_tools.flying.mission import CLIMB, KNOT, SETTLE, ReferenceTrajectory, cruise, smooth
from uwb_tdoa_tools.simulation.config import SimulationConfig
from uwb_tdoa_tools.simulation.paths import sines
from uwb_tdoa_tools.simulation.rooms import Room

AWAY = 6.0  # s, from the middle to the sines and back


@dataclass(frozen=True)
class Sines:
    """A path up, through a whole room in products of sines, back, and down.

    The sines are the same as in `simulate` and in the training flights of Zhao et al. 2021.
    room : Room
    seed : of the sines
    height, rise, fall : as in Circles
    seconds : in the air
    speed : m/s, root mean square
    turning : rad/s, constant
    """

    room: Room
    seed: int
    height: float = 1.2
    rise: float = 3.0
    fall: float = 4.0
    seconds: float = 60.0
    speed: float = 0.7
    turning: float = 0.3
    radius = 0.0  # m: it begins in the middle

    @property
    def duration(self) -> float:
        """As of Circles."""
        return self.rise + self.seconds + self.fall

    def starting_at(self, place: np.ndarray, ground: float) -> ReferenceTrajectory:
        """The ReferenceTrajectory, as of Circles."""
        knots = np.arange(0.0, self.duration + KNOT, KNOT)
        up = cruise(knots / self.rise, CLIMB)
        down = cruise((knots - self.duration + self.fall) / self.fall, CLIMB)
        p = np.empty((len(knots), 3))
        p[:, :2], p[:, 2] = place, ground + self.height * up - (self.height - SETTLE) * down
        away = smooth((knots - self.rise) / AWAY) * smooth(
            (self.duration - self.fall - knots) / AWAY
        )
        there = sines(
            knots, SimulationConfig(speed=self.speed), self.room, np.random.default_rng(self.seed)
        )
        return ReferenceTrajectory(p + away[:, None] * (there - p), self.turning)
