"""simulate: fly a path through a room with anchors and write what IMU, UWB tag and motion capture would record."""

import inspect
import json
import sys
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..simulation import NO_IMU_ERRORS, ImuErrors, SimulationConfig, simulate
from ..simulation.config import YAW_PROFILES
from ..simulation.constellations import CONSTELLATIONS, constellation
from ..simulation.schedule import PROTOCOLS
from ..simulation.trajectories import TRAJECTORIES

PLOT_SUFFIXES = (".png", ".pdf", ".svg")


def main(argv=None):
    """The executable. Returns the exit code."""
    return cli.run(_simulate, _parser(), argv)


def _parser():
    default = SimulationConfig()
    parser = cli.parser(
        "simulate",
        "Simulate a flight of a quadrotor with a UWB tag among fixed anchors, and write it as a ROS 2 bag.",
        "simulate --out flight.bag",
        "simulate --trajectory circle --protocol tdoa3 --seed 7 --out circle.bag --plot circle.png",
        "simulate --constellation random-12-16 --duration 120 --out unseen.bag --json unseen.json",
        "simulate --no-bias --no-multipath --no-outliers --noise 0 --perfect-imu --out exact.bag",
        "simulate --list",
    )
    add = parser.add_argument
    add("--list", action="store_true", help="list trajectories and constellations, and do nothing else")
    add("--out", metavar="BAG", type=Path, help="the bag to write: a new directory; without it, nothing is written")
    add("--storage", choices=("mcap", "sqlite3"), default="mcap", help="kind of bag (default: mcap)")
    add("--force", action="store_true", help="replace an existing bag")
    add("--json", metavar="FILE", type=Path, help="write the configuration, the true parameters and the counts")
    add("--plot", metavar="FILE", type=Path, help="draw the path and the errors of the TDOAs")

    flight = parser.add_argument_group("flight")
    add = flight.add_argument
    add("--trajectory", choices=TRAJECTORIES, default=default.trajectory, help=f"(default: {default.trajectory})")
    add("--duration", metavar="S", type=float, default=default.duration, help="of the recording, s (default: 60)")
    add("--speed", metavar="M/S", type=float, default=default.speed, help="at cruise, m/s (default: 1)")
    add("--height", metavar="M", type=float, help="of the path, m (default: half the height that is flyable)")
    add("--yaw", choices=YAW_PROFILES, default=default.yaw, help="(default: fixed; spin always rotates)")
    add("--start-in-air", action="store_true", help="leave out take-off and landing")
    add("--seed", metavar="N", type=int, default=default.seed, help="of everything random (default: 0)")

    radio = parser.add_argument_group("anchors and TDOAs")
    room = radio.add_mutually_exclusive_group()
    name = "name, random-SEED or random-SEED-COUNT (default: corners)"
    room.add_argument("--constellation", metavar="NAME", default=default.constellation, help=name)
    room.add_argument("--anchors", metavar="FILE.yaml", type=Path, help="your own anchors, with orientations")
    add = radio.add_argument
    add("--protocol", choices=PROTOCOLS, default=default.protocol, help="(default: tdoa2)")
    add("--noise", metavar="M", type=float, default=default.noise_std, help="standard deviation, m (default: 0.06)")
    add("--shared-noise", action="store_true", help="TDOAs made from the same reception share its noise")
    add("--no-outliers", action="store_true", help=f"otherwise {default.outlier_probability:.0%} of the TDOAs are")
    add("--no-bias", action="store_true", help="no error of antennas, received power and anchor delays")
    add("--no-multipath", action="store_true", help="no late arrivals near the floor")

    imu = parser.add_argument_group("inertial sensor").add_mutually_exclusive_group()
    imu.add_argument("--perfect-imu", action="store_true", help="no noise and no bias")
    imu.add_argument("--vibration", metavar="M/S2", type=float, default=0.0, help="noise of motors (default: 0)")
    return parser


def _simulate(args):
    if args.list:
        print(_catalogue())
        return 0
    if args.out is not None:
        from ..bags.bag import check_output, write_bag

        check_output(args.out, args.force)  # before the work, not after it
    if args.plot is not None and args.plot.suffix.lower() not in PLOT_SUFFIXES:
        raise InputError(f"plot: {args.plot} is no image file; choose one of {', '.join(PLOT_SUFFIXES)}.")
    for path in (args.json, args.plot):
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"{path}: its directory does not exist; make it first.")
    flight = simulate(
        SimulationConfig(
            seed=args.seed,
            constellation=args.constellation,
            anchors=None if args.anchors is None else Anchors.from_yaml(args.anchors),
            trajectory=args.trajectory,
            duration=args.duration,
            speed=args.speed,
            height=args.height,
            yaw=args.yaw,
            start_in_air=args.start_in_air,
            imu_errors=NO_IMU_ERRORS if args.perfect_imu else ImuErrors(vibration=args.vibration),
            protocol=args.protocol,
            noise_std=args.noise,
            shared_noise=args.shared_noise,
            bias=not args.no_bias,
            multipath=not args.no_multipath,
            outlier_probability=0.0 if args.no_outliers else SimulationConfig.outlier_probability,
        )
    )
    content = summary(flight)
    print(f"{flight.name}: {content['tdoas']} TDOAs, {content['imu_samples']} IMU samples, {content['poses']} poses")
    print(
        f"errors of the TDOAs, standard deviation: bias {content['bias_std']:.3f} m, "
        f"multipath {content['multipath_std']:.3f} m, noise {content['noise_std']:.3f} m; "
        f"{content['outliers']} outliers"
    )
    if args.out is not None:
        write_bag(flight, args.out, args.storage, args.force)
        print(f"wrote {args.out}")
    if args.json is not None:
        args.json.write_text(json.dumps(content, indent=2) + "\n")
        print(f"wrote {args.json}")
    if args.plot is not None:
        plot(flight, args.plot)
        print(f"wrote {args.plot}")
    return 0


def summary(flight):
    """What --json writes: name, counts, sizes of the parts of the TDOA errors (m), configuration, true parameters."""
    parts = flight.extra["tdoa_truth"]
    return {
        "flight": flight.name,
        "tdoas": len(flight.tdoa),
        "imu_samples": len(flight.imu),
        "poses": len(flight.truth),
        "outliers": int(np.count_nonzero(parts["outlier"])),
        **{f"{name}_std": float(np.std(parts[name])) for name in ("bias", "multipath", "noise")},
        "config": flight.meta["config"],
        "parameters": flight.meta["parameters"],
    }


def plot(flight, path):
    """Draw path and anchors from above, height, and the bias and full error of the TDOAs, to an image file."""
    from matplotlib.figure import Figure

    parts, truth, tdoa = flight.extra["tdoa_truth"], flight.truth, flight.tdoa
    figure = Figure(figsize=(12, 7), layout="constrained")
    figure.suptitle(flight.name)
    (above, height), (bias, error) = figure.subplots(2, 2)
    above.plot(truth.p[:, 0], truth.p[:, 1])
    above.plot(*flight.anchors.positions[:, :2].T, "k^")
    feet, foot = np.unique(flight.anchors.positions[:, :2], axis=0, return_inverse=True)
    for k, at in enumerate(feet):
        ids = ", ".join(str(anchor) for anchor in flight.anchors.ids[foot.ravel() == k])
        above.annotate(ids, at, xytext=(4, 4), textcoords="offset points")
    above.margins(0.15)
    above.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    height.plot(truth.t, truth.p[:, 2])
    height.set(xlabel="t, s", ylabel="height, m")
    pairs, count = np.unique(np.column_stack([tdoa.a, tdoa.b]), axis=0, return_counts=True)
    for a, b in pairs[np.sort(np.argsort(-count, kind="stable")[:6])]:
        rows = (tdoa.a == a) & (tdoa.b == b)
        bias.plot(parts["t"][rows], parts["bias"][rows], label=f"{a} - {b}")
    bias.legend(ncols=3, fontsize="small")
    bias.set(xlabel="t, s", ylabel="bias, m")
    total = parts["bias"] + parts["multipath"] + parts["noise"] + parts["outlier"]
    error.plot(parts["t"], total, ".", markersize=1)
    error.set(xlabel="t, s", ylabel="error of TDOA, m", ylim=(-1, 1))
    figure.savefig(path, dpi=120)


def _catalogue():
    lines = ["trajectories:"]
    for name, family in TRAJECTORIES.items():
        text = "Stay at the place, the yaw rotating." if name == "spin" else inspect.getdoc(family).splitlines()[0]
        lines.append(f"  {name:<14} {text}")
    lines.append("constellations:")
    for name in CONSTELLATIONS:
        anchors = constellation(name)
        x, y, z = np.ptp(anchors.positions, axis=0)
        lines.append(f"  {name:<14} {len(anchors)} anchors, {x:.1f} x {y:.1f} x {z:.1f} m apart")
    lines.append("  random-SEED[-COUNT]: COUNT anchors (4 - 64, default 8) in a seeded room")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
