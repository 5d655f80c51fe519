"""simulate: fly a path through a room with anchors and write what IMU, UWB tag and motion capture would record."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.sensors import SENSORS
from uwb_tdoa_bias.foundation.survey_faults import refuse_faulty

from .. import cli
from ..outputs import OutputBag, OutputFile
from ..bags.bag import check_output, write_bag
from ..bags.files import STORAGES
from ..progress import Progress
from ..simulation import NO_IMU_ERRORS, ImuErrors, SimulationConfig, simulate
from ..simulation.config import YAW_PROFILES
from ..simulation.plots import check_image, plot
from ..simulation.schedule import PROTOCOLS
from ..simulation.summary import catalogue, summary
from ..simulation.trajectories import TRAJECTORIES
from ..simulation.walls import Walls

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace


def parser() -> ArgumentParser:
    """Its options."""
    default = SimulationConfig()
    made = cli.parser(
        "simulate",
        "Simulate a flight of a quadrotor with a UWB tag among fixed anchors, and write it as a ROS 2 bag.",
        "simulate --out flight.bag",
        "simulate --trajectory circle --protocol tdoa3 --height-noise 0.01 --seed 7 --out circle.bag --plot circle.png",
        "simulate --constellation random-12-16 --duration 120 --out unseen.bag --json unseen.json",
        "simulate --anchors hall.yaml --radio-reach 18 --protocol tdoa3 --duration 300 --out hall.bag",
        "simulate --anchors hall.yaml --radio-reach 18 --walls walls.yaml --cell-ids 256 --protocol tdoa3 --out cells.bag",
        "simulate --no-bias --no-multipath --no-outliers --noise 0 --perfect-imu --out exact.bag",
        "simulate --list",
    )
    add = made.add_argument
    add("--list", action="store_true", help="list trajectories and constellations, and do nothing else")
    add("--out", metavar="BAG", type=OutputBag, help="the bag to write: a new directory; without it, nothing is written")
    add("--storage", choices=STORAGES, default="mcap", help="kind of bag (default: mcap)")
    add("--force", action="store_true", help="replace an existing bag")
    add("--json", metavar="FILE", type=OutputFile, help="write the configuration, the true parameters and the counts")
    add("--plot", metavar="FILE", type=OutputFile, help="draw the path and the errors of the TDOAs")

    add = made.add_argument_group("flight").add_argument
    add("--trajectory", choices=TRAJECTORIES, default=default.trajectory, help=f"(default: {default.trajectory})")
    add("--duration", metavar="S", type=float, default=default.duration, help="of the recording, s (default: 60)")
    add("--speed", metavar="M/S", type=float, default=default.speed, help="at cruise, m/s (default: 1)")
    add("--height", metavar="M", type=float, help="of the path, m (default: half the height that is flyable)")
    add("--yaw", choices=YAW_PROFILES, default=default.yaw, help="(default: fixed; spin always rotates)")
    add("--start-in-air", action="store_true", help="leave out take-off and landing")
    add("--seed", metavar="N", type=int, default=default.seed, help="of everything random (default: 0)")

    radio = made.add_argument_group("anchors and TDOAs")
    room = radio.add_mutually_exclusive_group()
    name = "name, random-SEED or random-SEED-COUNT (default: corners)"
    room.add_argument("--constellation", metavar="NAME", default=default.constellation, help=name)
    room.add_argument("--anchors", metavar="FILE.yaml", type=Path, help="your own anchors, with orientations")
    add, share = radio.add_argument, default.outlier_probability
    off: dict[str, Any] = {"action": "store_false"}
    add("--protocol", choices=PROTOCOLS, default=default.protocol, help="(default: tdoa2)")
    add("--radio-reach", metavar="M", type=float, help="anchors farther from the tag than that are not heard (default: all are)")
    add("--walls", metavar="FILE.yaml", type=Path, help="no signal comes through these: walls: [[x0, y0, x1, y1], ...], m, with a height or without")
    add("--cell-ids", metavar="N", type=int, help="cells with clocks of their own: TDOAs only between anchors with the same id // N")
    add("--noise", dest="noise_std", metavar="M", type=float, default=default.noise_std, help="standard deviation, m (default: 0.06)")
    add("--shared-noise", action="store_true", help="TDOAs made from the same reception share its noise")
    add(
        "--no-outliers", dest="outlier_probability", action="store_const", const=0.0, default=share,
        help=f"otherwise {100.0 * share:g} %% of the TDOAs are",
    )  # fmt: skip
    add("--no-bias", dest="bias", **off, help="no error of antennas, received power and anchor delays")
    add("--no-multipath", dest="multipath", **off, help="no late arrivals near the floor")

    imu = made.add_argument_group("inertial sensor").add_mutually_exclusive_group()
    imu.add_argument("--perfect-imu", action="store_true", help="no noise and no bias")
    imu.add_argument("--vibration", metavar="M/S2", type=float, default=0.0, help="noise of motors (default: 0)")

    add = made.add_argument_group("what else the vehicle feels, with white noise of this standard deviation").add_argument
    for name, sensor in SENSORS.items():
        unit, words = sensor.noise
        add(f"--{name}-noise", metavar=unit, type=float, help=words)
    return made


def _simulate(args: Namespace) -> None:
    if args.list:
        cli.show(catalogue())
        return
    if args.out is not None:
        check_output(args.out, args.force)  # before the work, not after it
    check_image(args.plot)
    with Progress("simulate") as progress:
        progress("flying")
        flight = simulate(_config(args))
        content = summary(flight)
    cli.show(f"{flight.name}: {content['tdoas']} TDOAs, {content['imu_samples']} IMU samples, {content['poses']} poses")
    cli.show(
        f"errors of the TDOAs, standard deviation: bias {content['bias_std']:.3f} m, "
        f"multipath {content['multipath_std']:.3f} m, noise {content['noise_std']:.3f} m; "
        f"{content['outliers']} outliers"
    )
    if args.out is not None:
        with Progress("simulate") as progress:
            progress("writing")
            write_bag(flight, args.out, args.storage, args.force)
        cli.show(f"wrote {args.out}")
    if args.json is not None:
        cli.write_json(args.json, content)
        cli.show(f"wrote {args.json}")
    if args.plot is not None:
        plot(flight, args.plot)
        cli.show(f"wrote {args.plot}")


def _config(args: Namespace) -> SimulationConfig:
    """SimulationConfig of the options, most of which have the names of its fields."""
    values = {field.name: getattr(args, field.name) for field in fields(SimulationConfig) if hasattr(args, field.name)}
    values["walls"] = None if args.walls is None else Walls.from_yaml(args.walls)
    values["anchors"] = None if args.anchors is None else refuse_faulty(Anchors.from_yaml(args.anchors), str(args.anchors))
    values["imu_errors"] = NO_IMU_ERRORS if args.perfect_imu else ImuErrors(vibration=args.vibration)
    return SimulationConfig(**values)


main = cli.executable(_simulate, parser)

if __name__ == "__main__":
    sys.exit(main())
