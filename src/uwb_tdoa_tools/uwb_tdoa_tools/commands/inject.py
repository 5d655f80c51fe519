# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Add a declared effect to a recorded or simulated flight."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, options
from ..cli import OutputBag, option

DESCRIPTION = """Add a declared effect to a flight, and write the flight that would have been recorded with it as a
ROS 2 bag.

A value is PARAMETER=NUMBER, as in effects.yaml; a number alone is for the effect's first parameter. --list shows
them."""


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "inject",
        DESCRIPTION,
        (
            "inject 0425-traj2 --survey anchor_0425.txt --effect anchor_delay --value 3=0.3 --out "
            "late_bag"
        ),
        "inject flight_bag --effect tag_lever_arm --value x=0.05 z=0.1 --out arm_bag",
        "inject flight_bag --effect nlos --value 2.delay=0.4 2.start=20 2.end=35 --out blocked_bag",
        "inject --list",
        options=[
            option(
                "flight", metavar="FLIGHT", nargs="?", help="a raw log, a UTIL CSV file or a bag"
            ),
            option(
                "--list",
                action="store_true",
                help="list effects, parameters and units, and do nothing else",
            ),
            *options.READING,
            option("--effect", metavar="NAME", help="the effect to add, one of --list"),
            option("--value", metavar="KEY=NUMBER", nargs="+", default=[], help="its parameters"),
            option(
                "--seed",
                metavar="N",
                type=int,
                default=0,
                help="of effects that are random (default: 0)",
            ),
            option(
                "--out", metavar="BAG", type=OutputBag, help="the bag to write: a new directory"
            ),
            *options.BAG,
        ],
    )


def _inject(args: Namespace) -> None:
    from ..simulation.inject import catalogue, inject, parse_effect

    if args.list:
        cli.show(catalogue())
        return
    for name in ("flight", "effect", "value", "out"):
        if not getattr(args, name):
            raise InputError(f"{name}: is missing; see inject --help.")
    effect = parse_effect(args.effect, args.value)
    with cli.Progress("inject", what="reading and writing"):
        name = inject(
            effect,
            args.flight,
            options.reading_of(args),
            args.out,
            args.seed,
            args.storage,
            args.force,
        )
    added = ", ".join(f"{key} = {value:g}" for key, value in effect.values.items())
    cli.show(f"{name}: added {effect.name} ({added}, in {effect.unit}) -> {args.out}")


main = cli.executable(_inject, parser)
