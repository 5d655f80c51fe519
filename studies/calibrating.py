# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""calibrating: add tape-measure errors to surveys, calibrate without ground truth, and judge the
result on hold-out flights.

The figures are ratios of the 3D RMSE of the tag after and before; 1 where nothing is offered.
"""

from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.calibrating import without_truth
from uwb_tdoa_tools.diagnosis.self_calibration import Tape
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

from . import table
from .surveying import at, measured_flights, rmse

_UTIL = "util/const{}-trial{}.csv.gz"
# name: number of the room and flights to calibrate with, flights to judge that on, flights to judge
# the tag on
SETS = {
    "const1, one flight": (["1", "1-tdoa2"], [], ["2-tdoa2", "3-tdoa2"]),
    "const1, two flights": (["1", "1-tdoa2"], ["1-tdoa3"], ["2-tdoa2", "3-tdoa2"]),
    "const3, two flights": (["3", "1-tdoa2"], ["2-tdoa2"], ["3-tdoa2", "4-tdoa2"]),
    "const4, two flights": (["4", "1-tdoa2-traj1"], ["1-tdoa2-traj2"], ["1-tdoa2-traj3"]),
}
SIMULATED, FLOWN = (
    "simulated hall, two flights",
    dict(trajectory="sines", duration=60.0, imu_rate=200.0, truth_rate=50.0, bias=False),
)
DELAY = 0.05  # m, standard deviation of the delays of its anchors


def add_options(add):
    """add : add_argument of a parser."""
    add(
        "--data",
        type=Path,
        required=True,
        metavar="DATA",
        help="folder of measured flights (not used for the simulated hall)",
    )
    add(
        "--std",
        type=float,
        default=0.1,
        metavar="M",
        help="of each coordinate of an anchor (default 0.1)",
    )
    table.add_options(add, draws=5, first=200)
    table.add_only(add)


def run(args):
    """Print a table, a row for each set."""
    columns = ("set", "draws", "offered", "before, m: mean", "after", "ratio: median", "largest")
    cli.show(table.head(*columns, "largest, had all been offered"))
    names = table.chosen(args, [*SETS, SIMULATED])
    for name, draws in table.trials(partial(drawn, args.data, args.std), names, args):
        cli.show(table.line([name, len(draws), *summary(draws)]))


def drawn(data, std, trial):
    """The figures of a trial (set, seed), see `draw`."""
    name, seed = trial
    return draw(*flights_of(name, data), std, seed)


@lru_cache(maxsize=1)
def flights_of(name, data):
    """(flights to calibrate with, to judge that on, to judge the tag on) of a set."""
    if name != SIMULATED:
        (room, *fitted), judges, judged = SETS[name]
        return tuple(
            measured_flights(data, [_UTIL.format(room, k) for k in some])
            for some in (fitted, judges, judged)
        )
    flown = [simulate(SimulationConfig(seed=seed, **FLOWN)) for seed in (11, 12, 13)]
    delays = DELAY * np.random.default_rng(2).standard_normal(len(flown[0].anchors))
    late = AnchorDelay({str(i): float(delay) for i, delay in zip(flown[0].anchors.ids, delays)})
    first, second, third = map(late.inject, flown)
    return [first], [second], [third]


def draw(flights, holdout, others, std, seed):
    """{"offered", "before", "after", "had_it_been"}: m, RMSE on `others` with a survey that is off
    by std, m.
    """
    given = flights[0].anchors.positions
    shaken = given + std * np.random.default_rng(seed).standard_normal(given.shape)
    blind = [
        [replace(at(flight, shaken), truth=None) for flight in some] for some in (flights, holdout)
    ]
    made = without_truth(*blind, Tape(std))
    before = rmse([at(flight, shaken) for flight in others], EffectSet())
    moved = [replace(flight, anchors=made.anchors) for flight in others]
    after = rmse(moved, made.effects, replace(FilterConfig(), tdoa_std=made.tdoa_std))
    return {
        "offered": made.why_not is None,
        "before": before,
        "after": after if made.why_not is None else before,
        "had_it_been": after,
    }


def summary(draws):
    """Cells of the table."""
    before, after, had = (
        np.array([one[name] for one in draws]) for name in ("before", "after", "had_it_been")
    )
    offered = sum(one["offered"] for one in draws)
    ratio = after / before
    of_all = f"{np.median(ratio):.2f}", f"{ratio.max():.2f}", f"{(had / before).max():.2f}"
    return offered, f"{before.mean():.3f}", f"{after.mean():.3f}", *of_all
