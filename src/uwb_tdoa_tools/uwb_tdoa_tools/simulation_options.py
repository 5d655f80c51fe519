# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Options of the command `simulate`, and the SimulationConfig that they give."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.common.sensors import SENSORS

from .choices import CARRIERS, PROTOCOLS, TRAJECTORIES, YAW_PROFILES

if TYPE_CHECKING:
    from .simulation.config import SimulationConfig

POSE = "t", "x", "y", "z", "yaw"  # columns of --poses


def add_options(made: argparse.ArgumentParser) -> None:
    """Add the options to a parser."""
    # not given: the usual value of the vehicle
    unless: dict[str, Any] = {"default": argparse.SUPPRESS}
    made_path = made.add_argument_group("motion")
    add = made_path.add_argument
    words = (
        "what carries the tag, with its usual sensors: quadrotor; rover: drives on the floor, "
        "with wheels; hand: a person walks"
    )
    add(
        "--vehicle",
        choices=CARRIERS,
        default="quadrotor",
        help=f"{words} (default: quadrotor)",
    )
    path = made_path.add_mutually_exclusive_group()
    path.add_argument("--trajectory", choices=TRAJECTORIES, **unless, help="(default: sines)")
    path.add_argument(
        "--path",
        metavar="'X,Y X,Y ...'",
        type=_points,
        **unless,
        help="waypoints, m, or X,Y,Z, again and again",
    )
    path.add_argument(
        "--poses",
        metavar="FILE",
        type=Path,
        help="timed path, CSV with columns t, x, y, z, yaw, s, m and rad, e.g. next_flight.csv of "
        "diagnose",
    )
    add(
        "--area",
        metavar="'X,Y X,Y'",
        type=_points,
        **unless,
        help="lower and upper corner of a trajectory, m (default: of the room)",
    )
    add(
        "--duration",
        metavar="S",
        type=float,
        **unless,
        help="of the recording, s (default: 60)",
    )
    add(
        "--speed",
        metavar="M/S",
        type=float,
        **unless,
        help="at cruise, m/s (default: 1; rover: 0.8)",
    )
    add(
        "--height",
        metavar="M",
        type=float,
        **unless,
        help="of the path, m (default: half the height that is flyable; hand: 1.1)",
    )
    add(
        "--yaw",
        choices=YAW_PROFILES,
        **unless,
        help="(default: fixed; hand: along_track; spin always rotates; a rover has no choice)",
    )
    add("--start-in-air", action="store_true", help="leave out take-off and landing of a quadrotor")
    add(
        "--tag-lever-arm",
        metavar="X,Y,Z",
        type=_point,
        **unless,
        help="antenna in the body, m (default: 0,0,0; rover: 0.1,0,0.4)",
    )
    add(
        "--wheel-scale",
        metavar="X",
        type=float,
        **unless,
        help="share by which wheels of a rover say too much (default: 0.02)",
    )
    add(
        "--wheel-slip",
        metavar="X",
        type=float,
        **unless,
        help="the same while they slip, half a second every ten (default: 0.2)",
    )
    add(
        "--seed",
        metavar="N",
        type=int,
        **unless,
        help="of everything random (default: 0)",
    )

    radio = made.add_argument_group("anchors and TDOAs")
    room = radio.add_mutually_exclusive_group()
    name = "name, random-SEED or random-SEED-COUNT (default: corners; rover: six_wide)"
    room.add_argument("--constellation", metavar="NAME", **unless, help=name)
    room.add_argument(
        "--anchors", metavar="FILE.yaml", type=Path, help="your own anchors, with orientations"
    )
    add = radio.add_argument
    off: dict[str, Any] = {"action": "store_false"}
    add("--protocol", choices=PROTOCOLS, **unless, help="(default: tdoa2; rover: tdoa3)")
    add(
        "--tdoa-rate",
        metavar="HZ",
        type=float,
        **unless,
        help="TDOAs per second (default: that of the protocol; rover: 100)",
    )
    add(
        "--radio-reach",
        metavar="M",
        type=float,
        help="anchors farther from the tag than that are not heard (default: all are)",
    )
    add(
        "--walls",
        metavar="FILE.yaml",
        type=Path,
        help=(
            "no signal comes through these: walls: [[x0, y0, x1, y1], ...], m, with a height or "
            "without"
        ),
    )
    add(
        "--cell-ids",
        metavar="N",
        type=int,
        help="cells with clocks of their own: TDOAs only between anchors with the same id // N",
    )
    add(
        "--noise",
        dest="noise_std",
        metavar="M",
        type=float,
        **unless,
        help="standard deviation, m (default: 0.06)",
    )
    add(
        "--shared-noise",
        action="store_true",
        help="TDOAs made from the same reception share its noise",
    )
    add(
        "--no-outliers",
        dest="outlier_probability",
        action="store_const",
        const=0.0,
        **unless,
        help="otherwise 1 %% of the TDOAs are",
    )
    add(
        "--no-bias",
        dest="bias",
        **off,
        help="no error of antennas, received power and anchor delays",
    )
    add("--no-multipath", dest="multipath", **off, help="no late arrivals near the floor")

    group = made.add_argument_group("inertial sensor")
    group.add_argument(
        "--imu-rate",
        metavar="HZ",
        type=float,
        **unless,
        help="samples per second (default: 1000; rover and hand: 100)",
    )
    imu = group.add_mutually_exclusive_group()
    imu.add_argument("--perfect-imu", action="store_true", help="no noise and no bias")
    imu.add_argument(
        "--vibration", metavar="M/S2", type=float, default=0.0, help="noise of motors (default: 0)"
    )

    add = made.add_argument_group(
        "what else the vehicle feels, with white noise of this standard deviation"
    ).add_argument
    for name, sensor in SENSORS.items():
        unit, words, _ = sensor.noise
        option = f"--{name.replace('_', '-')}-noise"
        add(option, metavar=unit, type=float, **unless, help=words)


def config_of(args: argparse.Namespace) -> SimulationConfig:
    """Return the SimulationConfig of the options; most have the names of its fields."""
    from uwb_tdoa_bias.common.survey import read_survey, refuse_faulty

    from .readers.tables import read_numbers
    from .simulation.config import NO_IMU_ERRORS, ImuErrors, SimulationConfig
    from .simulation.rooms import Walls

    values = {
        field.name: getattr(args, field.name)
        for field in fields(SimulationConfig)
        if hasattr(args, field.name)
    }
    values["poses"] = (
        None if args.poses is None else tuple(map(tuple, read_numbers(args.poses, POSE).tolist()))
    )
    values["walls"] = None if args.walls is None else Walls.from_yaml(args.walls)
    values["anchors"] = (
        None
        if args.anchors is None
        else refuse_faulty(read_survey(args.anchors), str(args.anchors))
    )
    values["imu_errors"] = (
        NO_IMU_ERRORS if args.perfect_imu else ImuErrors(vibration=args.vibration)
    )
    return SimulationConfig.of(**values)


def _points(text: str) -> tuple[tuple[float, ...], ...]:
    """Parse "X,Y X,Y ..."."""
    return tuple(_point(each) for each in text.split())


def _point(text: str) -> tuple[float, ...]:
    """Parse "X,Y" or "X,Y,Z"."""
    try:
        return tuple(float(each) for each in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y or X,Y,Z in metres") from None
