# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""streaming: measured flights with errors added to their surveys, calibrated as one stream.

Each piece is judged with the calibration that was in use before it.
"""

from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.calibrating import between, in_pieces
from uwb_tdoa_tools.diagnosis.self_calibration import Tape
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.surveying.stream import StreamCalibration, in_place

from . import table
from .surveying import at, measured_flights

SHAKES = 0.05, 0.1, 0.2  # m, default of --tape
FEWEST_SECONDS = 10.0  # of a piece that is judged
_UTIL = "util/const{}-tdoa2{}.csv.gz"
_DAY = "flights/{}-traj{}"
SETS = {  # name: paths, in the order of the stream
    "const1": [_UTIL.format(f"1-trial{k}", "") for k in (1, 2, 3)],
    "const3": [_UTIL.format(f"3-trial{k}", "") for k in (1, 2, 3, 4)],
    "const4 trial 1": [_UTIL.format("4-trial1", f"-traj{k}") for k in (1, 2, 3)],
    "const4 trial 3": [_UTIL.format("4-trial3", f"-traj{k}") for k in (1, 2, 3)],
    "0425": [_DAY.format("0425/TDOA2/0425", k) for k in (1, 2, 3, 6, 7, 10)],
    "0426": [_DAY.format("0426/0426", k) for k in (1, 2, 3, 7, 11)],
}


def add_options(add):
    """add : add_argument of a parser."""
    add("--data", type=Path, required=True, metavar="DATA", help="folder of measured flights")
    words = "standard deviations of the tape, m (default 0.05 0.1 0.2)"
    add("--tape", nargs="+", type=float, default=SHAKES, metavar="M", help=words)
    table.add_options(add, draws=3)
    table.add_only(add)


def run(args):
    """Print a table, a row for each set and size."""
    columns = "set", "tape off by [m]", "in use after piece", "third piece, given", "in use"
    columns += "other flights, given", "in use", "worst piece, ratio"
    cli.show(table.head(*columns))
    rows = [(name, std) for name in table.chosen(args, SETS) for std in args.tape]
    for (name, std), draws in table.trials(partial(drawn, args.data), rows, args):
        cli.show(table.line([name, std, *_summary(draws)]))


@lru_cache(maxsize=1)
def flights_of(name, data):
    """Flights of a set, in the order of the stream."""
    return measured_flights(data, SETS[name])


def drawn(data, trial):
    """Figures of a trial ((set, standard deviation m), seed): [(flight, given m, in use m, taken)]."""
    (name, std), seed = trial
    true = flights_of(name, data)
    noise = np.random.default_rng(seed).standard_normal(true[0].anchors.positions.shape)
    flights = [at(flight, true[0].anchors.positions + std * noise) for flight in true]
    calibration = StreamCalibration(flights[0].anchors, Tape(std))
    out = []
    for number, flight in enumerate(flights):
        known = {0: _odometry(flight, EffectSet())}
        for piece in in_pieces(flight):
            now = calibration.number
            if now not in known:
                known[now] = _odometry(flight, calibration.effects)
            errors = [_rmse(flight, known[k], piece) for k in (0, now)]
            step = calibration.take(piece)
            if piece.duration > FEWEST_SECONDS:
                out.append((number, *errors, step.taken))
    return out


def _odometry(flight, effects):
    """The Odometry of a Flight with the calibration of an EffectSet."""
    anchors, others = in_place(flight.anchors, effects)
    return evaluate(at(flight, anchors.positions), effects=others)[1].odometry


def _rmse(flight, odometry, piece):
    """3D RMSE in the air during a piece, m; NaN if it is not in the air."""
    part = between(flight, piece.start, piece.end).known_truth
    t = odometry.t[(odometry.t >= piece.start) & (odometry.t <= piece.end)]
    p = np.stack([np.interp(t, part.t, column) for column in part.p.T], axis=1)
    air = p[:, 2] > 0.3
    off = (odometry.p[np.searchsorted(odometry.t, t)] - p)[air]
    return float(np.sqrt((off**2).sum(axis=1).mean())) if air.any() else np.nan


def _summary(draws):
    first = [next((k + 1 for k, row in enumerate(one) if row[3]), None) for one in draws]
    begun = [k for k in first if k is not None]
    third = np.array([one[2][1:3] for one in draws])
    others = np.array([row[1:3] for one in draws for row in one if row[0] > 0])
    ratios = [row[2] / row[1] for one in draws for row in one]
    when = f"{np.median(begun):g} ({len(begun)} of {len(draws)})" if begun else "never"
    means = [f"{value:.3f}" for value in (*third.mean(axis=0), *np.nanmean(others, axis=0))]
    return [when, *means, f"{np.nanmax(ratios):.2f}"]
