# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Describe the world of a flight: radio, inertial sensor and air with their errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS, EffectSet

from ..choices import MOMENTS
from ..simulation.config import ImuErrors
from ..simulation.inject import parse_effect
from ..simulation.rooms import corners

# of a flight; a circle of no radius is hovering
LONGEST_SILENCE = 60.0  # s


@dataclass(frozen=True)
class World:
    """Describe a hall, its radio, its air and the sensors of the vehicle.

    Lengths are in m, times in s and rates in Hz unless stated otherwise.

    Parameters
    ----------
    size : tuple
        Size of the hall. Low anchors are at 0.18 m.
    layout : Anchors, optional
        Anchors. The default is a low and a high anchor in each corner.
    low_first : bool
        Ids 0 to 3 are the low anchors. Otherwise low and high alternate, as in the measured flights.
    floor_effect : bool
        Low anchors are late while the tag is near the floor (effect floor_multipath).
    protocol, rate
        Of the TDOAs.
    noise : float
        Standard deviation of a TDOA.
    outlier_share, outlier_size : float
        Share and largest size of wrong TDOAs. A size of 0 draws the three kinds of physics.
    installation : int, optional
        Seed of the hall: delays, biases, floor. None takes the seed of the flight.
    delay : float
        Standard deviation of the constant delays of anchors.
    bearing_bias : float
        Largest amplitude of a bias over the bearing, with two waves per turn.
    antennas : bool
        Received power and both antennas delay signals, as in `simulate`. Each flight has another tag.
    silence : tuple, optional
        (one of MOMENTS, duration) of a gap in the TDOAs.
    person : bool
        A person walks through the hall and blocks signals.
    change : str
        "silent" or "late": change of one random anchor from the middle of the path. "" for none.
    effects : EffectSet
        Further effects, added as by `inject`.
    latency, jitter : float
        Least delay of all messages, and mean of an additional delay.
    imu : ImuErrors
    vibration : tuple
        Root mean square of the accelerometer vibration per axis while rotors turn, m/s^2.
    vibration_band : float
        Largest frequency of the vibration. 0 means white noise.
    rectified : float
        Accelerometer offset while rotors turn, in units of the vibration.
    gust : float
        Standard deviation of the wind along each axis, m/s.
    table : float
        Height of a round table of 0.4 m radius at the start. 0 for none.
    sensors : tuple of str
        Further sensors, names of SENSORS, e.g. "height" (a range finder along -z of the body).
    """

    size: tuple[float, float, float] = (6.4, 6.2, 3.0)
    layout: Anchors | None = None
    low_first: bool = False
    floor_effect: bool = True
    protocol: str = "tdoa2"
    rate: float = 360.0
    noise: float = 0.08
    outlier_share: float = 0.03
    outlier_size: float = 2.5
    installation: int | None = None
    delay: float = 0.1
    bearing_bias: float = 0.12
    antennas: bool = False
    silence: tuple[str, float] | None = None
    person: bool = False
    change: str = ""
    effects: EffectSet = EffectSet()
    latency: float = 0.0
    jitter: float = 0.0
    imu: ImuErrors = field(default_factory=ImuErrors)
    vibration: tuple[float, float, float] = (0.6, 0.6, 0.6)
    vibration_band: float = 0.0
    rectified: float = 0.0
    gust: float = 0.0
    table: float = 0.0
    sensors: tuple[str, ...] = ()

    @cached_property
    def anchors(self) -> Anchors:
        """Return the anchors."""
        if self.layout is not None:
            return self.layout
        made = corners(*self.size)
        if not self.low_first:
            return made
        order = np.argsort(made.positions[:, 2], kind="stable")
        return Anchors(made.ids, made.positions[order], made.orientations[order], made.frame)


HALL = World()
WORLDS = {
    "hall": HALL,
    "no-floor-effect": replace(HALL, floor_effect=False),
    "low-first": replace(HALL, low_first=True),
    "outliers": replace(HALL, outlier_share=0.1),
    "three-kinds": replace(HALL, outlier_share=0.1, outlier_size=0.0),
    "person": replace(HALL, person=True),
    "anchor-silent": replace(HALL, change="silent"),
    "anchor-late": replace(HALL, change="late"),
    "silence-1s": replace(HALL, silence=("anywhere", 1.0)),
    "silence-3s": replace(HALL, silence=("circle", 3.0)),
    "latency": replace(HALL, latency=0.05),
    "jitter": replace(HALL, latency=0.01, jitter=0.01),
    "tdoa3": replace(HALL, protocol="tdoa3", rate=240.0),
    "gusts": replace(HALL, gust=0.5),
    # values of the flights of 0426
    "measured-vibration": replace(HALL, vibration=(0.4, 0.5, 0.35), vibration_band=30.0),
    # values of the flights of 0425
    "rectifying": replace(HALL, vibration=(3.4, 2.0, 0.55), vibration_band=30.0, rectified=1.0),
    "table": replace(HALL, table=0.75),
}


def world_of(
    name: str,
    floor_effect: bool | None = None,
    sensors: Iterable[str] = (),
    silence: str | None = None,
    injected: Iterable[Sequence[str]] = (),
    installation: int | None = None,
) -> World:
    """Return a world of WORLDS with the changes that options ask for.

    Parameters
    ----------
    name : str
    floor_effect : bool, optional
    sensors : iterable of str
    silence : str, optional
        "MOMENT:S".
    injected : iterable
        Lists of an effect and its "KEY=NUMBER" texts.
    installation : int, optional

    Raises
    ------
    InputError
        If `silence` or `injected` cannot be read.
    """
    changed: dict[str, Any] = {
        "sensors": tuple(dict.fromkeys(sensors)),
        "installation": installation,
    }
    if floor_effect is not None:
        changed["floor_effect"] = floor_effect
    if silence is not None:
        changed["silence"] = _moment(silence)
    effects = []
    for effect, *values in injected:
        if effect not in EFFECTS or not values:
            raise InputError(
                f"--inject: {effect!r} needs the name of an effect and KEY=NUMBER; inject "
                "--list shows them."
            )
        effects.append(parse_effect(effect, values))
    return replace(WORLDS[name], effects=EffectSet(tuple(effects)), **changed)


def _moment(text: str) -> tuple[str, float]:
    """Return (moment, duration in s) of "MOMENT:S"."""
    moment, _, seconds = text.partition(":")
    try:
        length = float(seconds)
    except ValueError:
        length = math.nan
    if moment not in MOMENTS or not 0.0 < length <= LONGEST_SILENCE:
        raise InputError(
            f"--silence: {text!r} is not MOMENT:S, where MOMENT is one of "
            f"{', '.join(MOMENTS)}, and S at most {LONGEST_SILENCE:g} s."
        )
    return moment, length
