# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""situations: simulate situations of a tag over many seeds, and judge the accuracy and the
consistency of the filter.

The filter has default parameters and no correction, and starts where the recording begins. Unless a
situation changes it, there are 8 anchors in 7 x 8 x 3 m. Noise, outliers, antenna delays, received
power and late arrivals near the floor are as in `simulate`. Half of the seeds use TDOA2, half
TDOA3. Each row judges one stretch of its recordings, all seeds together.
"""

from dataclasses import dataclass, field, replace
from functools import partial
import math

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.cli import as_json
from uwb_tdoa_tools.scoring.metrics import READY, Score, pooled_errors
from uwb_tdoa_tools.simulation import ImuErrors, SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import corners, facing

from . import table
from .any_path import Path, between

# m: an estimate that is off by less for so many seconds, or to the end, is right again
RIGHT, FOR = (0.5, 2.0)
FLYING = ImuErrors(vibration=1.0)
REST = 0.03  # m, of a tag on its vehicle on the floor
# m: anchors below LOW are late by LATE for a tag below FADES[0], and not late above FADES[1]
LATE, LOW, FADES = (3.2, 0.5, (0.06, 0.2))
SHADOW, BEHIND = 0.4, 0.5  # m later is an anchor behind a person; cosine beyond which it is
WALL = 3.5  # m, x of the wall of the room
MARGIN = FilterConfig().workspace_margin


@dataclass(frozen=True)
class Situation:
    """One row.

    make : function of a Generator and a dict for SimulationConfig that returns a Flight
    judged : (begin, end) s
    over : s at which the disturbance ends. The time to be right again counts from here; None: from
        the 100th TDOA.
    config : of the filter
    """

    name: str
    make: object
    judged: tuple
    over: float | None = None
    config: dict = field(default_factory=dict)


def add_options(add):
    """The options of the study."""
    table.add_options(add, draws=20)
    table.add_only(add)


def run(args):
    """Simulate, and print the table."""
    names = table.chosen(args, [one.name for one in SITUATIONS])
    cli.show(table.head("situation", *COLUMNS.values()))
    for name, results in table.trials(measure, names, args):
        cli.show(row(name, figures(results)))


def measure(item):
    """{"figures", "again"} of (name, seed).

    figures : of the judged stretch, as in `scoring.by_phase.ErrorSeries`, null where there are none
    again : s until the filter is right again, null for never
    """
    name, seed = item
    (situation,) = [one for one in SITUATIONS if one.name == name]
    common = {
        "seed": seed,
        "imu_rate": 500.0,
        "truth_rate": 100.0,
        "protocol": "tdoa2" if seed % 2 else "tdoa3",
        "anchors": corners(),
    }
    flight = situation.make(np.random.default_rng([seed, 28]), common)
    judged = Score(
        name, run_offline(flight, FilterConfig(**situation.config)).odometry, flight.truth
    ).series
    begin, end = situation.judged
    since = flight.tdoa.t[READY - 1] if situation.over is None else situation.over
    return {"figures": as_json(judged.figures(begin, end)), "again": again(judged, since)}


def again(judged, since):
    """s from `since` until the estimates of an ErrorSeries are right for FOR seconds, or to their
    end; None if they never are.
    """
    after = judged.t >= since
    t, wrong = judged.t[after], ~(np.linalg.norm(judged.error[after], axis=1) <= RIGHT)
    if not len(t):
        return None
    begins = np.append(t[0], t[1:][wrong[:-1]])  # stretches in which they are right begin there
    ends = np.append(t[wrong], np.inf)
    right = [
        begin
        for begin in begins
        if (end := ends[np.searchsorted(ends, begin)]) - begin >= FOR
        and (end < np.inf or t[-1] > begin)
    ]
    return max(0.0, float(right[0] - since)) if right else None


def figures(results):
    """Pool the `measure` of several seeds.

    Returns a dict as of `pooled_errors`, with again_median, again_max, s, and never, the
    number of seeds in which the filter is never right again.
    """
    runs = [
        {name: math.nan if value is None else value for name, value in result["figures"].items()}
        for result in results
    ]
    times = [result["again"] for result in results if result["again"] is not None]
    more = {
        "again_median": float(np.median(times)) if times else math.nan,
        "again_max": max(times, default=math.nan),
    }
    return {**pooled_errors(runs), **more, "never": len(results) - len(times)}


COLUMNS = {
    "rmse_3d": "error (RMSE), m",
    "rmse_3d_max_of_runs": "of the worst seed",
    "max_3d": "largest",
    "std_3d": "stated, m",
    "nees_mean": "NEES",
    "without_estimate": "without an estimate",
    "again_median": "right again, s",
    "again_max": "at the latest",
    "never": "never",
}


def row(name, of):
    """The row of a situation, of its `figures`."""
    cells = {key: f"{of[key]:.2f}" for key in COLUMNS}
    cells["nees_mean"], cells["never"] = f"{of['nees_mean']:.1f}", str(of["never"])
    cells["without_estimate"] = f"{of['without_estimate'] / of['duration']:.0%}"
    return table.line([name, *(cells[key].replace("nan", "") for key in COLUMNS)])


# -------------------------------------------------------------------------------------------------------
# what happens


def _at(rng, height, reach=1.2):
    """A place somewhere about the middle of the room: (x, y, height), m."""
    return (*rng.uniform(-reach, reach, 2), height)


def _round(centre, radius=1.0, speed=1.0, swing=0.2):
    """A position for Path: round a centre, m, rising and falling."""

    def position(t):
        angle = speed * t / radius
        return np.array(centre) + np.stack(
            [radius * np.cos(angle), radius * np.sin(angle), swing * np.sin(0.7 * angle)], axis=1
        )

    return position


def _flown(duration, position, common, **more):
    """A flight of a multirotor whose motors turn all the time."""
    path = Path(duration, position, running=(-1.0, duration + 1.0))
    return simulate(
        SimulationConfig(**{**common, "duration": duration, "imu_errors": FLYING, **more}), path
    )


def _level(t):
    return Rotation.from_rotvec(np.zeros((len(t), 3)))


def _carried(duration, position, common, attitude=_level, **more):
    """A recording of a tag without motors."""
    return simulate(
        SimulationConfig(**{**common, "duration": duration, **more}),
        Path(duration, position, attitude),
    )


def _still(duration, height, rng, common):
    place = _at(rng, height)
    return _carried(duration, between((0.0, *place), (duration, *place)), common)


def _hop(rng, common):
    """4 s on the floor, 3 s up to 1.3 m, 4 s there, 3 s down, 4 s on the floor."""
    place, other = _at(rng, REST), _at(rng, REST)
    up, over = (*place[:2], 1.3), (*other[:2], 1.3)
    stops = (0.0, *place), (4.0, *place), (7.0, *up), (11.0, *over), (14.0, *other), (18.0, *other)
    path = Path(18.0, between(*stops), running=(3.0, 15.0))
    return simulate(SimulationConfig(**{**common, "duration": 18.0, "imu_errors": FLYING}), path)


def _low_late(make, rng, common):
    """The Flight of `make`, with low anchors late near the floor, as in measured flights."""
    flight = make(rng, common)
    low = np.flatnonzero(flight.anchors.positions[:, 2] < LOW)
    height = np.interp(flight.tdoa.t, flight.truth.t, flight.truth.p[:, 2])
    size = LATE * np.clip((FADES[1] - height) / (FADES[1] - FADES[0]), 0.0, 1.0)
    each = rng.normal(0.0, 0.25, len(flight.anchors))
    each = np.where(np.isin(np.arange(len(each)), low), 1.0 + each / LATE, 0.0)
    return _later(flight, size, each)


def _later(flight, size, each):
    """A Flight whose arrivals are later by size (n,) m times each (N,) or (n, N), of the anchors."""
    a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
    each = np.broadcast_to(each, (len(flight.tdoa), len(flight.anchors)))
    rows = np.arange(len(flight.tdoa))
    return replace(
        flight, tdoa=replace(flight.tdoa, d=flight.tdoa.d + size * (each[rows, b] - each[rows, a]))
    )


def _without(streams, begin, end, make, rng, common):
    """The Flight of `make`, without the samples of some streams from `begin` to `end`, s."""
    flight = make(rng, common)
    for name in streams:
        stream = getattr(flight, name)
        kept = (stream.t < begin) | (stream.t > end)
        flight = replace(
            flight,
            **{
                name: replace(
                    stream, **{column: values[kept] for column, values in vars(stream).items()}
                )
            },
        )
    return flight


def _few(count, make, rng, common):
    """The Flight of `make`, with only `count` anchors heard from 10 s on."""
    flight = make(rng, common)
    heard = rng.permutation(flight.anchors.ids)[:count]
    kept = (flight.tdoa.t < 10.0) | (np.isin(flight.tdoa.a, heard) & np.isin(flight.tdoa.b, heard))
    return replace(
        flight,
        tdoa=replace(
            flight.tdoa, **{column: values[kept] for column, values in vars(flight.tdoa).items()}
        ),
    )


def _flying(duration, rng, common):
    """Round and round at 1 m/s, in the air all the time."""
    return _flown(duration, _round(_at(rng, 1.4, 0.5)), common)


def _tumbling(rng, common):
    """Carried at 1 m; from 10 to 15 s it is turned over about axes that change, 2 to 5 rad/s."""
    place, axes = _round(_at(rng, 1.0, 0.5), 0.4, 0.5, 0.1), rng.uniform(2.0, 3.5, 2)

    def attitude(t):
        inside = np.clip(t, 10.0, 15.0) - 10.0
        # begins and ends without a jerk
        about = inside - np.sin(2.0 * np.pi * inside / 5.0) * 5.0 / (2.0 * np.pi)
        return Rotation.from_euler(
            "zyx", np.column_stack([np.zeros(len(t)), axes[1] * about, axes[0] * about])
        )

    return _carried(22.0, place, common, attitude)


def _outside(far, rng, common):
    """5 s inside, 5 s through the wall to `far` m beyond the workspace, and round there for 10 s."""
    begin, x = _at(rng, 1.3), WALL + MARGIN + far
    way = between(
        (0.0, *begin), (5.0, *begin), (10.0 + 0.3 * far, x, 0.0, 1.3), (40.0, x, 0.0, 1.3)
    )

    def position(t):
        since = np.maximum(t - 10.0 - 0.3 * far, 0.0)
        return way(t) + 0.3 * np.stack(
            [np.zeros(len(t)), 1.0 - np.cos(since), 0.3 * (1.0 - np.cos(2.0 * since))], axis=1
        )

    return _flown(20.0 + 0.3 * far, position, common)


def _one_side(rng, common):
    """All eight anchors on one wall, and the tag 2 to 5 m in front of the wall."""
    y, z = np.meshgrid([-3.0, -1.0, 1.0, 3.0], [0.3, 2.8])
    wall = np.column_stack([np.full(8, -WALL), y.ravel(), z.ravel()])[rng.permutation(8)]
    return _flown(
        20.0, _round((0.0, 0.0, 1.4), 1.4), {**common, "anchors": facing(wall, (0.0, 0.0, 1.5))}
    )


def _in_a_plane(rng, common):
    """Eight anchors 2.8 m high, the tag below."""
    angle = 0.25 * np.pi * np.arange(8)
    ceiling = np.column_stack([WALL * np.cos(angle), 4.0 * np.sin(angle), np.full(8, 2.8)])[
        [0, 3, 6, 1, 4, 7, 2, 5]
    ]
    return _flown(
        20.0, _round(_at(rng, 1.2, 0.5)), {**common, "anchors": facing(ceiling, (0.0, 0.0, 1.0))}
    )


def _in_a_line(rng, common):
    """Six anchors along a line 1.5 m high, and the tag at a distance of 2 m.

    The angle of the tag about that line is unobservable from TDOAs.
    """
    line = np.column_stack(
        [np.zeros(6), np.linspace(-4.0, 4.0, 6)[[0, 3, 5, 1, 4, 2]], np.full(6, 1.5)]
    )
    return _flown(
        20.0, _round((2.0, 0.0, 1.3), 0.8), {**common, "anchors": facing(line, (3.0, 0.0, 1.5))}
    )


def _fast(rng, common):
    """5 m/s round 0.85 m: 3 g, the thrust tilted by 72 degrees."""
    slow = 4.0

    def position(t):
        # of full speed, reached after 8 s
        along = np.where(t < 2.0 * slow, t**2 / (4.0 * slow), t - slow)
        return np.array([0.0, 0.0, 1.4]) + 0.85 * np.stack(
            [np.cos(5.0 / 0.85 * along), np.sin(5.0 / 0.85 * along), np.zeros(len(t))], axis=1
        )

    return _flown(18.0, position, common)


def _rover(rng, common):
    """A rover whose antenna is 0.1 m high: 4 s at rest, 15 s round the room."""
    stops = [(0.0, *_at(rng, 0.1)), (4.0, *_at(rng, 0.1))]
    stops[1] = (4.0, *stops[0][1:])
    stops += [(4.0 + 3.0 * k, *_at(rng, 0.1, 2.5)) for k in range(1, 6)]
    return _carried(22.0, between(*stops, (22.0, *stops[-1][1:])), common)


def _pocket(rng, common):
    """In a person's pocket at 0.9 m: 1.2 m/s, bobbing, swinging; anchors behind are late through
    the body.
    """
    walk = _round((0.0, 0.0, 0.9), 1.8, 1.2, 0.0)

    def position(t):
        return walk(t) + np.column_stack(
            [np.zeros((len(t), 2)), 0.03 * np.sin(2.0 * np.pi * 1.9 * t)]
        )

    def attitude(t):
        swing = 0.4 * np.sin(2.0 * np.pi * 0.95 * t)
        return Rotation.from_euler(
            "zyx", np.column_stack([1.2 / 1.8 * t + 0.5 * np.pi, 0.3 + swing, 0.2 * swing])
        )

    flight = _carried(25.0, position, common, attitude)
    p = position(flight.tdoa.t)
    ahead = np.column_stack([-p[:, 1], p[:, 0]]) / np.hypot(p[:, 0], p[:, 1])[:, None]
    way = flight.anchors.positions[None, :, :2] - p[:, None, :2]
    behind = np.einsum("nak,nk->na", way, ahead) < -BEHIND * np.linalg.norm(way, axis=2)
    return _later(flight, np.full(len(p), SHADOW), behind.astype(float))


def _moving(rng, common):
    """2 m/s from the first sample on."""
    return _flown(12.0, _round(_at(rng, 1.4, 0.3), 1.8, 2.0), common)


def _table(rng, common):
    """4 s on a table of 0.75 m, then up and about."""
    place = _at(rng, 0.78)
    stops = (
        (0.0, *place),
        (4.0, *place),
        (6.0, *place[:2], 1.6),
        (10.0, *_at(rng, 1.6)),
        (16.0, *_at(rng, 1.2)),
    )
    path = Path(16.0, between(*stops), running=(3.0, 17.0))
    return simulate(SimulationConfig(**{**common, "duration": 16.0, "imu_errors": FLYING}), path)


def _gaps():
    """Nothing of some streams for a while, in flight; judged while it lasts."""
    for streams, what in ((("tdoa",), "TDOAs"), (("imu",), "IMU"), (("tdoa", "imu"), "both")):
        for gap in (1.0, 5.0, 30.0):
            make = partial(_without, streams, 15.0, 15.0 + gap, partial(_flying, 25.0 + gap))
            yield Situation(f"{gap:g} s without {what}", make, (15.0, 15.0 + gap), 15.0 + gap)


_LAID = partial(_still, 12.0, REST)
SITUATIONS = (
    Situation("on the floor", _LAID, (2.0, 12.0)),
    Situation("on the floor, low anchors 3.2 m late", partial(_low_late, _LAID), (2.0, 12.0)),
    Situation("at rest, 1 m high", partial(_still, 12.0, 1.0), (2.0, 12.0)),
    Situation(
        "at rest, TDOAs for 1 s, then none for 10 s",
        partial(_without, ("tdoa",), 1.0, 12.0, partial(_still, 12.0, 1.0)),
        (2.0, 11.0),
    ),
    Situation("lift-off, 3 s", _hop, (4.0, 7.0)),
    Situation(
        "lift-off, low anchors 3.2 m late on the floor", partial(_low_late, _hop), (4.0, 7.0)
    ),
    Situation("landing, 3 s, and 4 s at rest", _hop, (11.0, 18.0), 14.0),
    Situation(
        "landing, low anchors 3.2 m late on the floor", partial(_low_late, _hop), (11.0, 18.0), 14.0
    ),
    Situation("tumbling for 5 s", _tumbling, (10.0, 15.0), 15.0),
    *(
        Situation(
            f"outside, {far:g} m beyond the workspace",
            partial(_outside, far),
            (10.0 + 0.3 * far, 20.0 + 0.3 * far),
            10.0 + 0.3 * far,
        )
        for far in (1.0, 3.0, 10.0)
    ),
    Situation("all anchors on one side", _one_side, (5.0, 20.0)),
    *(
        Situation(
            f"{count} anchors heard for 10 s",
            partial(_few, count, partial(_flying, 20.0)),
            (10.0, 20.0),
            10.0,
        )
        for count in (3, 4)
    ),
    Situation("all anchors in a plane", _in_a_plane, (5.0, 20.0)),
    Situation("all anchors in a line", _in_a_line, (5.0, 20.0)),
    *_gaps(),
    Situation("no IMU at all", partial(_flying, 20.0), (5.0, 20.0), config={"use_imu": False}),
    Situation("fast: 5 m/s, 3 g", _fast, (8.0, 18.0), 8.0),
    Situation("a rover on the floor", _rover, (4.0, 19.0)),
    Situation("in a person's pocket", _pocket, (5.0, 25.0)),
    Situation("start in the air", partial(_flying, 10.0), (0.0, 10.0)),
    Situation("start moving, 2 m/s", _moving, (0.0, 12.0)),
    Situation("start on a table", _table, (1.0, 16.0)),
)
