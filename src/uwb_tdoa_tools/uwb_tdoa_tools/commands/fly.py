# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly a simulated vehicle by the estimate, many times: take off, fly and land."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS

from .. import cli, options, parallel
from ..choices import FLOWN, MOMENTS, WORLDS
from ..cli import OutputFile, OutputFolder, option

if TYPE_CHECKING:
    from ..flying.mission import Circles, Waypoints

NOT_OF_ROVERS = ("hover", "again", "sensor")  # options
DESCRIPTION = """Fly a simulated quadrotor in closed loop, in lockstep and without ROS: its controller gets position, velocity and
attitude from nothing but the estimate, by the very code of ekf_node, and its rates from the gyroscope. Four seconds at rest, up to
1.2 m, two circles, down, land. The verdict is by ground truth alone.

A flight has landed if it took off, came down within 0.3 m of the wanted place at less than 0.6 m/s, and stands upright. Exit code 1
if fewer than --at-least have.

With --vehicle rover, a rover on wheels drives from place to place by the estimate. It has arrived if it stands within 0.3 m of the
last place, and touched no wall. Its filter has planar, fixed_height and non_holonomic_std set."""


def parser() -> argparse.ArgumentParser:
    """Its options."""
    return cli.parser(
        "fly",
        DESCRIPTION,
        "fly",
        "fly --flights 100 --json flown.json --plot flown.png",
        "fly --no-floor-effect --told place --yaw unknown --set robust:=m_estimation",
        "fly --sensor height --flights 20 --seed 1000 --at-least 19",
        "fly --world person --again --inject anchor_delay 3=0.3",
        "fly --vehicle rover --flights 20 --plot driven.png",
        "fly --silence circle:3 --effects effects.yaml",
        "fly --installation 7 --flights 3 --seed 101 --record flown/",
        "fly --flights 1000 --json flown.json --jobs 4",
        options=[
            option(
                "--flights",
                metavar="N",
                type=parallel.whole_number,
                default=10,
                help="how many (default: 10)",
            ),
            option(
                "--seed",
                metavar="S",
                type=parallel.whole_number,
                default=1,
                help="of the first flight; each later one has the next seed (default: 1)",
            ),
            option(
                "--vehicle",
                choices=FLOWN,
                default="quadrotor",
                help="what is flown, or driven (default: quadrotor)",
            ),
            option(
                "--world",
                choices=WORLDS,
                default="hall",
                help="what it flies in (default: hall; docs/flying.md)",
            ),
            option(
                "--installation",
                metavar="N",
                type=parallel.whole_number,
                help="the same anchors' errors in every flight (default: its own)",
            ),
            option(
                "--told",
                choices=("nothing", "place"),
                default="nothing",
                help="at the start: its place, to 0.1 m (default: nothing)",
            ),
            option(
                "--yaw",
                choices=("known", "unknown"),
                default="known",
                help="at the start, to 0.1 rad (default: known)",
            ),
            option(
                "--sensor",
                action="append",
                default=[],
                choices=tuple(SENSORS),
                help="what else it measures: "
                + ", ".join(sensor.plural for sensor in SENSORS.values()),
            ),
            option(
                "--floor-effect",
                action=argparse.BooleanOptionalAction,
                help="low anchors are late near the floor (default: the world's)",
            ),
            option(
                "--silence",
                metavar="MOMENT:S",
                help=f"nothing is heard for S seconds: MOMENT is one of {', '.join(MOMENTS)}",
            ),
            option("--hover", action="store_true", help="instead of circles"),
            option(
                "--again",
                action="store_true",
                help="a minute later, carried by 2 m meanwhile, fly once more, without a restart",
            ),
            option(
                "--inject",
                nargs="+",
                action="append",
                default=[],
                metavar=("EFFECT", "KEY=NUMBER"),
                help="an effect, as of inject",
            ),
            *options.filtering(),
            option(
                "--model",
                metavar="FILE",
                help="ONNX bias network to correct with, e.g. one that train wrote (default: none)",
            ),
            option(
                "--set",
                metavar="NAME:=VALUE",
                action="append",
                default=[],
                help="a filter parameter; may be repeated",
            ),
            options.JOBS,
            option(
                "--at-least",
                metavar="N",
                type=int,
                default=0,
                help="flights that are to land, drives to arrive (default: 0)",
            ),
            option(
                "--record",
                metavar="DIR",
                type=OutputFolder,
                help="write every flight as a bag, DIR/flown-SEED, e.g. for diagnose",
            ),
            option(
                "--json",
                metavar="FILE",
                type=OutputFile,
                help="write the summary and every verdict",
            ),
            option(
                "--plot",
                metavar="FILE",
                type=OutputFile,
                help="draw a map of all flights, and the errors of the worst with three sigma",
            ),
        ],
    )


def _fly(args: argparse.Namespace) -> int:
    from uwb_tdoa_bias.correction.model import load_network

    from ..flying import rover, verdict
    from ..flying.mission import Circles, Waypoints
    from ..flying.trial import Task
    from ..flying.vehicle import world_of
    from ..flying.verdict import summary, text, wording_of

    if args.record is not None:
        args.record.mkdir(parents=True, exist_ok=True)
    config, effects = options.filter_of(args)
    load_network(args.model)  # or say what is wrong with it, before the first flight
    path: Circles | Waypoints = Circles(radius=0.0) if args.hover else Circles()
    sensors = args.sensor
    if args.vehicle == "rover":
        _check_rover(args)
        config, path, sensors = replace(config, **rover.FILTER), Waypoints(), rover.SENSOR_NAMES
    config = options.with_parameters(config, args.set)
    world = world_of(
        args.world, args.floor_effect, sensors, args.silence, args.inject, args.installation
    )
    seeds = range(args.seed, args.seed + args.flights)
    tasks = [
        Task(
            world,
            seed,
            args.told,
            args.yaw,
            config,
            effects,
            args.model,
            args.again,
            path,
        )
        for seed in seeds
    ]
    one = partial(verdict.fly_task, args.record, args.plot is not None)
    verdicts, pictures = zip(*parallel.over(one, tasks, args.jobs))
    summed = summary(verdicts)
    cli.show(text(summed))
    cli.write_json(args.json, {"summary": summed, "flights": verdicts})
    if args.plot is not None:
        verdict.plot(pictures, world.anchors, args.plot)
    return int(summed[wording_of(summed).goal] < args.at_least)


def _check_rover(args: argparse.Namespace) -> None:
    """Refuse options that a rover has nothing to do with."""
    from ..flying.vehicle import WORLDS

    for name in NOT_OF_ROVERS:
        if getattr(args, name):
            raise InputError(f"--{name}: is of the quadrotor; leave it out with --vehicle rover.")
    if WORLDS[args.world].table:
        raise InputError(f"--world {args.world}: a rover does not start from a table.")


main = cli.executable(_fly, parser)
