# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""surveying: add errors to surveys of measured flights, and correct them from the flights alone.

The tag is judged on other flights.
"""

from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

from known_effects import clean_flight
import numpy as np

from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.evaluation import evaluate

from . import table

SHAKES = 0.1, 0.3  # m, default of --tape
_UTIL, _CONST4, _0425 = (
    "util/const{}-trial{}.csv.gz",
    "util/const4-trial1-tdoa2-traj{}.csv.gz",
    "flights/0425/TDOA2/0425-traj{}",
)
SETS = {  # name: (paths to survey with, paths to judge on, sensors that are used)
    "const1": (
        [_UTIL.format(1, k) for k in ("1-tdoa2", "1-tdoa3")],
        [_UTIL.format(1, k) for k in ("2-tdoa2", "3-tdoa2")],
        (),
    ),
    "const3": (
        [_UTIL.format(3, k) for k in ("1-tdoa2", "2-tdoa2")],
        [_UTIL.format(3, k) for k in ("3-tdoa2", "4-tdoa2")],
        (),
    ),
    "const4": ([_CONST4.format(k) for k in (1, 2)], [_CONST4.format(3)], ()),
    "0425": ([_0425.format(k) for k in (1, 2, 6)], [_0425.format(k) for k in (3, 7, 10)], ()),
    "0425 with its range finder": (
        [_0425.format(k) for k in (1, 2, 6)],
        [_0425.format(k) for k in (3, 7, 10)],
        SENSOR_NAMES,
    ),
}
SIMULATED = 3  # flights of the simulated set, of SECONDS each
SECONDS = 60.0


def add_options(add):
    """add : add_argument of a parser."""
    add("--data", type=Path, required=True, metavar="DATA", help="folder of measured flights")
    words = "standard deviations of the tape, m (default 0.1 0.3)"
    add("--tape", nargs="+", type=float, default=SHAKES, metavar="M", help=words)
    words = "trust no coordinate more than others, as somebody with a tape measure alone"
    add("--plain", action="store_true", help=words)
    table.add_options(add, draws=20)
    table.add_only(add)


def run(args):
    """Print a table, a row for each set and size."""
    columns = "set", "tape off by [m]", "applied", "tag, true survey", "shaken", "surveyed"
    columns += "surveyed / shaken, median (worst)", "worse than shaken"
    cli.show(table.head(*columns, "anchors shaken", "surveyed", "normalised error"))
    names = table.chosen(args, [*SETS, "simulated"])
    rows = [(name, std) for name in names for std in args.tape]
    drawn_one = partial(drawn, args.data, args.plain)
    for (name, std), draws in table.trials(drawn_one, rows, args):
        cli.show(table.line([name, std, *_summary(draws)]))


def drawn(data, plain, trial):
    """The figures of a trial ((set, standard deviation m), seed), see `draw`."""
    (name, std), seed = trial
    return draw(*flights_of(name, data), std, seed, plain)


@lru_cache(maxsize=1)
def flights_of(name, data):
    """([Flight to survey with], [Flight to judge on]) of a set."""
    if name == "simulated":
        flights = [clean_flight(300 + seed, SECONDS) for seed in range(SIMULATED + 1)]
        return flights[:-1], flights[-1:]
    fit, judge, sensors = SETS[name]
    return measured_flights(data, fit, sensors), measured_flights(data, judge, sensors)


def draw(flights, judged, std, seed, plain=False):
    """dict of figures of one draw.

    It has the mean 3D RMSE, m, of the judged Flights with the true, shaken and surveyed anchors. It
    also has the RMS error, m, of the coordinates that are not trusted, shaken and surveyed. The
    normalised error is the error of the result, applied or not, over its std.
    plain : trust no coordinate more than others
    """
    true = flights[0].anchors
    tape = Tape(std, trusted=() if plain else third(true))
    free = tape.position_std(true) > tape.trusted_std
    noise = np.random.default_rng(seed).standard_normal(true.positions.shape)
    rough = true.positions + np.where(free, std, tape.trusted_std) * noise
    result = self_calibrate([at(flight, rough) for flight in flights], tape)
    error = result.surveyed.positions - true.positions
    return {
        "true": rmse(judged),
        "shaken": rmse([at(flight, rough) for flight in judged]),
        "surveyed": rmse(
            [at(flight, result.anchors.positions) for flight in judged], result.effects
        ),
        "applied": result.why_not is None,
        "slow_before": result.before,
        "slow_left": result.left,
        "delay_std": result.solution.delay_std,
        "anchors_shaken": _root((rough - true.positions)[free]),
        "anchors_surveyed": _root(error[free]),
        "normalised": _root((error / result.position_std)[free]),
    }


def third(anchors):
    """Names of a third of the coordinates of eight Anchors: all of two at opposite ends, the
    heights of two more.
    """
    far = int(np.argmax(np.linalg.norm(anchors.positions - anchors.positions[0], axis=1)))
    others = [row for row in range(1, len(anchors)) if row != far][:2]
    ids = [str(i) for i in anchors.ids]
    return ids[0], ids[far], *(f"{ids[row]}.z" for row in others)


def at(flight, positions):
    """The Flight with its anchors at other positions, (N, 3) m."""
    return replace(flight, anchors=flight.anchors.at(positions))


def measured_flights(data, paths, sensors=()):
    """Flights below a folder, with only the given sensors of SENSOR_NAMES."""
    unused = [sensor for sensor in SENSOR_NAMES if sensor not in sensors]
    reading = inputs.Reading(str(data / "surveys"))
    return [
        flight.without(*unused) for path in paths for flight in reading.flights([str(data / path)])
    ]


def rmse(flights, effects=None, config=None):
    """Mean 3D RMSE of the filter on Flights, m."""
    return float(
        np.mean([evaluate(flight, config, effects)[0].row()["rmse_3d"] for flight in flights])
    )


def _root(values):
    return float(np.sqrt(np.mean(values**2)))


def _summary(draws):
    columns = {key: np.array([one[key] for one in draws]) for key in draws[0]}
    ratio = columns["surveyed"] / columns["shaken"]
    worse = int(np.sum(columns["surveyed"] > 1.03 * columns["shaken"]))
    cells = [f"{columns[key].mean():.3f}" for key in ("true", "shaken", "surveyed")]
    cells += [f"{np.median(ratio):.2f} ({ratio.max():.2f})", f"{worse} of {len(draws)}"]
    cells += [f"{_root(columns[key]):.3f}" for key in ("anchors_shaken", "anchors_surveyed")]
    applied = f"{int(columns['applied'].sum())} of {len(draws)}"
    return [applied, *cells, f"{_root(columns['normalised']):.2f}"]
