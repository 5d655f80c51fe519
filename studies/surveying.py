# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Add errors to surveys of measured flights, and correct them from the flights alone.

The tag is judged on other flights.
"""

from dataclasses import replace
from functools import partial
import json
from pathlib import Path

from known_effects import clean_flight, marks_of
import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_tools import parallel
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.constraints import Mark, OdometryPath
from uwb_tdoa_tools.diagnosis.references import OdometryReference
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.parallel import whole_number
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.surveying.known import DRIFT

from .diagnosis.measured import SPLITS

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
MARKS = 6  # of each split at least
END_TIME, END_STD = 2.0, 0.1  # s, m
ODOMETRY_STEP = 0.05  # s
SIMULATED = 3  # flights of the simulated set, of SECONDS each
SECONDS = 60.0


def add_options(add):
    """add : add_argument of a parser."""
    add("--data", type=Path, required=True, metavar="DATA", help="folder of measured flights")
    add(
        "--draws",
        type=int,
        default=20,
        metavar="N",
        help="of each set and each size of the errors (default 20)",
    )
    add(
        "--first",
        type=int,
        default=0,
        metavar="SEED",
        help="of the first draw, or of what is known (default 0)",
    )
    add("--only", choices=(*SETS, "simulated"), help="one set")
    add(
        "--tape",
        nargs="+",
        type=float,
        default=SHAKES,
        metavar="M",
        help="standard deviations of the tape, m (default 0.1 0.3)",
    )
    add(
        "--plain",
        action="store_true",
        help="trust no coordinate more than others, as somebody with a tape measure alone",
    )
    add("--jobs", type=whole_number, default=1, metavar="N", help="draws at once (default 1)")
    add(
        "--known",
        choices=(*KNOWN, "odometry"),
        help="instead: flights of every split with this known beside, judged on others",
    )
    add("--split", choices=tuple(SPLITS), help="with --known: one of these alone")
    add("--json", metavar="FILE", type=OutputFile, help="write every draw")


def run(args):
    """Print a table, a row for each set and size."""
    if args.known:
        return with_known(args.data, args.known, [args.split] if args.split else SPLITS, args.first)
    print(
        (
            "| set | tape off by [m] | applied | tag, true survey | shaken | surveyed | surveyed "
            "/ shaken, median (worst) | "
        ),
        end="",
    )
    print(
        "worse than shaken | anchors shaken | surveyed | normalised error |\n|---|" + 10 * "---:|"
    )
    every = {}
    for name in [args.only] if args.only else [*SETS, "simulated"]:
        flights, judged = _simulated() if name == "simulated" else _measured(args.data, *SETS[name])
        for std in args.tape:
            seeds = range(args.first, args.first + args.draws)
            draws = list(
                parallel.over(
                    partial(draw, flights, judged, std, plain=args.plain),
                    seeds,
                    args.jobs,
                    unit=f"draw of {name} {std}",
                )
            )
            every[f"{name} {std}"] = draws
            print(f"| {name} | {std} | {_summary(draws)} |", flush=True)
    if args.json:
        write_text(args.json, json.dumps(every, indent=1))


def with_known(data, kind, splits, seed):
    """Print a table of the error with surveys good to 0.1 m, before and after a calibration.

    The calibration uses the given kind of knowledge in KNOWN. With "odometry", it is a diagnosis
    that uses an odometry with known places of take-off and landing.
    """
    print(
        "| fitted to | judged on | mean 3D RMSE before | after | worst ratio | known "
        "|\n|---|---|---:|---:|---:|---:|"
    )
    for name in (name for name in splits if SPLITS[name][1]):
        flights, judged = _measured(data, *SPLITS[name], ())
        rng, bare = np.random.default_rng(seed), [replace(flight, truth=None) for flight in flights]
        if kind == "odometry":
            known = [
                one
                for flight in flights
                for make in (odometry_of, ends_of)
                for one in make(flight, 1, rng)
            ]
            effects, positions = (
                diagnose(bare, reference=OdometryReference(None, known)).effects,
                flights[0].anchors.positions,
            )
        else:
            known = [one for flight in flights for one in KNOWN[kind](flight, len(flights), rng)]
            result = self_calibrate(bare, Tape(), constraints=known)
            effects, positions = result.effects, result.anchors.positions
        before = np.array([rmse([flight]) for flight in judged])
        after = np.array([rmse([at(flight, positions)], effects) for flight in judged])
        cells = (
            f"{before.mean():.3f} | {after.mean():.3f} | {(after / before).max():.2f} | "
            f"{len(known)}"
        )
        print(f"| {name} | {len(judged)} flights | {cells} |", flush=True)


def ends_of(flight, several, rng):
    """[Mark]: positions of the tag before take-off and after landing, for END_TIME each, with an
    error of END_STD.
    """
    truth, out = flight.truth, []
    last = flight.tdoa.t[-1] - flight.tdoa.t[0]
    for since in (0.0, last - END_TIME):
        first = flight.tdoa.t[0] + since
        inside = (truth.t >= first) & (truth.t <= first + END_TIME)
        if inside.any():
            place = truth.p[inside].mean(axis=0) + END_STD * rng.standard_normal(3)
            out.append(Mark(flight.name, since, since + END_TIME, tuple(place), END_STD))
    return out


def odometry_of(flight, several, rng):
    """[OdometryPath]: the ground truth in another frame, with a drift of DRIFT."""
    truth = flight.truth
    t = np.arange(truth.t[0], truth.t[-1], ODOMETRY_STEP)
    p = np.stack([np.interp(t, truth.t, column) for column in truth.p.T], axis=1)
    walk = np.cumsum(DRIFT * np.sqrt(ODOMETRY_STEP) * rng.standard_normal(p.shape), axis=0)
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    return [OdometryPath(flight.name, t, turn.apply(p) + rng.uniform(-5.0, 5.0, 3) + walk, DRIFT)]


KNOWN = {  # kind: function of (Flight, how many there are, Generator) that gives constraints
    "marks": lambda flight, several, rng: marks_of(flight, -(-MARKS // several), rng),
    "ends": ends_of,
}


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


def _measured(data, fit, judge, sensors):
    return [measured_flights(data, some, sensors) for some in (fit, judge)]


def measured_flights(data, paths, sensors=()):
    """Flights below a folder, with only the given sensors of SENSOR_NAMES."""
    unused = [sensor for sensor in SENSOR_NAMES if sensor not in sensors]
    reading = inputs.Reading(str(data / "surveys"))
    return [
        flight.without(*unused) for path in paths for flight in reading.flights([str(data / path)])
    ]


def _simulated():
    flights = [clean_flight(300 + seed, SECONDS) for seed in range(SIMULATED + 1)]
    return flights[:-1], flights[-1:]


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
    return " | ".join([applied, *cells, f"{_root(columns['normalised']):.2f}"])
