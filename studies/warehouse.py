# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""warehouse: judge starts in halls, slow tags, anchors in a plane, and a walk of ten minutes.

Measure the cost of a tag by the number of installed anchors.
"""

from itertools import islice

from flights import position_at
from halls import DELAY, HALLS, HEIGHT, RATE, fly, hall, room, walk
import numpy as np
from scipy.spatial import cKDTree
from warehouse_judge import after_gaps, cost, judge

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import cli, parallel

from . import table

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


WITH_IMU, WITHOUT = FilterConfig(), FilterConfig(use_imu=False)
IMU = {"": WITH_IMU, ", no IMU": WITHOUT}
FIRST = next(iter(HALLS))
STARTS = {  # row in a hall: (its hall, options of `fly`, FilterConfig)
    **{name: (name, {}, WITH_IMU) for name in HALLS},
    f"{FIRST}, no IMU": (FIRST, {}, WITHOUT),
    f"{FIRST}, no IMU, 20 TDOAs/s": (FIRST, {"rate": 20.0}, WITHOUT),
}
SLOW = {"duration": 40.0, "speed": 1.0}
LAYOUTS = "ceiling, 4", "ceiling, 8", "wall, 8", "line, 5"


def _rows_in_the_room():
    """{row: (its room, options of `fly`, FilterConfig)}."""
    rows = {}
    for imu, config in IMU.items():
        for rate in (1.0, 2.0, 5.0, 10.0, 20.0):
            rows[f"room, {rate:g} TDOAs/s{imu}"] = "corners", SLOW | {"rate": rate}, config
        for blinks in (0.5, 1.0, 2.0, 5.0):
            rows[f"room, {blinks:g} blinks/s{imu}"] = "corners", SLOW | {"blinks": blinks}, config
        for name in LAYOUTS:
            rows[f"room, {name}{imu}"] = name, SLOW, config
    for name, side in (("ceiling, 4", "below"), ("ceiling, 8", "below"), ("wall, 8", "+x")):
        rows[f"room, {name}, tag_side {side}"] = name, SLOW, FilterConfig(tag_side=side)
    return rows


ROOMS = _rows_in_the_room()
WALKS = {f"ten minutes{imu}": config for imu, config in IMU.items()}


def add_options(add):
    """The options of the study."""
    words = "in each hall (default: %(default)s)"
    add("--starts", type=parallel.whole_number, default=100, metavar="N", help=words)
    bounds = "instead: errors along the axes of the runs in halls where no estimate can be good"
    add("--bound", action="store_true", help=bounds)
    add("--cost", action="store_true", help="instead: what a tag costs")
    table.add_options(add, draws=20)
    table.add_only(add)


def run(args):
    """Print the rows whose names have a word of --only in them."""
    if args.cost:
        show_costs()
        return
    if args.bound:
        show_bounds(args)
        return
    names = table.chosen(args, [*STARTS, *ROOMS, *WALKS])
    items = [(name, seed) for name in names for seed in _seeds(args, name)]
    done = table.results(judged, items, args, unit="run")
    columns = "started", "right at 2 s", "RMSE, m, median", "largest", "NEES, mean", "largest"
    cli.show(table.head("where", *columns, "start, s, latest", "TDOAs spent", "stamps"))
    for name in names:
        runs = list(islice(done, len(_seeds(args, name))))
        cli.show(*(of_walks(name, runs) if name in WALKS else [row(name, runs)]))


def _seeds(args, name):
    """The seeds of a row: --first is of walks, --starts of halls."""
    if name in WALKS:
        return table.seeds(args)
    return range(args.starts if name in STARTS else args.draws)


def judged(item):
    """Figures of a run (row, seed), see `row` and `of_walks`."""
    name, seed = item
    if name in WALKS:
        return walked(seed, WALKS[name])
    where, kind, config = (STARTS | ROOMS)[name]
    found = judge(fly((hall if name in STARTS else room)(where), seed, **kind), config)
    keys = "at_2", "rmse", "nees", "start", "spent", "stamps"
    return {key: float(found[key]) for key in keys}


def row(name, runs):
    """The row of a name: right within 1 m at 2 s; RMSE, median and largest; NEES, mean and largest;
    start, largest; TDOAs and stamps spent, most.
    """
    at_2, rmse, nees, start, spent, stamps = np.array([[*run.values()] for run in runs], float).T
    cells = [f"{np.isfinite(start).sum()} of {len(runs)}", np.sum(at_2 < 1.0)]
    cells += [f"{np.median(rmse):.2f}", f"{rmse.max():.2f}"]
    cells += [f"{nees.mean():.1f}", f"{nees.max():.1f}"]
    return table.line(
        [name, *cells, *(f"{start.max():.1f}", f"{spent.max():.0f}", f"{stamps.max():.0f}")]
    )


def walked(seed, config):
    """Figures of a walk of ten minutes with three dead zones and a change of floor."""
    dead = [(120.0, 133.3), (220.0, 233.3), (450.0, 463.3)]
    flight = fly(hall(FIRST, floors=2), seed, 600.0, dead=dead, lift=300.0)
    found = judge(flight, config)
    deviations = found["off"] / found["std"]
    step = np.median(np.diff(found["odometry"].t))
    return {
        "seed": seed,
        "nees": found["nees"],
        "worst": float(deviations.max()),
        "sure": float(np.sum((found["off"] > WRONG) & (deviations > CERTAIN)) * step),
        "gaps": [float(gap) for gap in after_gaps(flight, found)],
    }


def of_walks(name, runs):
    """Lines on walks: one for each that misses the requirement, and the worst figures of all."""
    lines = []
    for run in runs:
        if run["sure"] or max(run["gaps"]) > AGAIN:
            after = ", ".join(f"{gap:.2f}" for gap in run["gaps"])
            lines.append(
                f"{name}, seed {run['seed']}: wrong and certain for {run['sure']:.2f} s, wrong after "
                f"silences for {after} s"
            )
    nees = [run["nees"] for run in runs]
    lines.append(
        f"{name}, {len(runs)} seeds: NEES {np.mean(nees):.2f}, at most {max(nees):.2f}; "
        f"largest error {max(run['worst'] for run in runs):.1f} deviations; wrong and certain in "
        f"{sum(run['sure'] > 0.0 for run in runs)}; wrong after silences for "
        f"{max(max(run['gaps']) for run in runs):.2f} s at most"
    )
    return lines


def show_bounds(args):
    """A row for each run in a hall whose bound is above LARGE: RMSE; errors, stated deviations and
    bounds along the axes; NEES.
    """
    names = table.chosen(args, HALLS)
    items = [(name, seed) for name in names for seed in range(args.starts)]
    cli.show(table.head("hall, seed", "errors", "stated", "bound", "RMSE", "NEES", texts=4))
    for cells in table.results(_beside_bound, items, args, unit="run"):
        if cells:
            cli.show(table.line(cells))


def _beside_bound(item):
    """The cells of a row of `show_bounds`; none if a good estimate is possible."""
    name, seed = item
    where = hall(name)
    least = bound(where, seed)
    if np.linalg.norm(least) <= LARGE:
        return []
    flight = fly(where, seed)
    found = judge(flight, WITH_IMU)
    late = found["odometry"].t - flight.tdoa.t[0] >= 10.0
    error = found["odometry"].x[late, :3] - position_at(flight, found["odometry"].t[late])
    stated = np.diagonal(found["odometry"].covariance[late, :3, :3], axis1=1, axis2=2)
    each = np.sqrt(np.mean(error**2, axis=0)), np.sqrt(np.mean(stated, axis=0)), least
    columns = [", ".join(f"{value:.2f}" for value in values) for values in each]
    return [f"{name}, {seed}", *columns, f"{found['rmse']:.2f}", f"{found['nees']:.1f}"]


def show_costs():
    """A row for each number of installed anchors."""
    cost(20, 5.0, 1)  # what is compiled, is
    columns = "of a core", "over that of 20", "memory of a tag, MB", "start, s"
    cli.show(table.head("installed", *columns))
    least = None
    for n in INSTALLED:
        share, memory, start, _ = cost(n)
        least = least or share
        cells = f"{share:.4f}", f"{share / least:.2f}", f"{memory / 1e6:.1f}", f"{start:.2f}"
        cli.show(table.line([n, *cells]))
