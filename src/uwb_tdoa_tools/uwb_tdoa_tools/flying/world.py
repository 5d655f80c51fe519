"""What the vehicle flies in: radio, inertial sensor and air, each as wrong as asked for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

from ..simulation.config import ImuErrors
from ..simulation.inject import parse_effect
from ..simulation.rooms import corners

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

MOMENTS = (
    "rest",
    "lift-off",
    "circle",
    "landing",
    "anywhere",
)  # in a flight; on a circle of no radius it hovers
LONGEST_SILENCE = 60.0  # s


@dataclass(frozen=True)
class World:
    """A hall, its radio and its air. Metres, seconds and Hz where nothing else is said.

    The radio
    ---------
    size : of the hall, whose low anchors are at 0.18 m
    layout : Anchors that are there, None for a low and a high one in each corner
    low_first : of those in corners, 0 to 3 are the low ones; else low and high ones alternate, as
        in the measured flights, but for two
    floor_effect : low anchors are late while the tag is near the floor, each by one of
        `floor_delay`, up to about one of `floor_height`, as
        the effect floor_multipath has it
    protocol, rate : of TDOAs
    noise : of a TDOA, its standard deviation
    outlier_share, outlier_size : share of TDOAs that are wrong by anything up to that size; 0: of
        the three kinds of physics
    installation : seed of what belongs to the hall (delays, biases, the floor), None for that of
        the flight: another hall each time
    delay : standard deviation of the anchors' constant delays
    bearing_bias : largest amplitude of a bias over the bearing, two waves per turn
    antennas : received power and both antennas make signals late, as in `simulate`; each flight has
        another specimen of the tag
    silence : (one of MOMENTS, s) when and for how long nothing is heard; or None
    person : somebody walks through the hall and blocks what passes through him
    change : "silent" or "late", what one anchor, drawn by seed, is from the middle of the path on;
        or ""
    lateness : by how much it is late then
    effects : EffectSet, what `inject` puts into flights
    latency, jitter : of everything on its way to the estimate, least, and mean of what comes on top

    The vehicle
    -----------
    imu : ImuErrors
    vibration : (3,) m/s^2, root mean square of what turning rotors add to the accelerometer, per
        axis
    vibration_band : below which it is; 0 for white
    rectified : offset of the accelerometer while rotors turn, of its vibration
    mass : kg, least and most
    gust : m/s, standard deviation of the wind along each axis
    table : height of a table, 0.4 m around, from which it starts and on which it lands; 0 for none
    aids : of "height" (a range finder along the body's -z), "pressure", "velocity", "range"
        (distances to anchors); rates and noises as
        `simulate` has them, but for height_rate, height_noise, and height_range, beyond which the
        range finder sees nothing
    """

    size: tuple[float, float, float] = (6.4, 6.2, 3.0)
    layout: Anchors | None = None
    low_first: bool = False
    floor_effect: bool = True
    floor_delay: tuple[float, float] = (3.0, 3.9)
    floor_height: tuple[float, float] = (0.06, 0.2)
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
    changed_delay: float = 0.3
    effects: EffectSet = EffectSet()
    latency: float = 0.0
    jitter: float = 0.0
    imu: ImuErrors = field(default_factory=ImuErrors)
    vibration: tuple[float, float, float] = (0.6, 0.6, 0.6)
    vibration_band: float = 0.0
    rectified: float = 0.0
    mass: tuple[float, float] = (0.027, 0.033)
    gust: float = 0.0
    table: float = 0.0
    aids: tuple[str, ...] = ()
    height_rate: float = 20.0
    height_noise: float = 0.01
    height_range: float = 4.0

    @cached_property
    def anchors(self) -> Anchors:
        """Where they are."""
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
    "measured-vibration": replace(
        HALL, vibration=(0.4, 0.5, 0.35), vibration_band=30.0
    ),  # as on 0426
    "rectifying": replace(
        HALL, vibration=(3.4, 2.0, 0.55), vibration_band=30.0, rectified=1.0
    ),  # as on 0425
    "table": replace(HALL, table=0.75),
}


def world_of(
    name: str,
    floor_effect: bool | None = None,
    aids: Iterable[str] = (),
    silence: str | None = None,
    injected: Iterable[Sequence[str]] = (),
    installation: int | None = None,
) -> World:
    """The World `name`, with what options change: floor_effect bool or None; installation int or
    None; aids, names; silence "MOMENT:S" or None; injected [[effect, "KEY=NUMBER", ...]]. Raises
    InputError.
    """
    changed: dict[str, Any] = {"aids": tuple(dict.fromkeys(aids)), "installation": installation}
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
    """(moment, s) of "MOMENT:S"."""
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
