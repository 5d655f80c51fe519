# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""LeftOut: an effect that an exported file does not hold, with its worth in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import LabelEffect, SmoothTerm
from uwb_tdoa_bias.effects.base import listed

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.effects import Effect

G = 9.81  # m/s^2
# Metres per unit of a parameter, and under which condition. Inertial errors grow with the time t
# that the filter has no TDOA: a force by t^2 / 2, a tilt by g t^2 / 2, a rate by g t^3 / 6.
PER_UNIT = {
    "m": (1.0, ""),
    "s": (1.0, "at 1 m/s"),
    "m/s": (1.0, "after 1 s"),
    "m/s^2": (0.5, "after 1 s without TDOAs"),
    "rad": (0.5 * G, "after 1 s without TDOAs"),
    "rad/s": (G / 6.0, "after 1 s without TDOAs"),
}
# Of a share or an angle what it means depends on the channel
PER_UNIT_OF_CHANNEL = {
    ("tdoa", "1"): (1.0, "for outliers of 1 m"),
    ("height", "1"): (1.0, "at 1 m"),
    ("velocity", "1"): (1.0, "after 1 s at 1 m/s"),
    ("velocity", "rad"): (1.0, "after 1 s at 1 m/s"),
    ("yaw_rate", "1"): (0.5, "after 1 s at 1 m/s and 1 rad/s"),
    ("accel", "1"): (0.5, "after 1 s without TDOAs at 1 m/s^2"),
    ("gyro", "1"): (G / 6.0, "after 1 s without TDOAs at 1 rad/s"),
}
# Parameters that say when or where an effect acts, or are in its second unit
TIMES = "time", "start", "end"
CONDITIONS = {"floor_multipath": ("x", "y", "height"), "truth_frame": ("roll", "pitch", "yaw")}
SENSOR_UNITS = {"gyro": "rad/s", "accel": "m/s^2", "velocity": "m/s", "yaw_rate": "rad/s"}


@dataclass(frozen=True)
class LeftOut:
    """An effect that is not in a file.

    label : name in reports; worth : m, size of its error; when : condition of that, or ""
    why : the reason, a clause
    """

    label: str
    worth: float
    when: str
    why: str

    def __str__(self) -> str:
        """Return a sentence."""
        condition = f" {self.when}" if self.when else ""
        return f"{self.label} is left out: {self.why}. It is worth {self.worth:.2g} m{condition}."


def left_out(effect: Effect, anchors: Anchors) -> LeftOut:
    """Return the LeftOut of an effect."""
    if isinstance(effect, LabelEffect):
        between = anchors.positions[:, None] - anchors.positions
        far = float(np.max(np.linalg.norm(between, axis=-1)))
        why = "it changes the ids or the sign of a TDOA before the correction"
        return LeftOut(effect.label, far, "at most, the distance between two anchors", why)
    unit = _unit(effect)
    per_unit, when = PER_UNIT_OF_CHANNEL.get((effect.channels[0], unit)) or PER_UNIT[unit]
    largest = max((abs(_own(effect, key)) for key in effect.values), default=0.0)
    return LeftOut(effect.label, per_unit * largest, when, _why(effect))


def _unit(effect: Effect) -> str:
    if isinstance(effect, SmoothTerm):
        return SENSOR_UNITS.get(effect.channels[0], "m")
    return effect.unit.partition(",")[0]


def _own(effect: Effect, key: str) -> float:
    """Return a value if it is in the first unit of the effect, else 0."""
    part = key.rpartition(".")[2]
    is_condition = part in CONDITIONS.get(effect.name, ()) or part in TIMES and "," in effect.unit
    return 0.0 if is_condition else effect.values[key]


def _why(effect: Effect) -> str:
    if effect.is_hypothesis:
        return "the filter weighs it, and nothing corrects it"
    if "tdoa" not in effect.channels:
        return f"it acts on {listed(effect.channels)}, not on TDOAs"
    if effect.stamp_offset("tdoa"):
        return "it changes the stamps of TDOAs before the correction"
    if isinstance(effect, SmoothTerm):
        return f"no vehicle computes {effect.covariate}"
    return effect.why_unusable
