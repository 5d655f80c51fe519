# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""warehouse: judge starts in halls, slow tags, anchors in a plane, and a walk of ten minutes.

Measure the cost of a tag by the number of installed anchors.
"""

from flights import position_at
from halls import DELAY, HALLS, HEIGHT, RATE, fly, hall, room, walk
import numpy as np
from scipy.spatial import cKDTree
from warehouse_judge import after_gaps, cost, judge

from uwb_tdoa_ekf.core.config import FilterConfig

INSTALLED = 20, 100, 1000, 10_000  # anchors
LARGE = 0.5  # m
# m, deviations beyond which an estimate is wrong and certain, and s in which it is right again
WRONG, CERTAIN, AGAIN = (1.0, 5.0, 2.0)


def bound(where, seed, duration=20.0):
    """Lower bound (3,) m of the error along each axis due to antenna delays, which do not average
    out. It is the root mean square along the path from 10 s on.
    """
    rng = np.random.default_rng([seed, 5])  # as `fly` walks
    places = walk(where.size, duration, rng, 1.5)[0][int(10.0 * RATE) :: int(0.5 * RATE)]
    tree, out = cKDTree(where.anchors.positions), []
    for p in np.column_stack([places, np.full(len(places), HEIGHT)]):
        towards = where.anchors.positions[tree.query_ball_point(p, where.reach)] - p
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        off = towards - towards.mean(axis=0)  # what they have in common is the clock's
        out.append(np.diag(np.linalg.inv(off.T @ off)) * DELAY**2)
    return np.sqrt(np.mean(out, axis=0))


def say_bounds(starts, word):
    """A row for each run in a hall whose bound is above LARGE: RMSE; errors, stated deviations and
    bounds along the axes; NEES.
    """
    print("| hall, seed | RMSE | errors | stated | bound | NEES |\n|---|---:|---|---|---|---:|")
    for name in (name for name in HALLS if word in name):
        where = hall(name)
        for seed in (seed for seed in range(starts) if np.linalg.norm(bound(where, seed)) > LARGE):
            flight = fly(where, seed)
            found = judge(flight, FilterConfig())
            late = found["odometry"].t - flight.tdoa.t[0] >= 10.0
            error = found["odometry"].x[late, :3] - position_at(flight, found["odometry"].t[late])
            stated = np.diagonal(found["odometry"].covariance[late, :3, :3], axis1=1, axis2=2)
            each = (
                np.sqrt(np.mean(error**2, axis=0)),
                np.sqrt(np.mean(stated, axis=0)),
                bound(where, seed),
            )
            columns = " | ".join(", ".join(f"{value:.2f}" for value in values) for values in each)
            print(
                f"| {name}, {seed} | {found['rmse']:.2f} | {columns} | {found['nees']:.1f} |",
                flush=True,
            )


def say(name, runs):
    """A row: right within 1 m at 2 s; RMSE, median and largest; NEES, mean and largest; start,
    largest; TDOAs and stamps spent, most.
    """
    column = {
        key: np.array([run[key] for run in runs], float)
        for key in ("at_2", "rmse", "nees", "start", "spent", "stamps")
    }
    started = np.isfinite(column["start"])
    print(
        f"| {name} | {started.sum()} of {len(runs)} | {np.sum(column['at_2'] < 1.0)} | "
        f"{np.median(column['rmse']):.2f} | {column['rmse'].max():.2f} | "
        f"{column['nees'].mean():.1f} | {column['nees'].max():.1f} | "
        f"{column['start'].max():.1f} | {column['spent'].max():.0f} | "
        f"{column['stamps'].max():.0f} |",
        flush=True,
    )


def say_walks(name, where, seeds, config):
    """Print the worst figures of walks of ten minutes with three dead zones and a change of floor.

    Also prints a line for each walk that misses the requirement.
    """
    worst, sure, wrong, nees = [], [], [], []
    for seed in seeds:
        flight = fly(
            where, seed, 600.0, dead=[(120.0, 133.3), (220.0, 233.3), (450.0, 463.3)], lift=300.0
        )
        found = judge(flight, config)
        deviations, gaps = found["off"] / found["std"], after_gaps(flight, found)
        worst.append(float(deviations.max()))
        sure.append(
            float(
                np.sum((found["off"] > WRONG) & (deviations > CERTAIN))
                * np.median(np.diff(found["odometry"].t))
            )
        )
        wrong.append(max(gaps)), nees.append(found["nees"])
        if sure[-1] or wrong[-1] > AGAIN:
            after = ", ".join(f"{gap:.2f}" for gap in gaps)
            print(
                (
                    f"{name}, seed {seed}: wrong and certain for {sure[-1]:.2f} s, wrong after "
                    f"silences for {after} s"
                ),
                flush=True,
            )
    print(
        f"{name}, {len(seeds)} seeds: NEES {np.mean(nees):.2f}, at most {max(nees):.2f}; "
        f"largest error {max(worst):.1f} deviations; wrong and certain in "
        f"{np.count_nonzero(sure)}; wrong after silences for {max(wrong):.2f} s at most",
        flush=True,
    )


def say_costs():
    """A row for each number of installed anchors."""
    cost(20, 5.0, 1)  # what is compiled, is
    print(
        "| installed | of a core | over that of 20 | memory of a tag, MB | start, s "
        "|\n|---:|---:|---:|---:|---:|"
    )
    least = None
    for n in INSTALLED:
        share, memory, start, _ = cost(n)
        least = least or share
        print(
            f"| {n} | {share:.4f} | {share / least:.2f} | {memory / 1e6:.1f} | {start:.2f} |",
            flush=True,
        )


def add_options(add):
    """The options of the study."""
    add("--starts", type=int, default=100, metavar="N", help="in each hall (default: %(default)s)")
    seeds = "of each row in the room (default: %(default)s)"
    add("--seeds", type=int, default=20, metavar="N", help=seeds)
    first = "seed of the walks of ten minutes (default: %(default)s)"
    add("--first", type=int, default=0, metavar="N", help=first)
    add("--only", default="", metavar="WORD", help="rows with this in their name")
    bounds = "instead: errors along the axes of the runs in halls where no estimate can be good"
    add("--bound", action="store_true", help=bounds)
    add("--cost", action="store_true", help="instead: what a tag costs")


def run(args):
    """Print the rows whose names have a word in them."""
    if args.cost:
        say_costs()
        return
    if args.bound:
        say_bounds(args.starts, args.only)
        return
    print(
        "| where | started | right at 2 s | RMSE, m, median | largest | NEES, mean | largest "
        "| start, s, latest | TDOAs spent | stamps |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    with_imu, without = FilterConfig(), FilterConfig(use_imu=False)
    rows = [(name, args.starts, lambda n=name: hall(n), {}, with_imu) for name in HALLS]
    first = next(iter(HALLS))
    rows += [(f"{first}, no IMU", args.starts, lambda: hall(first), {}, without)]
    rows += [
        (f"{first}, no IMU, 20 TDOAs/s", args.starts, lambda: hall(first), {"rate": 20.0}, without)
    ]
    slow = {"duration": 40.0, "speed": 1.0}
    for imu, config in (("", with_imu), (", no IMU", without)):
        for rate in (1.0, 2.0, 5.0, 10.0, 20.0):
            rows.append(
                (
                    f"room, {rate:g} TDOAs/s{imu}",
                    args.seeds,
                    lambda: room("corners"),
                    slow | {"rate": rate},
                    config,
                )
            )
        for blinks in (0.5, 1.0, 2.0, 5.0):
            rows.append(
                (
                    f"room, {blinks:g} blinks/s{imu}",
                    args.seeds,
                    lambda: room("corners"),
                    slow | {"blinks": blinks},
                    config,
                )
            )
        for name in ("ceiling, 4", "ceiling, 8", "wall, 8", "line, 5"):
            rows.append((f"room, {name}{imu}", args.seeds, lambda n=name: room(n), slow, config))
    for name, side in (("ceiling, 4", "below"), ("ceiling, 8", "below"), ("wall, 8", "+x")):
        rows.append(
            (
                f"room, {name}, tag_side {side}",
                args.seeds,
                lambda n=name: room(n),
                slow,
                FilterConfig(tag_side=side),
            )
        )
    for name, count, make, kind, config in rows:
        if args.only in name:
            where = make()
            say(name, [judge(fly(where, seed, **kind), config) for seed in range(count)])
    for imu, config in (("", with_imu), (", no IMU", without)):
        if args.only in (name := f"ten minutes{imu}"):
            say_walks(
                name, hall(first, floors=2), range(args.first, args.first + args.seeds), config
            )
