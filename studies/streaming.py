# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""streaming: measured flights with errors added to their surveys, calibrated as one stream.

Each piece is judged with the calibration that was in use before it. --changed moves or delays an
anchor in the second flight.
"""

from copy import deepcopy
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.calibrating import between, in_pieces
from uwb_tdoa_tools.diagnosis.self_calibration import Tape
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.surveying.stream import StreamCalibration, in_place

from . import table
from .surveying import at, measured_flights

SHAKES = 0.05, 0.1, 0.2  # m, default of --tape
CHANGE = 0.3  # m, of a changed anchor
SETTLED = 120.0  # s
LARGEST_RATIO = 1.2  # of the error after a change to that of the unharmed flight
OF_CHANGES = "after 120 s, unharmed", "given", "in use", "at most 1.2 times", "changes named"
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
    words = "change each anchor once, in the second flight of a set"
    add("--changed", action="store_true", help=words)
    table.add_options(add, draws=3)
    table.add_only(add)


def run(args):
    """Print a table, a row for each set and size."""
    if args.changed:
        changes(args)
        return
    columns = "set", "tape off by [m]", "in use after piece", "third piece, given", "in use"
    columns += "other flights, given", "in use", "worst piece, ratio", "changes named"
    cli.show(table.head(*columns))
    rows = [(name, std) for name in table.chosen(args, SETS) for std in args.tape]
    for (name, std), draws in table.trials(partial(drawn, args.data), rows, args):
        cli.show(table.line([name, std, *_summary(draws)]))


@lru_cache(maxsize=1)
def flights_of(name, data):
    """Flights of a set, in the order of the stream."""
    return measured_flights(data, SETS[name])


def drawn(data, trial):
    """Figures of a trial ((set, standard deviation m), seed): [(flight, given m, in use m, taken, whether a change is named)]."""
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
                out.append((number, *errors, step.taken, _names_a_change(step)))
    return out


def changes(args):
    """Print a table, a row for each set, size and kind of change."""
    cli.show(table.head("set", "tape off by [m]", "an anchor", *OF_CHANGES, texts=3))
    sets = table.chosen(args, SETS)
    rows = [(name, std, kind) for name in sets for std in args.tape for kind in ("moved", "late")]
    for row, draws in table.trials(partial(changed, args.data), rows, args):
        cases = np.array([case for draw in draws for case in draw])
        unharmed, _, in_use, named = cases.T
        cells = [f"{value:.3f}" for value in np.median(cases[:, :3], axis=0)]
        good = np.count_nonzero(in_use <= LARGEST_RATIO * unharmed)
        cli.show(table.line([*row, *cells, f"{good} of {len(cases)}", int(named.sum())]))


def changed(data, trial):
    """Cases of a trial ((set, tape m, kind), seed), one for each anchor.

    The stream begins with the first flight. The anchor moves by CHANGE with the second, or is late by
    CHANGE from its middle on. Judged is the third flight, from SETTLED s of flight after the change.
    A case: error without the change, with it and the anchors as given, with it and the calibration
    in use, m; how often a change was named.
    """
    (name, std, kind), seed = trial
    true = flights_of(name, data)[:3]
    random = np.random.default_rng(seed)
    noise = random.standard_normal(true[0].anchors.positions.shape)
    places = true[0].anchors.positions + std * noise
    before = StreamCalibration(at(true[0], places).anchors, Tape(std))
    _taken([at(true[0], places)], before)
    share = 1.0 if kind == "moved" else 0.5  # of the second flight, after the change
    settled = true[2].start + SETTLED - share * true[1].duration
    unharmed, _ = _taken([at(flight, places) for flight in true[1:]], deepcopy(before), settled)
    out = []
    for anchor in true[0].anchors.ids.tolist():
        if kind == "moved":
            turn = random.standard_normal(3)
            shift = CHANGE * turn / np.linalg.norm(turn)
            effect = AnchorPosition(
                values={f"{anchor}.{axis}": v for axis, v in zip("xyz", shift.tolist())}
            )
        else:
            effect = AnchorDelay(values={str(anchor): CHANGE})
        later = [_with(flight, effect) for flight in true[1:]]
        if kind == "late":
            middle = true[1].start + share * true[1].duration
            d = np.where(true[1].tdoa.t < middle, true[1].tdoa.d, later[0].tdoa.d)
            later[0] = replace(true[1], tdoa=replace(true[1].tdoa, d=d))
        given = [at(flight, places) for flight in later]
        in_use, named = _taken(given, deepcopy(before), settled)
        odometry = _odometry(given[-1], EffectSet())
        pieces = [piece for piece in in_pieces(given[-1]) if piece.start >= settled]
        errors = [_rmse(given[-1], odometry, piece) for piece in pieces]
        out.append((unharmed, _mean(errors), in_use, named))
    return out


def _with(flight, effect):
    """A Flight with an Effect."""
    return effect.inject(flight, np.random.default_rng(0))


def _taken(flights, calibration, settled=-np.inf):
    """Give flights to a StreamCalibration.

    settled : stamp s. Returns (error in later pieces of the last flight m, number of changes named).
    """
    errors, named = [], 0
    for flight in flights:
        errors = []
        for piece in in_pieces(flight):
            if flight is flights[-1] and piece.start >= settled:
                errors.append(_rmse(flight, _odometry(flight, calibration.effects), piece))
            step = calibration.take(piece)
            named += _names_a_change(step)
    return _mean(errors), named


def _names_a_change(step):
    return step.taken and "anchor" in step.text


def _mean(errors):
    return float(np.sqrt(np.nanmean(np.square(errors))))


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
    named = sum(row[4] for one in draws for row in one)
    return [when, *means, f"{np.nanmax(ratios):.2f}", named]
