# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate a flight, a drive or a walk, and write it as a bag."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from .. import cli
from ..choices import STORAGES
from ..cli import option
from ..outputs import OutputBag, OutputFile
from ..parallel import Progress
from ..simulation_options import OPTIONS, config_of


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "simulate",
        (
            "Simulate a quadrotor, a rover or a person with a UWB tag among fixed anchors, and "
            "write it as a ROS 2 bag."
        ),
        "simulate --out flight.bag",
        (
            "simulate --trajectory circle --protocol tdoa3 --height-noise 0.01 --seed 7 --out "
            "circle.bag --plot circle.png"
        ),
        "simulate --vehicle rover --duration 90 --out rover.bag",
        'simulate --vehicle hand --path "-2,-3 2,-3 2,3 -2,3" --out walk.bag',
        "simulate --constellation random-12-16 --duration 120 --out unseen.bag --json unseen.json",
        (
            "simulate --anchors hall.yaml --radio-reach 18 --protocol tdoa3 --duration 300 --out "
            "hall.bag"
        ),
        (
            "simulate --anchors hall.yaml --radio-reach 18 --walls walls.yaml --cell-ids 256 "
            "--protocol tdoa3 --out cells.bag"
        ),
        "simulate --no-bias --no-multipath --no-outliers --noise 0 --perfect-imu --out exact.bag",
        "simulate --list",
        options=[
            option(
                "--list",
                action="store_true",
                help="list trajectories and constellations, and do nothing else",
            ),
            option(
                "--out",
                metavar="BAG",
                type=OutputBag,
                help="the bag to write: a new directory; without it, nothing is written",
            ),
            option(
                "--storage", choices=STORAGES, default="mcap", help="kind of bag (default: mcap)"
            ),
            option("--force", action="store_true", help="replace an existing bag"),
            option(
                "--json",
                metavar="FILE",
                type=OutputFile,
                help="write the configuration, the true parameters and the counts",
            ),
            option(
                "--plot",
                metavar="FILE",
                type=OutputFile,
                help="draw the path and the errors of the TDOAs",
            ),
            *OPTIONS,
        ],
    )


def _simulate(args: Namespace) -> None:
    from ..bags.bag import check_output, write_bag
    from ..simulation import simulate
    from ..simulation.report import catalogue, check_image, plot, summary

    if args.list:
        cli.show(catalogue())
        return
    if args.out is not None:
        check_output(args.out, args.force)  # before the work, not after it
    check_image(args.plot)
    with Progress("simulate", what="flying"):
        flight = simulate(config_of(args))
        content = summary(flight)
    cli.show(
        f"{flight.name}: {content['tdoas']} TDOAs, {content['imu_samples']} IMU samples, "
        f"{content['poses']} poses"
    )
    cli.show(
        f"errors of the TDOAs, standard deviation: bias {content['bias_std']:.3f} m, "
        f"multipath {content['multipath_std']:.3f} m, noise {content['noise_std']:.3f} m; "
        f"{content['outliers']} outliers"
    )
    if args.out is not None:
        with Progress("simulate", what="writing"):
            write_bag(flight, args.out, args.storage, args.force)
        cli.show(f"wrote {args.out}")
    if args.json is not None:
        cli.write_json(args.json, content)
        cli.show(f"wrote {args.json}")
    if args.plot is not None:
        plot(flight, args.plot)
        cli.show(f"wrote {args.plot}")


main = cli.executable(_simulate, parser)
