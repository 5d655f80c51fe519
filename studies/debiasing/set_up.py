# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""debias-set-up: a simulated copy of the set-up of Grasso et al. (Sensors 2022, 22, 9136), sections
4 and 5.

The area has 4 x 4 m, and four anchors at the height of the tag, 0.2 m. There is a calibration grid
of 50 cm, a validation grid of 25 cm, rails, and a square path.
"""

from dataclasses import dataclass, replace
from functools import partial
import json

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.debias import INTERPOLATORS, Part, fit
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools import parallel
from uwb_tdoa_tools.outputs import OutputFolder
from uwb_tdoa_tools.scoring.metrics import position_at
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

from .report import plot_set_up, set_up_tables

STEP = 0.5  # m, of the calibration grid
HEIGHT = 0.2  # m
HALF = 2.0  # m; we count from the middle, the paper from the corner (0, 0)
KEEP_OFF = 0.5  # m from an anchor, where the paper had no positions
SETTLE, STAY = 2.0, 7.0  # s; 700 positions at 100 Hz in the paper
RAILS = (  # Table 1: direction, the other coordinate (m, from the middle), cruising speed (m/s)
    ("x", -1.0, 0.58),
    ("x", 0.0, 0.44),
    ("x", 1.0, 0.43),
    ("y", -1.0, 0.58),
    ("y", 0.0, 0.51),
    ("y", 1.0, 0.42),
)
PASSES = 10
# Table 2: fixed axis, its value
EDGES = {"bottom": (1, -1.5), "right": (0, 1.5), "top": (1, 1.5), "left": (0, -1.5)}
FAR = 10.0  # m, of the anchors that hold the height


@dataclass(frozen=True)
class Measured:
    """Estimates of one run and the truth at their stamps. t (n,) s; p, v, true (n, 3) m, m/s;
    covariance (n, 3, 3) m^2.
    """

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    covariance: np.ndarray
    true: np.ndarray

    @property
    def part(self):
        return Part(self.p, self.true, self.covariance)


# Without zero-velocity updates, the filter averages the noise of a stay as for a moving tag.
AVERAGING = FilterConfig(zero_velocity=False)


def add_options(add):
    """The options of the study."""
    add("--seed", metavar="N", type=int, default=0, help="of everything random (default: 0)")
    add(
        "--out",
        metavar="DIR",
        type=OutputFolder,
        required=True,
        help="where to write tables, figures and pictures",
    )
    add("--jobs", metavar="N", type=int, help="runs at once (default: as many as there are cores)")


def run(args):
    """Write set_up.md, set_up.json and set_up.png, and print the tables."""
    args.out.mkdir(parents=True, exist_ok=True)
    figures, found, maps = copied(args.seed, args.jobs)
    write_text(args.out / "set_up.md", set_up_tables(figures))
    write_text(args.out / "set_up.json", json.dumps(figures, indent=1, allow_nan=False) + "\n")
    plot_set_up(found, maps, args.out / "set_up.png")
    print(set_up_tables(figures))


def grid(first, last, step):
    """Places (n, 2), m, of a square grid that are KEEP_OFF from the anchors at the corners."""
    line = np.arange(first, last + 1e-9, step)
    places = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    return places[np.hypot(*(HALF - np.abs(places)).T) >= KEEP_OFF - 1e-9]


def measure(task, seed):
    """Measured of one run. task : (number, fields of SimulationConfig)

    The seed determines the antenna delays; everything else that is random differs between runs.
    """
    number, fields = task
    config = SimulationConfig(
        seed=1000 * seed + number,
        constellation="planar",
        height=HEIGHT,
        start_in_air=True,
        imu_rate=100.0,
        truth_rate=100.0,
        anchor_delay_std=0.0,
        multipath=False,
        **fields,
    )
    flight = simulate(config)
    delays = SimulationConfig.anchor_delay_std * np.random.default_rng([seed, 4]).standard_normal(
        len(flight.anchors)
    )
    flight = EFFECTS["anchor_delay"](
        dict(zip(map(str, flight.anchors.ids.tolist()), delays.tolist()))
    ).inject(flight)
    odometry = run_offline(_held_level(flight), AVERAGING).odometry
    rows = odometry.t > SETTLE
    columns = (
        odometry.t,
        odometry.p,
        odometry.v,
        odometry.covariance[:, :3, :3],
        position_at(odometry.t, flight.truth),
    )
    return Measured(*(column[rows] for column in columns))


def _held_level(flight):
    """Return the flight with TDOAs of 0 between two added anchors, far above and below the middle.

    They give the filter the height, which is unobservable from four anchors in one plane with the
    tag.
    """
    anchors, tdoa, n = flight.anchors, flight.tdoa, len(flight.anchors)
    poles = [[0.0, 0.0, HEIGHT + FAR], [0.0, 0.0, HEIGHT - FAR]]
    t = np.arange(0.01, tdoa.t[-1], 0.02)
    added = (t, np.full(len(t), n), np.full(len(t), n + 1), np.zeros(len(t)))
    order = np.argsort(np.concatenate([tdoa.t, t]), kind="stable")
    columns = (np.concatenate(pair)[order] for pair in zip((tdoa.t, tdoa.a, tdoa.b, tdoa.d), added))
    return replace(
        flight,
        anchors=Anchors.from_positions(np.vstack([anchors.positions, poles])),
        tdoa=Tdoas(*columns),
    )


def _stays(places):
    return [
        {"trajectory": "hover", "place": tuple(place), "duration": SETTLE + STAY}
        for place in places.tolist()
    ]


def _rail(direction, at, speed, passes):
    place = (0.0, at) if direction == "x" else (at, 0.0)
    duration = SETTLE + passes * 2.0 * HALF / speed
    return {
        "trajectory": f"line_{direction}",
        "place": place,
        "radius": HALF,
        "speed": speed,
        "duration": duration,
    }


def copied(seed=0, jobs=None):
    """All of it: (figures for JSON, {"calibration": [Measured], "validation": [Measured]}, {name:
    BiasMap}).
    """
    calibration, validation = grid(-2.0, 2.0, STEP), grid(-1.75, 1.75, STEP)
    lines = np.arange(-1.5, 1.6, STEP)
    sides = SETTLE + PASSES * 24.0
    groups = {
        "calibration": _stays(calibration),
        "validation": _stays(validation),
        "sweeps": [_rail(direction, at, 0.5, 1) for direction in "xy" for at in lines.tolist()],
        "rails": [_rail(*rail, PASSES) for rail in RAILS],
        "square": [{"trajectory": "square", "radius": 1.5, "speed": 0.5, "duration": sides}],
    }
    tasks = list(enumerate(task for group in groups.values() for task in group))
    done = iter(list(parallel.over(partial(measure, seed=seed), tasks, jobs, unit="run")))
    found = {name: [next(done) for _ in group] for name, group in groups.items()}
    maps = {}
    for source, name in (("calibration", "static"), ("sweeps", "dynamic")):
        parts = [measured.part for measured in found[source]]
        for kind in INTERPOLATORS:
            maps[f"{name}, {kind}"] = fit(
                parts, STEP, 20, True, kind, source=f"simulated set-up, {name}, seed {seed}"
            )
    (square,) = found["square"]
    figures = {
        "seed": seed,
        "static": {name: _static(found[name], maps) for name in ("calibration", "validation")},
        "rails": [
            _rail_figures(rail, measured, maps) for rail, measured in zip(RAILS, found["rails"])
        ],
        "square": {name: _edge_figures(square, maps, *edge) for name, edge in EDGES.items()},
    }
    return figures, found, maps


def _errors(measured, maps):
    """{"before" or name of the map: (n, 2) m}."""
    out = {"before": (measured.p - measured.true)[:, :2]}
    return out | {
        name: (one.correct(measured.p, measured.covariance)[0] - measured.true)[:, :2]
        for name, one in maps.items()
    }


def _static(stays, maps):
    """Mean over the places of |bias| in x, in y and in both, m."""
    by_place = [
        {name: error.mean(axis=0) for name, error in _errors(stay, maps).items()} for stay in stays
    ]
    out = {"places": len(stays)}
    for name in by_place[0]:
        bias = np.abs([place[name] for place in by_place])
        size = np.hypot(*bias.T)
        out[name] = {
            "x": bias[:, 0].mean(),
            "y": bias[:, 1].mean(),
            "both": size.mean(),
            "largest": size.max(),
        }
    return _plain(out)


def _rail_figures(rail, measured, maps):
    inside = np.hypot(*(HALF - np.abs(measured.true[:, :2])).T) >= KEEP_OFF
    rmse = {
        name: np.sqrt(np.mean(error[inside] ** 2, axis=0))
        for name, error in _errors(measured, maps).items()
    }
    speed = np.mean(np.linalg.norm(np.diff(measured.true, axis=0), axis=1) / np.diff(measured.t))
    figures = {name: {"x": values[0], "y": values[1]} for name, values in rmse.items()}
    return _plain({"direction": rail[0], "at": rail[1] + HALF, "speed": speed, **figures})


def _edge_figures(measured, maps, axis, value):
    on_edge = np.abs(measured.true[:, axis] - value) < 0.02
    errors = _errors(measured, maps)
    return _plain(
        {
            name: np.sqrt(np.mean(np.sum(error[on_edge] ** 2, axis=1)))
            for name, error in errors.items()
        }
    )


def _plain(content):
    """Numpy numbers as floats, for JSON."""
    if isinstance(content, dict):
        return {key: _plain(value) for key, value in content.items()}
    return float(content) if isinstance(content, np.floating) else content
