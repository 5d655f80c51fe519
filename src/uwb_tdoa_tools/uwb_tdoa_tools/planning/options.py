"""What the options of plan ask for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.antenna import Antenna
from uwb_tdoa_bias.foundation.errors import InputError

from ..simulation.rooms import Room, room_of
from .goal import Goal
from .installation import Installation
from .judging import Demand
from .maps import Grid
from .noise import FixedNoise, RadioNoise, antenna_from_yaml
from .pairing import OF_PROTOCOL, PAIRINGS
from .places import AnchorPlaces, lattice

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Sequence

    from uwb_tdoa_bias.foundation.anchors import Anchors

FARTHEST = 30.0  # m, size of a room from which on the radio's reach must be given
ACROSS = {"slice": 100, "volume": 50}  # cells along the longest side, unless --step says otherwise
SEARCHED = (
    300  # cells of the flown volume whose corners are looked at while better anchors are searched
)


@dataclass(frozen=True)
class Aim:
    """What --improve asks for. goal : Goal to search with; reported : Goal at more points, to
    report; places : AnchorPlaces;
    count : how many anchors.
    """

    goal: Goal
    reported: Goal
    places: AnchorPlaces
    count: int


def check(args: Namespace) -> None:
    """Raise InputError for options that do not go together."""
    if args.hall == (args.anchors is not None):
        raise InputError(
            "ANCHORS: give a file of the anchors that there are, or --hall where they are "
            "asked for."
        )
    if not 0.0 < args.share <= 1.0:
        raise InputError(
            f"share: {args.share:g} is none; give more than 0 and at most 1, e.g. 0.95."
        )
    if args.walls is not None and args.radio_reach is None:
        raise InputError(
            "walls: are for a hall of which a tag hears a part; give --radio-reach too."
        )
    if args.flights and args.planar:
        raise InputError("flights: are judged in three dimensions; leave out --planar.")


def installation_of(args: Namespace, anchors: Anchors) -> Installation:
    """Installation of Anchors and the options; with a reach one of a hall, whose places hear a part
    of them. Raises InputError.
    """
    noise: RadioNoise | FixedNoise
    if args.noise is not None:
        noise = FixedNoise(args.noise)
    else:
        antenna = antenna_from_yaml(args.antenna) if args.antenna else Antenna()
        noise = RadioNoise(antenna, args.tx_power, args.temperature, args.voltage)
    # of a single anchor there is none, and Installation refuses it
    pairing: Any = PAIRINGS[_pairing(args)](len(anchors)) if len(anchors) > 1 else None
    height_std = args.height_std if "height" in args.aids else np.inf
    return Installation(
        anchors,
        noise,
        pairing,
        args.link_noise,
        2 if args.planar else 3,
        height_std,
        args.hall or args.radio_reach is not None,
    )


def demand_of(args: Namespace, installation: Installation, room: Room) -> Demand:
    """Demand of the options in a Room.

    Raises InputError for what ranges do not tell, or a hall does not have.
    """
    if installation.pairing is not None and installation.pairing.one_solution:
        for name, asked in (("flyable", args.flyable == "pairings"), ("check", args.check)):
            if asked:
                raise InputError(
                    f"{name}: looks for a second solution of TDOAs, and ranges have none; "
                    "leave it out, or plan for --protocol tdoa2."
                )
    if installation.hall and args.flyable == "pairings":
        raise InputError(
            "flyable: pairings are of a room in which every anchor is heard; leave out "
            "--flyable, or --radio-reach."
        )
    return Demand(room, args.accuracy, args.flyable)


def reach_of(args: Namespace, room: Room) -> float:
    """The radio's reach, m. Raises InputError where the Room is so large that it must be given."""
    if args.radio_reach is not None:
        if not args.radio_reach > 0.0:
            raise InputError(
                f"radio reach: {args.radio_reach:g} m is none; give one above 0, e.g. 18."
            )
        return float(args.radio_reach)
    longest = (room.upper - room.lower).max()
    if longest > FARTHEST:
        raise InputError(
            f"room: is {longest:.0f} m long, and a tag does not hear all of its anchors; give "
            "what your radios reach, e.g. --radio-reach 25."
        )
    return np.inf


def room_for(args: Namespace, anchors: Anchors | None) -> Room:
    """Room that --room gives, or that the anchors stand in, None where they are asked for.

    Raises InputError.
    """
    if anchors is None:
        if args.room is None or len(args.room) != 6:
            raise InputError(
                "room: --hall needs all of it, in metres; give --room X0 X1 Y0 Y1 Z0 Z1."
            )
        return _box("room", args.room)
    room = room_of(anchors)
    if args.room is None:
        return room
    if len(args.room) not in (4, 6):
        raise InputError(
            f"room: {len(args.room)} numbers were given; give X0 X1 Y0 Y1 or X0 X1 Y0 Y1 Z0 Z1."
        )
    return _box(
        "room", args.room if len(args.room) == 6 else [*args.room, room.lower[2], room.upper[2]]
    )


def grid_of(args: Namespace, room: Room) -> Grid:
    """Grid of a slice or of the Room. Raises InputError."""
    size = room.upper - room.lower
    if args.volume and args.planar:
        raise InputError(
            "planar: with a known height there is no volume; leave out --volume, or --planar."
        )
    if args.volume:
        return Grid.box(room.lower, room.upper, args.step or size.max() / ACROSS["volume"])
    height = room.centre[2] if args.height is None else args.height
    step = args.step or size[:2].max() / ACROSS["slice"]
    return Grid.slice((room.lower[0], room.upper[0]), (room.lower[1], room.upper[1]), height, step)


def aim_of(args: Namespace, installation: Installation, demand: Demand, height: float) -> Aim:
    """Aim of --improve. height : m, of the flown slice if the tag's height is known.

    Raises InputError.
    """
    count = len(installation.anchors) if args.count is None else args.count
    for name, value, least in (
        ("count", count, installation.unknowns + 1),
        ("starts", args.starts, 1),
    ):
        if value < least:
            raise InputError(f"{name}: {value} is too few; give at least {least}.")
    fly = _box("fly", args.fly) if args.fly else Room(*demand.room.flyable)
    lower, upper, k = fly.lower.copy(), fly.upper.copy(), installation.dimensions
    lower[k:] = upper[k:] = height
    step = max(0.1, (np.prod((upper - lower)[:k]) / SEARCHED) ** (1.0 / k))

    def goal(step: float) -> Goal:
        return Goal(
            lattice(lower, upper, step), installation, _pairing(args), args.objective, demand
        )

    return Aim(goal(step), goal(0.4 * step), places_of(args, demand.room), count)


def goal_of(args: Namespace, installation: Installation, demand: Demand) -> Goal:
    """Goal of no points, whose `installed` gives the Installation of other Anchors."""
    return Goal(np.empty((0, 3)), installation, _pairing(args), demand=demand)


def places_of(args: Namespace, room: Room) -> AnchorPlaces:
    """AnchorPlaces that --places gives, or the walls of the Room. Raises InputError."""
    return (
        AnchorPlaces.from_yaml(args.places)
        if args.places
        else AnchorPlaces.walls(room.lower, room.upper)
    )


def plain(args: Namespace) -> dict[str, Any]:
    """The options as JSON takes them."""
    return {
        name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()
    }


def _pairing(args: Namespace) -> str:
    return args.covariance or OF_PROTOCOL[args.protocol]


def _box(name: str, numbers: Sequence[float]) -> Room:
    lower, upper = np.array(numbers[0::2]), np.array(numbers[1::2])
    if not (upper > lower).all():
        raise InputError(
            f"{name}: {list(numbers)} is empty; give X0 X1 Y0 Y1 Z0 Z1, each pair rising."
        )
    return Room(lower, upper)
