"""plan: where a tag can be located among given anchors, how precisely, and where the anchors had better be."""

from __future__ import annotations

from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig

from .. import cli, parallel
from ..outputs import OutputFile, OutputFolder
from ..planning import options, report, run
from ..planning.goal import OBJECTIVES
from ..planning.maps import FLYABLE, chart
from ..planning.noise import RadioNoise
from ..planning.pairing import OF_PROTOCOL, PAIRINGS
from ..progress import Progress
from ..readers import inputs, read_survey

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "plan",
        "Precision (Cramer-Rao bound), failure (two solutions) and accuracy of positions by TDOAs or ranges among given anchors,\n"
        "and better places for the anchors. Writes pictures, plan.json, flyable.npz (for the filter's node) and a bag\n"
        "with the maps (OccupancyGrid, MarkerArray) for RViz and Foxglove.",
        "plan anchors.yaml --height 1.2 --out plan/",
        "plan survey.txt --volume --room -3 4 -4 4 0 3 --protocol tdoa3 --out plan/",
        "plan square.yaml --planar --height 0.2 --check --out plan/",
        "plan survey.txt --volume --with height --flights flights/0425 --out plan/",
        "plan survey.txt --volume --improve add --out plan/",
        "plan survey.txt --volume --protocol tdoa2+ranges --noise 0.1 --out plan/",
        "plan hall.yaml --radio-reach 18 --height 1.2 --walls walls.yaml --out plan/",
    )
    number: dict[str, Any] = {"type": float}
    path: dict[str, Any] = {"type": Path}
    add, default = made.add_argument, "(default: %(default)s)"
    add("anchors", metavar="ANCHORS", help="anchors .yaml or survey (.txt, .csv)")
    add("--out", metavar="DIR", type=OutputFolder, required=True, help="where to write; replaces what an earlier plan left there")
    add("--json", metavar="FILE", type=OutputFile, help="write the figures here too")
    add("--publish", action="store_true", help="publish the maps on ROS topics plan/... until Ctrl-C")

    where = made.add_argument_group("where")
    add, either = where.add_argument, where.add_mutually_exclusive_group()
    add("--room", metavar="M", nargs="+", **number, help="X0 X1 Y0 Y1 [Z0 Z1], m, to walls, floor and ceiling (default: what the anchors span)")
    either.add_argument("--height", metavar="M", **number, help="one slice there (default: at half the room's height)")
    either.add_argument("--volume", action="store_true", help="the whole room")
    add("--step", metavar="M", **number, help="size of a cell (default: 100 along a slice, 50 in a volume)")
    add("--planar", action="store_true", help="the height of the tag is known: x and y only")

    add, radio = made.add_argument_group("measurements").add_argument, RadioNoise
    add("--protocol", choices=OF_PROTOCOL, default="tdoa2", help="TDOAs, ranges (two-way), or both, that a round holds (default: tdoa2)")
    add("--covariance", choices=PAIRINGS, help="what a round holds, and what its TDOAs share (default: as --protocol says)")
    add("--antenna", metavar="FILE", help="pattern, YAML: azimuth, elevation_1, elevation_2, gain_offset, in dBi")
    add("--tx-power", metavar="DBM", **number, default=radio.tx_power_dbm, help=f"at 25 C, 3.3 V {default}")
    add("--temperature", metavar="C", **number, default=radio.temperature, help=f"of the anchors {default}")
    add("--voltage", metavar="V", **number, default=radio.voltage, help=f"supply of the anchors {default}")
    add("--noise", metavar="M", **number, help="standard deviation of every reception, instead of the radio's")
    add("--link-noise", metavar="M", **number, default=0.0, help="error that every TDOA has of its own besides (default: 0)")
    add("--with", dest="aids", action="append", default=[], choices=["height"], help="what the tag measures besides: a range finder that looks down")
    height_std = FilterConfig().height_std  # type: ignore[attr-defined]  # parameters of SENSORS are known at run time
    add("--height-std", metavar="M", **number, default=height_std, help=f"of that height {default}")
    unique = "one solution by every pairing alone or by a whole round (default: pairings; with --radio-reach or ranges: round)"
    add("--flyable", choices=FLYABLE, help=unique)
    add("--radio-reach", metavar="M", **number, help="a hall: the tag hears the anchors within that, not all; many more anchors are possible")
    add("--walls", metavar="FILE", **path, help="with --radio-reach: no signal comes through these, YAML, walls: [[x0, y0, x1, y1], ...]")

    more = made.add_argument_group("more")
    add = more.add_argument
    add("--check", action="store_true", help="compare the failure map with a solver started from many places")
    add("--flights", metavar="FLIGHT", nargs="+", help=f"measured accuracy beside the bound; {inputs.HELP}")
    parallel.add_options(more)
    add("--improve", choices=("move", "add"), help="better places: move all anchors, or add one")
    add("--count", metavar="N", type=int, help="with --improve move: how many anchors (default: as there are)")
    add("--objective", choices=OBJECTIVES, default="worst", help="what to improve where it flies (default: worst)")
    add("--fly", metavar="M", nargs=6, **number, help="X0 X1 Y0 Y1 Z0 Z1 that is flown (default: the room less 0.8, 0.6 m)")
    add("--places", metavar="FILE", help="where anchors may be, YAML, places: [[x0, y0, z0, x1, y1, z1]] (default: the walls)")
    add("--starts", metavar="N", type=int, default=16, help=f"layouts to search from {default}")
    return made


def _plan(args: Namespace) -> None:
    anchors = read_survey(args.anchors)
    if args.walls is not None and args.radio_reach is None:
        raise InputError("walls: are for a hall of which a tag hears a part; give --radio-reach too.")
    installation = options.installation_of(args, anchors)
    args.flyable = options.criterion_of(args, installation)
    room = options.room_for(args, anchors)
    grid = options.grid_of(args, room)
    if args.flights and args.planar:
        raise InputError("flights: are judged in three dimensions; leave out --planar.")
    reading = inputs.Reading(args.anchors)
    recordings = reading.find(args.flights or [], bool(args.dask))
    if args.radio_reach is not None:
        return run.end(args, *run.plan_hall(args, anchors, installation, room, grid))
    aim = options.aim_of(args, installation, room, grid.axes[2][0]) if args.improve else None

    if not np.isfinite(anchors.orientations).all():
        cli.show("anchors without orientation are taken to radiate alike in all directions")
    report.say_room(room, args.room is not None)
    args.out.mkdir(parents=True, exist_ok=True)
    with Progress("plan") as progress:
        progress("mapping")
        found = chart(installation, grid, args.flyable)
    figures: dict[str, Any] = {"anchors": len(anchors), "arguments": options.plain(args), "map": report.summary(found)}
    report.say_summary(figures["map"])
    installed, places = options.goal_of(args, installation).installed, options.places_of(args, room)
    figures["addition"] = run.addition(found, anchors, installed, places, args.flyable)
    report.say_flyable(figures["map"], figures["addition"], args.flyable)
    outgoing = run.draw_map(found, installation, args.out)
    if args.check:
        figures["check"] = run.check(installation, grid, args.out)
        report.say_check(figures["check"])
    if recordings:
        flown = parallel.over(run.Fly(reading, tuple(args.aids)), recordings, args.jobs, args.dask)
        figures["flights"] = run.evaluate_flights(flown, installation, room, args.step or 0.4, args.out)
        report.say_flights(figures["flights"])
    if aim:
        figures["improve"] = run.improve(found, aim, args.improve, args.starts, args.flyable, args.out)
        report.say_improvement(figures["improve"])
    run.end(args, figures, outgoing)


main = cli.executable(_plan, parser)

if __name__ == "__main__":
    sys.exit(main())
