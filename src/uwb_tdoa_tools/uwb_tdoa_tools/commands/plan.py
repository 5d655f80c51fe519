# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Plan an installation: where a tag can be located, how precisely, and better anchors."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from uwb_tdoa_bias.common.radio import RadioLink
from uwb_tdoa_bias.common.sensors import SENSORS

from .. import choices, cli, parallel
from ..choices import (
    ACCURACY,
    CRITERIA,
    OBJECTIVES,
    OF_PROTOCOL,
    PAIRINGS,
    TEMPERATURE,
    VOLTAGE,
)
from ..outputs import OutputFile, OutputFolder

ROUND = (
    "what a round holds: N TDOAs in a ring (tdoa2), TDOAs between any two of N anchors, each "
    "with an error of its own and all together "
    "weighted like N (tdoa3), N two-way ranges, or both (default: tdoa2)"
)


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "plan",
        "Precision (Cramer-Rao bound), failure (two solutions) and accuracy of positions by "
        "TDOAs or ranges among given anchors,\n"
        "and better places for the anchors. Writes pictures, plan.json, flyable.npz (for the "
        "filter's node) and a bag\n"
        "with the maps (OccupancyGrid, MarkerArray) for RViz and Foxglove.",
        "plan anchors.yaml --height 1.2 --out plan/",
        "plan survey.txt --volume --room -3 4 -4 4 0 3 --protocol tdoa3 --out plan/",
        "plan square.yaml --planar --height 0.2 --check --out plan/",
        "plan survey.txt --volume --with height --flights flights/0425 --out plan/",
        "plan survey.txt --volume --improve add --out plan/",
        "plan survey.txt --volume --protocol tdoa2+ranges --noise 0.1 --out plan/",
        (
            "plan --hall --room 0 120 0 60 0 8 --height 1.2 --radio-reach 25 --accuracy 0.5 "
            "--share 0.95 --out plan/"
        ),
        "plan hall.yaml --radio-reach 18 --height 1.2 --walls walls.yaml --out plan/",
    )
    number: dict[str, Any] = {"type": float}
    path: dict[str, Any] = {"type": Path}
    add, default = made.add_argument, "(default: %(default)s)"
    add("anchors", metavar="ANCHORS", nargs="?", help="anchors .yaml or survey (.txt, .csv)")
    add(
        "--hall",
        action="store_true",
        help="without ANCHORS: how many a hall needs, and where; needs --room X0 X1 Y0 Y1 Z0 Z1",
    )
    add(
        "--out",
        metavar="DIR",
        type=OutputFolder,
        required=True,
        help="where to write; replaces what an earlier plan left there",
    )
    add("--json", metavar="FILE", type=OutputFile, help="write the figures here too")
    add(
        "--publish",
        action="store_true",
        help="publish the maps on ROS topics plan/... until Ctrl-C",
    )

    where = made.add_argument_group("where")
    add, either = where.add_argument, where.add_mutually_exclusive_group()
    add(
        "--room",
        metavar="M",
        nargs="+",
        **number,
        help="X0 X1 Y0 Y1 [Z0 Z1], m, to walls, floor and ceiling (default: what the anchors span)",
    )
    either.add_argument(
        "--height",
        metavar="M",
        **number,
        help="one slice there (default: at half the room's height)",
    )
    either.add_argument("--volume", action="store_true", help="the whole room")
    add(
        "--step",
        metavar="M",
        **number,
        help="size of a cell (default: 100 along a slice, 50 in a volume)",
    )
    add("--planar", action="store_true", help="the height of the tag is known: x and y only")

    add, radio = made.add_argument_group("measurements").add_argument, RadioLink
    add("--protocol", choices=OF_PROTOCOL, default="tdoa2", help=ROUND)
    add(
        "--covariance",
        choices=PAIRINGS,
        help="what a round holds, and what its TDOAs share (default: as --protocol says)",
    )
    add(
        "--antenna",
        metavar="FILE",
        help="pattern, YAML: azimuth, elevation_1, elevation_2, gain_offset, in dBi",
    )
    add(
        "--tx-power",
        metavar="DBM",
        **number,
        default=radio.tx_power_dbm,
        help=f"at 25 C, 3.3 V {default}",
    )
    add(
        "--temperature",
        metavar="C",
        **number,
        default=TEMPERATURE,
        help=f"of the anchors {default}",
    )
    add(
        "--voltage",
        metavar="V",
        **number,
        default=VOLTAGE,
        help=f"supply of the anchors {default}",
    )
    add(
        "--noise",
        metavar="M",
        **number,
        help="standard deviation of every reception, instead of the radio's",
    )
    add(
        "--link-noise",
        metavar="M",
        **number,
        default=0.0,
        help="error that every TDOA has of its own besides (default: 0)",
    )
    add(
        "--with",
        dest="sensors",
        action="append",
        default=[],
        choices=["height"],
        help="what the tag measures besides: a range finder that looks down",
    )
    height_std = SENSORS["height"].parameters["height_std"].default
    add("--height-std", metavar="M", **number, default=height_std, help=f"of that height {default}")
    add(
        "--accuracy",
        metavar="M",
        **number,
        default=ACCURACY,
        help=f"where the bound of one round is larger, a place cannot be flown {default}",
    )
    add(
        "--share",
        metavar="S",
        **number,
        default=0.95,
        help=f"of the room that is to be flown, with --hall {default}",
    )
    add(
        "--flyable",
        choices=CRITERIA,
        default="round",
        help="one solution by a whole round, or by every choice of anchors alone (default: round)",
    )
    reach = (
        "a hall: the tag hears the anchors within that, not all; must be given where the room is "
        "larger than 30 m"
    )
    add("--radio-reach", metavar="M", **number, help=reach)
    add(
        "--walls",
        metavar="FILE",
        **path,
        help=(
            "with --radio-reach: no signal comes through these, YAML, walls: [[x0, y0, x1, y1], "
            "...]"
        ),
    )

    more = made.add_argument_group("more")
    add = more.add_argument
    add(
        "--check",
        action="store_true",
        help="compare the failure map with a solver started from many places",
    )
    add(
        "--flights",
        metavar="FLIGHT",
        nargs="+",
        help=f"measured accuracy beside the bound; {choices.RECORDINGS}",
    )
    parallel.add_options(more)
    add("--improve", choices=("move", "add"), help="better places: move all anchors, or add one")
    add(
        "--count",
        metavar="N",
        type=int,
        help="with --improve move: how many anchors (default: as there are)",
    )
    add(
        "--objective",
        choices=OBJECTIVES,
        default="worst",
        help="what to improve where it flies (default: worst)",
    )
    add(
        "--fly",
        metavar="M",
        nargs=6,
        **number,
        help="X0 X1 Y0 Y1 Z0 Z1 that is flown (default: the room less 0.8, 0.6 m)",
    )
    add(
        "--places",
        metavar="FILE",
        help="where anchors may be, YAML, places: [[x0, y0, z0, x1, y1, z1]] (default: the walls)",
    )
    add("--starts", metavar="N", type=int, default=16, help=f"layouts to search from {default}")
    return made


def _plan(args: Namespace) -> int:
    from ..planning import run

    return 0 if run.plan(args) else 1


main = cli.executable(_plan, parser)
