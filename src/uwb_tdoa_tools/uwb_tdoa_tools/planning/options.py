"""The command line of plan, and what it means."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.foundation.antenna import Antenna
from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..readers import inputs
from .. import parallel
from ..simulation.room import Room, room_of
from .installation import Installation
from .goal import OBJECTIVES, Goal
from .maps import FLYABLE, Grid
from .noise import FixedNoise, RadioNoise, antenna_from_yaml
from .pairing import OF_PROTOCOL, PAIRINGS
from .places import Places, lattice

ACROSS = {"slice": 100, "volume": 50}  # cells along the longest side, unless --step says otherwise
SEARCHED = 300  # cells of the flown volume whose corners are looked at while better anchors are searched


def parser():
    """The ArgumentParser of plan."""
    made = cli.parser(
        "plan",
        "Precision (Cramer-Rao bound), failure (two solutions) and accuracy of TDOA positions among given anchors,\n"
        "and better places for the anchors. Writes pictures, plan.json, flyable.npz (for the filter's node) and a bag\n"
        "with the maps (OccupancyGrid, MarkerArray) for RViz and Foxglove.",
        "plan anchors.yaml --height 1.2 --out plan/",
        "plan survey.txt --volume --area -3 4 -4 4 0 3 --protocol tdoa3 --out plan/",
        "plan square.yaml --planar --height 0.2 --check --out plan/",
        "plan survey.txt --volume --flights flights/0425 --out plan/",
        "plan survey.txt --volume --improve add --out plan/",
    )
    add = made.add_argument
    add("anchors", metavar="ANCHORS", help="anchors .yaml or survey (.txt, .csv)")
    add(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="where to write; replaces what an earlier plan left there",
    )
    add("--json", metavar="FILE", type=Path, help="write the figures here too")
    add("--publish", action="store_true", help="publish the maps on ROS topics plan/... until Ctrl-C")
    _add_places(made.add_argument_group("where"))
    _add_measurements(made.add_argument_group("measurements"))
    _add_more(made.add_argument_group("more"))
    return made


def _add_places(group):
    group.add_argument(
        "--area",
        metavar="M",
        type=float,
        nargs="+",
        help="X0 X1 Y0 Y1 [Z0 Z1] of the room, m (default: around the anchors)",
    )
    either = group.add_mutually_exclusive_group()
    either.add_argument(
        "--height", metavar="M", type=float, help="one slice there (default: at half the room's height)"
    )
    either.add_argument("--volume", action="store_true", help="the whole room")
    group.add_argument(
        "--step", metavar="M", type=float, help="size of a cell (default: 100 along a slice, 50 in a volume)"
    )
    group.add_argument("--planar", action="store_true", help="the height of the tag is known: x and y only")


def _add_measurements(group):
    add, radio = group.add_argument, RadioNoise
    add("--protocol", choices=OF_PROTOCOL, default="tdoa2", help="which TDOAs a round holds (default: tdoa2)")
    add(
        "--covariance", choices=PAIRINGS, help="the TDOAs of a round and what they share (default: ring for tdoa2, "
        "all_pairs for tdoa3)",
    )  # fmt: skip
    add("--antenna", metavar="FILE", help="pattern, YAML: azimuth, elevation_1, elevation_2, gain_offset, in dBi")
    add(
        "--tx-power",
        metavar="DBM",
        type=float,
        default=radio.tx_power_dbm,
        help="at 25 C, 3.3 V (default: %(default)s)",
    )
    add(
        "--temperature",
        metavar="C",
        type=float,
        default=radio.temperature,
        help="of the anchors (default: %(default)s)",
    )
    add(
        "--voltage", metavar="V", type=float, default=radio.voltage, help="supply of the anchors (default: %(default)s)"
    )
    add("--noise", metavar="M", type=float, help="standard deviation of every reception, instead of the radio's")
    add(
        "--link-noise",
        metavar="M",
        type=float,
        default=0.0,
        help="error that every TDOA has of its own besides (default: 0)",
    )
    add(
        "--flyable", choices=FLYABLE, default="pairings", help="one solution by every pairing alone or by a whole round "
        "(default: pairings)",
    )  # fmt: skip


def _add_more(group):
    add = group.add_argument
    add("--check", action="store_true", help="compare the failure map with a solver started from many places")
    add("--flights", metavar="FLIGHT", nargs="+", help=f"measured accuracy beside the bound; {inputs.HELP}")
    parallel.add_options(group)
    add("--improve", choices=("move", "add"), help="better places: move all anchors, or add one")
    add("--count", metavar="N", type=int, help="with --improve move: how many anchors (default: as there are)")
    add("--objective", choices=OBJECTIVES, default="worst", help="what to improve where it flies (default: worst)")
    add(
        "--fly",
        metavar="M",
        type=float,
        nargs=6,
        help="X0 X1 Y0 Y1 Z0 Z1 that is flown (default: the room less 0.8, 0.6 m)",
    )
    add(
        "--places",
        metavar="FILE",
        help="where anchors may be, YAML, places: [[x0, y0, z0, x1, y1, z1]] (default: the walls)",
    )
    add("--starts", metavar="N", type=int, default=16, help="layouts to search from (default: %(default)s)")


@dataclass(frozen=True)
class Aim:
    """What --improve asks for. goal : Goal to search with; judge : Goal at more points, to report; places : Places;
    count : how many anchors."""

    goal: Goal
    judge: Goal
    places: Places
    count: int


def installation_of(args, anchors):
    """Installation of Anchors and the options. Raises InputError."""
    if args.noise is not None:
        noise = FixedNoise(args.noise)
    else:
        antenna = antenna_from_yaml(args.antenna) if args.antenna else Antenna()
        noise = RadioNoise(antenna, args.tx_power, args.temperature, args.voltage)
    pairing = PAIRINGS[_pairing(args)](len(anchors)) if len(anchors) > 1 else None
    return Installation(anchors, noise, pairing, args.link_noise, 2 if args.planar else 3)


def room_for(args, anchors):
    """Room that --area gives, or that the anchors stand in. Raises InputError."""
    room = room_of(anchors)
    if args.area is None:
        return room
    if len(args.area) not in (4, 6):
        raise InputError(f"area: {len(args.area)} numbers were given; give X0 X1 Y0 Y1 or X0 X1 Y0 Y1 Z0 Z1.")
    return _box("area", args.area if len(args.area) == 6 else [*args.area, room.lower[2], room.upper[2]])


def grid_of(args, room):
    """Grid of a slice or of the Room. Raises InputError."""
    size = room.upper - room.lower
    if args.volume and args.planar:
        raise InputError("planar: with a known height there is no volume; leave out --volume, or --planar.")
    if args.volume:
        return Grid.box(room.lower, room.upper, args.step or size.max() / ACROSS["volume"])
    height = room.centre[2] if args.height is None else args.height
    step = args.step or size[:2].max() / ACROSS["slice"]
    return Grid.slice((room.lower[0], room.upper[0]), (room.lower[1], room.upper[1]), height, step)


def aim_of(args, installation, room, height):
    """Aim of --improve. height : m, of the flown slice if the tag's height is known. Raises InputError."""
    count = len(installation.anchors) if args.count is None else args.count
    for name, value, least in (("count", count, installation.dimensions + 1), ("starts", args.starts, 1)):
        if value < least:
            raise InputError(f"{name}: {value} is too few; give at least {least}.")
    fly = _box("fly", args.fly) if args.fly else Room(*room.flyable)
    lower, upper, k = fly.lower.copy(), fly.upper.copy(), installation.dimensions
    lower[k:] = upper[k:] = height
    step = max(0.1, (np.prod((upper - lower)[:k]) / SEARCHED) ** (1.0 / k))

    def goal(step):
        return Goal(lattice(lower, upper, step), installation, _pairing(args), args.objective, args.flyable)

    places = Places.from_yaml(args.places) if args.places else Places.walls(room.lower, room.upper)
    return Aim(goal(step), goal(0.4 * step), places, count)


def plain(args):
    """The options as JSON takes them."""
    return {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()}


def _pairing(args):
    return args.covariance or OF_PROTOCOL[args.protocol]


def _box(name, numbers):
    lower, upper = np.array(numbers[0::2]), np.array(numbers[1::2])
    if not (upper > lower).all():
        raise InputError(f"{name}: {list(numbers)} is empty; give X0 X1 Y0 Y1 Z0 Z1, each pair rising.")
    return Room(lower, upper)
