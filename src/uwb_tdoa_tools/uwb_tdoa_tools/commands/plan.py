# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Plan an installation: where a tag can be located, how precisely, and better anchors."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from uwb_tdoa_bias.common.radio import RadioLink
from uwb_tdoa_bias.common.sensors import SENSORS

from .. import choices, cli, options
from ..choices import (
    ACCURACY,
    CRITERIA,
    OF_PROTOCOL,
)
from ..cli import OutputFile, OutputFolder, exclusive, group, option

ROUND = (
    "what a round holds: N TDOAs in a ring (tdoa2), TDOAs between any two of N anchors, each "
    "with an error of its own and all together "
    "weighted like N (tdoa3), N two-way ranges, or both (default: tdoa2)"
)
DEFAULT = "(default: %(default)s)"


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "plan",
        (
            "Precision (Cramer-Rao bound), failure (two solutions) and accuracy of positions by "
            "TDOAs or ranges among given anchors,\n"
            "and better places for the anchors. Writes pictures, plan.json, flyable.npz (for the "
            "filter's node) and a bag\n"
            "with the maps (OccupancyGrid, MarkerArray) for RViz and Foxglove."
        ),
        "plan anchors.yaml --height 1.2 --out plan/",
        "plan survey.txt --volume --room -3 4 -4 4 0 3 --protocol tdoa3 --out plan/",
        "plan square.yaml --planar --height 0.2 --out plan/",
        "plan survey.txt --volume --with height --flights flights/0425 --out plan/",
        "plan survey.txt --volume --improve --out plan/",
        "plan survey.txt --volume --protocol tdoa2+ranges --noise 0.1 --out plan/",
        (
            "plan --hall --room 0 120 0 60 0 8 --height 1.2 --radio-reach 25 --accuracy 0.5 "
            "--share 0.95 --out plan/"
        ),
        "plan hall.yaml --radio-reach 18 --height 1.2 --walls walls.yaml --out plan/",
        options=[
            option(
                "anchors", metavar="ANCHORS", nargs="?", help="anchors .yaml or survey (.txt, .csv)"
            ),
            option(
                "--hall",
                action="store_true",
                help="without ANCHORS: how many a hall needs, and where; needs --room X0 X1 Y0 Y1 Z0 Z1",
            ),
            option(
                "--out",
                metavar="DIR",
                type=OutputFolder,
                required=True,
                help="where to write; replaces what an earlier plan left there",
            ),
            option("--json", metavar="FILE", type=OutputFile, help="write the figures here too"),
            group(
                "where",
                option(
                    "--room",
                    metavar="M",
                    nargs="+",
                    type=float,
                    help="X0 X1 Y0 Y1 [Z0 Z1], m, to walls, floor and ceiling (default: what the anchors span)",
                ),
                exclusive(
                    option(
                        "--height",
                        metavar="M",
                        type=float,
                        help="one slice there (default: at half the room's height)",
                    ),
                    option("--volume", action="store_true", help="the whole room"),
                ),
                option(
                    "--step",
                    metavar="M",
                    type=float,
                    help="size of a cell (default: 100 along a slice, 50 in a volume)",
                ),
                option(
                    "--planar",
                    action="store_true",
                    help="the height of the tag is known: x and y only",
                ),
            ),
            group(
                "measurements",
                option("--protocol", choices=OF_PROTOCOL, default="tdoa2", help=ROUND),
                option(
                    "--antenna",
                    metavar="FILE",
                    help="pattern, YAML: azimuth, elevation_1, elevation_2, gain_offset, in dBi",
                ),
                option(
                    "--tx-power",
                    metavar="DBM",
                    type=float,
                    default=RadioLink.tx_power_dbm,
                    help=f"into the antenna of an anchor {DEFAULT}",
                ),
                option(
                    "--noise",
                    metavar="M",
                    type=float,
                    help="standard deviation of every reception, instead of the radio's",
                ),
                option(
                    "--with",
                    dest="sensors",
                    action="append",
                    default=[],
                    choices=["height"],
                    help="what the tag measures besides: a range finder that looks down",
                ),
                option(
                    "--height-std",
                    metavar="M",
                    type=float,
                    default=SENSORS["height"].parameters["height_std"].default,
                    help=f"of that height {DEFAULT}",
                ),
                option(
                    "--accuracy",
                    metavar="M",
                    type=float,
                    default=ACCURACY,
                    help=f"where the bound of one round is larger, a place cannot be flown {DEFAULT}",
                ),
                option(
                    "--share",
                    metavar="S",
                    type=float,
                    default=0.95,
                    help=f"of the room that is to be flown, with --hall {DEFAULT}",
                ),
                option(
                    "--flyable",
                    choices=CRITERIA,
                    default="round",
                    help="one solution by a whole round, or by every choice of anchors alone (default: round)",
                ),
                option(
                    "--radio-reach",
                    metavar="M",
                    type=float,
                    help=(
                        "a hall: the tag hears the anchors within that, not all; must be given where the room is "
                        "larger than 30 m"
                    ),
                ),
                option(
                    "--walls",
                    metavar="FILE",
                    type=Path,
                    help=(
                        "with --radio-reach: no signal comes through these, YAML, walls: [[x0, y0, x1, y1], "
                        "...]"
                    ),
                ),
            ),
            group(
                "more",
                option(
                    "--flights",
                    metavar="FLIGHT",
                    nargs="+",
                    help=f"measured accuracy beside the bound; {choices.RECORDINGS}",
                ),
                options.JOBS,
                option("--improve", action="store_true", help="better places for all anchors"),
                option(
                    "--count",
                    metavar="N",
                    type=int,
                    help="with --improve: how many anchors (default: as there are)",
                ),
                option(
                    "--fly",
                    metavar="M",
                    nargs=6,
                    type=float,
                    help="X0 X1 Y0 Y1 Z0 Z1 that is flown (default: the room less 0.8, 0.6 m)",
                ),
                option(
                    "--places",
                    metavar="FILE",
                    help="where anchors may be, YAML, places: [[x0, y0, z0, x1, y1, z1]] (default: the walls)",
                ),
                option(
                    "--starts",
                    metavar="N",
                    type=int,
                    default=16,
                    help=f"layouts to search from {DEFAULT}",
                ),
            ),
        ],
    )


def _plan(args: Namespace) -> int:
    from ..planning import run

    return 0 if run.plan(args) else 1


main = cli.executable(_plan, parser)
