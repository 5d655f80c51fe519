# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate a flight, a drive or a walk, and write it as a bag."""

from __future__ import annotations

from argparse import SUPPRESS, ArgumentParser, ArgumentTypeError, Namespace
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.common.sensors import SENSORS

from .. import cli
from ..choices import CARRIERS, CONSTELLATIONS, PROTOCOLS, STORAGES, TRAJECTORIES, YAW_PROFILES
from ..cli import OutputBag, OutputFile, exclusive, group, option

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.flight import Flight

    from ..simulation.config import SimulationConfig

POSE = "t", "x", "y", "z", "yaw"  # columns of --poses
UNSET: dict[str, Any] = {"default": SUPPRESS}  # not given: the usual value of the vehicle
NUMBER: dict[str, Any] = {"type": float, **UNSET}


def _points(text: str) -> tuple[tuple[float, ...], ...]:
    """Parse "X,Y X,Y ..."."""
    return tuple(_point(each) for each in text.split())


def _point(text: str) -> tuple[float, ...]:
    """Parse "X,Y" or "X,Y,Z"."""
    try:
        return tuple(float(each) for each in text.split(","))
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is not X,Y or X,Y,Z in metres") from None


OPTIONS = (
    group(
        "motion",
        option(
            "--vehicle",
            choices=CARRIERS,
            default="quadrotor",
            help=(
                "what carries the tag, with its usual sensors: quadrotor; rover: drives on the floor, "
                "with wheels; hand: a person walks (default: quadrotor)"
            ),
        ),
        exclusive(
            option("--trajectory", choices=TRAJECTORIES, **UNSET, help="(default: sines)"),
            option(
                "--path",
                metavar="'X,Y X,Y ...'",
                type=_points,
                **UNSET,
                help="waypoints, m, or X,Y,Z, again and again",
            ),
            option(
                "--poses",
                metavar="FILE",
                type=Path,
                help=(
                    "timed path, CSV with columns t, x, y, z, yaw, s, m and rad, e.g. next_flight.csv of "
                    "diagnose"
                ),
            ),
        ),
        option(
            "--area",
            metavar="'X,Y X,Y'",
            type=_points,
            **UNSET,
            help="lower and upper corner of a trajectory, m (default: of the room)",
        ),
        option("--duration", metavar="S", **NUMBER, help="of the recording, s (default: 60)"),
        option("--speed", metavar="M/S", **NUMBER, help="at cruise, m/s (default: 1; rover: 0.8)"),
        option(
            "--height",
            metavar="M",
            **NUMBER,
            help="of the path, m (default: half the height that is flyable; hand: 1.1)",
        ),
        option(
            "--yaw",
            choices=YAW_PROFILES,
            **UNSET,
            help="(default: fixed; hand: along_track; spin always rotates; a rover has no choice)",
        ),
        option(
            "--start-in-air",
            action="store_true",
            help="leave out take-off and landing of a quadrotor",
        ),
        option(
            "--tag-lever-arm",
            metavar="X,Y,Z",
            type=_point,
            **UNSET,
            help="antenna in the body, m (default: 0,0,0; rover: 0.1,0,0.4)",
        ),
        option(
            "--wheel-scale",
            metavar="X",
            **NUMBER,
            help="share by which wheels of a rover say too much (default: 0.02)",
        ),
        option(
            "--wheel-slip",
            metavar="X",
            **NUMBER,
            help="the same while they slip, half a second every ten (default: 0.2)",
        ),
        option("--seed", metavar="N", type=int, **UNSET, help="of everything random (default: 0)"),
    ),
    group(
        "anchors and TDOAs",
        exclusive(
            option(
                "--constellation",
                metavar="NAME",
                **UNSET,
                help=(
                    f"{', '.join(CONSTELLATIONS)}, random-SEED or random-SEED-COUNT "
                    "(default: corners; rover: six_wide)"
                ),
            ),
            option(
                "--anchors",
                metavar="FILE.yaml",
                type=Path,
                help="your own anchors, with orientations",
            ),
        ),
        option("--protocol", choices=PROTOCOLS, **UNSET, help="(default: tdoa2; rover: tdoa3)"),
        option(
            "--tdoa-rate",
            metavar="HZ",
            **NUMBER,
            help="TDOAs per second (default: that of the protocol; rover: 100)",
        ),
        option(
            "--radio-reach",
            metavar="M",
            type=float,
            help="anchors farther from the tag than that are not heard (default: all are)",
        ),
        option(
            "--walls",
            metavar="FILE.yaml",
            type=Path,
            help=(
                "no signal comes through these: walls: [[x0, y0, x1, y1], ...], m, with a height or "
                "without"
            ),
        ),
        option(
            "--cell-ids",
            metavar="N",
            type=int,
            help="cells with clocks of their own: TDOAs only between anchors with the same id // N",
        ),
        option(
            "--noise",
            dest="noise_std",
            metavar="M",
            **NUMBER,
            help="standard deviation, m (default: 0.06)",
        ),
        option(
            "--shared-noise",
            action="store_true",
            help="TDOAs made from the same reception share its noise",
        ),
        option(
            "--no-outliers",
            dest="outlier_probability",
            action="store_const",
            const=0.0,
            **UNSET,
            help="otherwise 1 %% of the TDOAs are",
        ),
        option(
            "--no-bias",
            dest="bias",
            action="store_false",
            help="no error of antennas, received power and anchor delays",
        ),
        option(
            "--no-multipath",
            dest="multipath",
            action="store_false",
            help="no late arrivals near the floor",
        ),
    ),
    group(
        "inertial sensor",
        option(
            "--imu-rate",
            metavar="HZ",
            **NUMBER,
            help="samples per second (default: 1000; rover and hand: 100)",
        ),
        exclusive(
            option("--perfect-imu", action="store_true", help="no noise and no bias"),
            option(
                "--vibration",
                metavar="M/S2",
                type=float,
                default=0.0,
                help="noise of motors (default: 0)",
            ),
        ),
    ),
    group(
        "what else the vehicle feels, with white noise of this standard deviation",
        *(
            option(
                f"--{name.replace('_', '-')}-noise",
                metavar=sensor.noise[0],
                **NUMBER,
                help=sensor.noise[1],
            )
            for name, sensor in SENSORS.items()
        ),
    ),
)


def config_of(args: Namespace) -> SimulationConfig:
    """Return the SimulationConfig of the options; most have the names of its fields."""
    from uwb_tdoa_bias.common.survey import read_survey

    from ..readers.tables import read_numbers
    from ..simulation.config import NO_IMU_ERRORS, ImuErrors, SimulationConfig, Walls

    values = {
        field.name: getattr(args, field.name)
        for field in fields(SimulationConfig)
        if hasattr(args, field.name)
    }
    values["poses"] = (
        None if args.poses is None else tuple(map(tuple, read_numbers(args.poses, POSE).tolist()))
    )
    values["walls"] = None if args.walls is None else Walls.from_yaml(args.walls)
    values["anchors"] = None if args.anchors is None else read_survey(args.anchors)
    values["imu_errors"] = (
        NO_IMU_ERRORS if args.perfect_imu else ImuErrors(vibration=args.vibration)
    )
    return SimulationConfig.of(**values)


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "simulate",
        (
            "Simulate a quadrotor, a rover or a person with a UWB tag among fixed anchors, and "
            "write it as a ROS 2 bag."
        ),
        "simulate --out flight_bag",
        (
            "simulate --trajectory circle --protocol tdoa3 --height-noise 0.01 --seed 7 --out "
            "circle_bag"
        ),
        "simulate --vehicle rover --duration 90 --out rover_bag",
        'simulate --vehicle hand --path "-2,-3 2,-3 2,3 -2,3" --out walk_bag',
        "simulate --constellation random-12-16 --duration 120 --out unseen_bag --json unseen.json",
        (
            "simulate --anchors hall.yaml --radio-reach 18 --protocol tdoa3 --duration 300 --out "
            "hall_bag"
        ),
        (
            "simulate --anchors hall.yaml --radio-reach 18 --walls walls.yaml --cell-ids 256 "
            "--protocol tdoa3 --out cells_bag"
        ),
        "simulate --no-bias --no-multipath --no-outliers --noise 0 --perfect-imu --out exact_bag",
        options=[
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
            *OPTIONS,
        ],
    )


def _simulate(args: Namespace) -> None:
    from ..bags.bag import check_output, write_bag
    from ..simulation import simulate

    if args.out is not None:
        check_output(args.out, args.force)  # before the work, not after it
    with cli.Progress("simulate", what="flying"):
        flight = simulate(config_of(args))
        content = _summary(flight)
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
        with cli.Progress("simulate", what="writing"):
            write_bag(flight, args.out, args.storage, args.force)
        cli.show(f"wrote {args.out}")
    if args.json is not None:
        cli.write_json(args.json, content)
        cli.show(f"wrote {args.json}")


def _summary(flight: Flight) -> dict[str, Any]:
    """Return plain values for JSON: counts, sizes of the TDOA errors (m), config, true parameters."""
    assert flight.imu is not None and flight.truth is not None
    parts = flight.extra["tdoa_truth"]
    return {
        "flight": flight.name,
        "tdoas": len(flight.tdoa),
        "imu_samples": len(flight.imu),
        "poses": len(flight.truth),
        "outliers": int(parts["outlier"].sum()),
        **{f"{name}_std": float(parts[name].std()) for name in ("bias", "multipath", "noise")},
        "config": flight.meta["config"],
        "parameters": flight.meta["parameters"],
    }


main = cli.executable(_simulate, parser)
