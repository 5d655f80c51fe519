# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the worth of height, pressure and velocity on measured flights, and the effect of their
faults.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_bias.common.sensors import Velocity
from uwb_tdoa_bias.common.sensors.pressure import altitude_of, pressure_at
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.results import VERDICTS
from uwb_tdoa_tools import choices, options
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.planning.precision import bound, information
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.scoring.metrics import pooled, position_at, scored_phase
from uwb_tdoa_tools.scoring.phases import NEAR_THE_FLOOR, TITLES

SETS = (), ("height",), ("pressure",), ("height", "pressure"), ("velocity",), ("height", "velocity")
# Hz, m/s: of a velocity made of the ground truth, where none was recorded
VELOCITY_RATE, VELOCITY_STD = (25.0, 0.1)
TAKE_OFF = 0.2  # s into the airborne part, for which the largest error is printed
GRACE = 3.0  # s after the beginning of a fault that do not count
ONSET = 8.0  # s into the airborne part at which a fault begins that is not there from the start
STEPS = 0.3, -0.5, 0.8  # m, of the ground below, one after the other,
# share of the messages of each of two seconds, as the status of ekf_node judges them
LARGEST_UNUSED = 0.5
NAMED = tuple(value for value, name in VERDICTS.items() if name in ("rejected", "invalid"))
STEP_PERIOD, STEP_LENGTH = 6.0, 3.0  # s between their beginnings, and of each


def add_options(add):
    """add : add_argument of a parser."""
    tables = "what each sensor is worth, what faults put into them do, or what is wrong with the velocity"
    add("table", choices=("worth", "faults", "velocity"), help=tables)
    add("flights", nargs="+", metavar="FLIGHT", help=choices.RECORDINGS)
    add("--survey", metavar="S", help=choices.SURVEY)
    add(
        "-p",
        dest="parameters",
        metavar="NAME:=VALUE",
        action="append",
        default=[],
        help="one filter parameter",
    )


def run(args):
    """Print one of the tables."""
    config = options.with_parameters(FilterConfig(), args.parameters)
    flights = [
        with_velocity(flight) for flight in inputs.Reading(args.survey).flights(args.flights)
    ]
    {"worth": worth, "faults": faults, "velocity": velocity}[args.table](flights, config)


def with_velocity(flight, rate=VELOCITY_RATE):
    """The flight with a velocity in the body frame. If none was recorded, it is simulated from the
    ground truth with noise, at `rate`, Hz.
    """
    if flight.velocity is not None:
        return flight
    truth = flight.truth
    t = np.arange(truth.t[0] + 0.1, truth.t[-1] - 0.1, 1.0 / rate)
    ends = [
        np.stack([np.interp(t + s, truth.t, truth.p[:, k]) for k in range(3)], axis=1)
        for s in (-0.05, 0.05)
    ]
    near = truth.q[np.clip(np.searchsorted(truth.t, t), 0, len(truth) - 1)]
    v = Rotation.from_quat(near).inv().apply((ends[1] - ends[0]) / 0.1)
    noise = VELOCITY_STD * np.random.default_rng(0).standard_normal(v.shape)
    return replace(flight, velocity=Velocity(t, v + noise, np.full(v.shape, VELOCITY_STD)))


def only(flight, names):
    """The flight with only the named sensors."""
    return flight.without(*(name for name in SENSOR_NAMES if name not in names))


def velocity(flights, config):
    """Table of the noise of the velocity, and of the effects that diagnose finds in it."""
    print("| flight | noise x, y [m/s] | found |\n|---|---|---|")
    for flight in flights:
        error = residuals(flight, GroundTruth(), EffectSet())["velocity"].residual
        spread = 1.4826 * np.median(np.abs(error[:, :2] - np.median(error[:, :2], axis=0)), axis=0)
        kinds = [name for name, effect in EFFECTS.items() if effect.channels == ("velocity",)]
        found = attribute([flight], GroundTruth(), kinds=kinds, undeclared=False).effects
        words = "; ".join(
            f"{e.name} {', '.join(f'{k} {v:.3g}' for k, v in e.values.items())}" for e in found
        )
        print(f"| {flight.name} | {spread[0]:.3f}, {spread[1]:.3f} | {words or 'nothing'} |")


def worth(flights, config):
    """Print tables of the errors with each set of sensors, and of the bound of `plan`.

    There is one table with all anchors and the IMU, one without IMU, and one with TDOAs of four
    anchors only. The bound is for one round of TDOAs and a height.
    """
    for words, change, setting in (
        ("all anchors", lambda flight: flight, config),
        ("without IMU", lambda flight: flight, replace(config, use_imu=False)),
        ("four anchors", of_four, config),
    ):
        print(f"{words}\n")
        _worth([change(flight) for flight in flights], setting, SETS)
        print()


def of_four(flight):
    """The flight with the TDOAs among its first four anchors alone."""
    return flight.among(np.arange(4))


def bounds(flights, height_std):
    """Bound of `plan` for one round of TDOAs, (4,) m, along x, y, z and in space.

    A finite height_std, m, adds a height. The bound is the root mean square along each flown path,
    averaged over the flights.
    """
    rows = []
    for flight in flights:
        _, first, last = scored_phase(flight.truth)
        places = position_at(np.arange(first, last, 0.5), flight.truth)
        covariance = bound(information(places, Installation(flight.anchors, height_std=height_std)))
        variance = np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0)
        rows.append(np.sqrt([*variance, variance.sum()]))
    return np.mean(rows, axis=0)


def _worth(flights, config, sets):
    titles = " | ".join(TITLES[name] for name in NEAR_THE_FLOOR)
    print(
        f"| sensors | x | y | z | 3D | largest 3D | at take-off | NEES | coverage | {titles} |\n|---|"
        + (8 + len(NEAR_THE_FLOOR)) * "---:|"
    )
    for names in sets:
        scores = [evaluate(only(flight, names), config)[0] for flight in flights]
        rows = [score.row() for score in scores]
        take_off = max(
            np.linalg.norm(s.error[s.t < s.first + TAKE_OFF], axis=1).max() for s in scores
        )
        means = [np.mean([row[f"rmse_{axis}"] for row in rows]) for axis in ("x", "y", "z", "3d")]
        nees = [row["nees_mean"] for row in rows]
        least = min(row[f"coverage_3sigma_{axis}"] for row in rows for axis in "xyz")
        cells = [
            f"{value:.3f}" for value in (*means, max(row["rmse_3d"] for row in rows), take_off)
        ]
        cells += [f"{min(nees):.1f} - {max(nees):.1f}", f"{least:.3f}"]
        phases = pooled(scores)["phases"]
        cells += [
            f"{phases[name]['rmse_3d']:.3f}" if name in phases else "" for name in NEAR_THE_FLOOR
        ]
        print(f"| {', '.join(names) or 'none'} | {' | '.join(cells)} |")
    for words, std in (("", np.inf), (", with a height", config.height_std)):
        cells = [f"{value:.3f}" for value in bounds(flights, std)]
        print(
            f"| *bound of one round{words}* | {' | '.join(cells)} "
            f"|{(4 + len(NEAR_THE_FLOOR)) * ' |'}"
        )


def faults(flights, config):
    """Print a table with one row per fault.

    A row has the ratio of the 3D RMSE with the faulty sensor to the 3D RMSE without the sensor. It
    also has the number of flights in which the status of ekf_node would name the sensor.
    """
    print(
        "| fault | mean 3D without | sound | faulty | largest faulty / without | named | "
        "sound, named |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|")
    plain = [evaluate(only(flight, ()), config)[0] for flight in flights]
    for name, (sensor, from_start, change) in FAULTS.items():
        rows, named = [], []
        for flight, none in zip(flights, plain):
            begin = scored_phase(flight.truth)[1] + (0.0 if from_start else ONSET)
            sound = only(flight, (sensor,))
            faulty = replace(sound, **{sensor: change(getattr(sound, sensor), begin)})
            scores, runs = zip((none, None), *(evaluate(each, config) for each in (sound, faulty)))
            rows.append([_rmse(score, begin) for score in scores])
            named.append(
                [is_named(each, sensor, run) for each, run in zip((sound, faulty), runs[1:])]
            )
        rows = np.array(rows)
        without, with_sound, with_faulty = rows.mean(axis=0)
        worst = int(np.argmax(rows[:, 2] / rows[:, 0]))
        ratio = rows[worst, 2] / rows[worst, 0]
        calm, told = np.sum(named, axis=0)
        means = f"{without:.3f} | {with_sound:.3f} | {with_faulty:.3f}"
        print(
            f"| {name} | {means} | {ratio:.2f} ({flights[worst].name}) | {told} of "
            f"{len(named)} | {calm} |"
        )


def is_named(flight, sensor, run):
    """Whether most messages of a sensor are rejected or invalid for two seconds of a Run."""
    second = (getattr(flight, sensor).t - flight.tdoa.t[0]).astype(int)
    unused = np.isin(run.sensors[sensor]["verdict"], NAMED)
    first = second.min()
    count, bad = np.bincount(second - first), np.bincount(second - first, unused)
    most = bad > LARGEST_UNUSED * count
    return bool(np.any(most[1:] & most[:-1]))


def _rmse(score, begin):
    counted = (score.t < begin) | (score.t > begin + GRACE)
    return float(np.sqrt(np.mean(np.sum(score.error[counted] ** 2, axis=1))))


def _range(change):
    """Fault of a Height, by what it makes of (stamps since the beginning, ranges)."""
    return lambda height, begin: replace(height, range=change(height.t - begin, height.range))


def _steps(since, distance):
    number = np.floor(since / STEP_PERIOD).astype(int)
    on_it = (since >= 0.0) & (since % STEP_PERIOD < STEP_LENGTH)
    return np.maximum(distance - np.where(on_it, np.take(STEPS, number % len(STEPS)), 0.0), 0.02)


def _stuck(since, distance):
    return np.where(since < 0.0, distance, distance[np.searchsorted(since, 0.0)])


def _drifting(pressure, begin):
    extra = np.maximum(pressure.t - begin, 0.0) / 60.0
    return replace(pressure, pressure=pressure_at(altitude_of(pressure.pressure) + extra))


def _slipping(velocity, begin):
    slips = ((velocity.t - begin) % 10.0 < 2.0) & (velocity.t > begin)
    return replace(velocity, v=np.where(slips[:, None], 0.0, velocity.v))


def _turned(velocity, begin):
    return replace(velocity, v=Rotation.from_euler("z", np.pi / 2).apply(velocity.v))


FAULTS = {  # name: sensor, whether it is there from the start, and what it makes of the stream
    "height: steps of 0.3 to 0.8 m": ("height", False, _range(_steps)),
    "height: out of range for 5 s": (
        "height",
        False,
        _range(lambda since, r: np.where((since > 0.0) & (since < 5.0), np.inf, r)),
    ),
    "height: stuck": ("height", False, _range(_stuck)),
    "height: stuck on the floor": ("height", True, _range(lambda since, r: np.full(len(r), r[0]))),
    "height: stuck at 1 m from the start": (
        "height",
        True,
        _range(lambda since, r: np.ones(len(r))),
    ),
    "height: near 0 with noise, from the start": (
        "height",
        True,
        _range(lambda since, r: 0.02 + 0.005 * np.random.default_rng(0).random(len(r))),
    ),
    "height: mm for m": ("height", True, _range(lambda since, r: 1000.0 * r)),
    "height: sign": ("height", True, _range(lambda since, r: -r)),
    "height: one in five 1 m too long": (
        "height",
        True,
        _range(lambda since, r: r + (np.random.default_rng(0).random(len(r)) < 0.2)),
    ),
    "pressure: drifts 1 m per minute": ("pressure", True, _drifting),
    "velocity: slips for 2 s of 10": ("velocity", False, _slipping),
    "velocity: turned by 90 degrees": ("velocity", True, _turned),
}
