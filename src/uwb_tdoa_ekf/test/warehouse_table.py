"""The tables of docs/warehouse.md: starts in halls, slow tags, anchors in a plane, a walk of ten
minutes.

python src/uwb_tdoa_ekf/test/warehouse_table.py [--starts N] [--seeds N] [--first N] [--only WORD]
[--bound]
"""

import argparse

from driving import drive, state_for
from flights import position_at
from halls import DELAY, HALLS, HEIGHT, RATE, fly, hall, room, walk
import numpy as np
from scipy.spatial import cKDTree

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.verdicts import STARTUP

LARGE = 0.5  # m
WRONG, CERTAIN, AGAIN = (
    1.0,
    5.0,
    2.0,
)  # m, deviations beyond which an estimate is wrong and certain, and s in which it is right again


def judge(flight, config):
    """Figures of one run. at_2 : m, error 2 s after the first TDOA, inf where there is no estimate;
    rmse : m, from 10 s on; nees : mean of the position, 3 where it is honest; start : s after the
    first TDOA; spent, stamps : TDOAs, and stamps of them, until then.
    """
    state = state_for(flight)
    odometry, residuals = drive(flight, config, state)
    began = residuals.verdict != STARTUP
    spent = int(np.argmax(began)) if began.any() else len(began)
    stamps = len(np.unique(flight.tdoa.t[: spent + 1]))
    if not len(odometry):
        return {
            "at_2": np.inf,
            "rmse": np.inf,
            "nees": np.inf,
            "start": np.inf,
            "spent": spent,
            "stamps": stamps,
            "odometry": None,
        }
    error = odometry.x[:, :3] - position_at(flight, odometry.t)
    off, covariance = np.linalg.norm(error, axis=1), odometry.covariance[:, :3, :3]
    since = odometry.t - flight.tdoa.t[0]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    return {
        "at_2": off[np.searchsorted(since, 2.0)] if since[-1] > 2.0 and since[0] < 2.0 else np.inf,
        "rmse": float(np.sqrt(np.mean(off[since >= 10.0] ** 2)))
        if (since >= 10.0).any()
        else np.nan,
        "nees": float(nees.mean()),
        "start": float(since[0]),
        "spent": spent,
        "stamps": stamps,
        "odometry": odometry,
        "off": off,
        "std": np.sqrt(np.trace(covariance, axis1=1, axis2=2)),
    }


def heard_at_start(flight, seconds=0.5):
    """Anchors in the TDOAs of the first seconds."""
    first = flight.tdoa.t < flight.tdoa.t[0] + seconds
    return len(np.unique(np.concatenate([flight.tdoa.a[first], flight.tdoa.b[first]])))


def after_gaps(flight, found, within=1.0, gap=1.0):
    """For each silence of more than `gap` s, how long after it the error was above `within` m last,
    s, of the 10 s that follow.
    """
    t, out = flight.tdoa.t, []
    for k in np.flatnonzero(np.diff(t) > gap):
        rows = (found["odometry"].t >= t[k + 1]) & (found["odometry"].t < t[k + 1] + 10.0)
        wrong = found["odometry"].t[rows & (found["off"] > within)]
        out.append(float(wrong.max() - t[k + 1]) if len(wrong) else 0.0)
    return out


def bound(where, seed, duration=20.0):
    """(3,) m, root mean square along the path from 10 s on of what delays of the anchors leave open
    at least, along each axis: they do not average out.
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
    """What is the worst in walks of ten minutes with three dead zones and a change of floor, and a
    line of each that is worse than asked.
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


def main():
    """Print the rows whose names have a word in them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--starts", type=int, default=100, metavar="N", help="in each hall (default: %(default)s)"
    )
    parser.add_argument(
        "--seeds",
        type=int,
        default=20,
        metavar="N",
        help="of each row in the room (default: %(default)s)",
    )
    parser.add_argument(
        "--first",
        type=int,
        default=0,
        metavar="N",
        help="seed of the walks of ten minutes (default: %(default)s)",
    )
    parser.add_argument("--only", default="", metavar="WORD", help="rows with this in their name")
    parser.add_argument(
        "--bound",
        action="store_true",
        help="instead: errors along the axes of the runs in halls where no estimate can be good",
    )
    args = parser.parse_args()
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


if __name__ == "__main__":
    main()
