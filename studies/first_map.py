# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""first-map: first maps of unknown anchors in simulated halls: which are accepted, and how large their errors
are.

Size, anchors, path, protocol, noise, outliers and delays of each hall are random. Two anchors are
trusted. The inputs take turns, see INPUTS. A map is wrong and certain if it is accepted and a
coordinate is off by more than CERTAIN of its standard deviations.
"""

from dataclasses import replace

import numpy as np

from uwb_tdoa_tools import cli
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.first_map import map_anchors, observe
from uwb_tdoa_tools.simulation import ImuErrors, SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import constellation

from . import table
from .surveying import at, rmse

CERTAIN = 4.0
INPUTS = (
    "flight",
    "flight and heights",
    "two flights",
    "distances by radio",
    "flight and distances",
    "flight without IMU, heights, a side",
)
PATHS = "sines", "sines", "rising_circle", "circle", "square", "line_x", "hover"
HEIGHT_STD, SIDE_STD = 0.03, 1.0  # m
NAMED = "hall", "staircase", "pillars", "six", "low_ceiling"


def add_options(add):
    """add : add_argument of a parser."""
    add("--chain", action="store_true", help="survey each map of flights, and judge other flights")
    table.add_options(add, draws=20)


def run(args):
    """Print a row for each hall, and the sums."""
    texts = ["hall", "anchors", "path", "input", "verdict"]
    numbers = ["error, m", "stated, m", "largest z", "NEES"]
    numbers += ["tag: true anchors, m", "map, m", "surveyed, m"] if args.chain else []
    cli.show(table.head(*texts, *numbers, texts=len(texts)))
    found = []
    for row in table.results(_chained if args.chain else judged, table.seeds(args), args):
        found.append(row)
        cells = [row["seed"], row["anchors"], row["path"], row["input"], row["why"] or "a map"]
        cells += [f"{row['error']:.2f}", f"{row['stated']:.2f}"]
        cells += [f"{row['z']:.1f}", f"{row['nees']:.2f}"]
        cli.show(table.line([*cells, *(f"{value:.3f}" for value in row.get("tag", ()))]))
    accepted = [row for row in found if not row["why"]]
    if not accepted:
        cli.show(f"0 of {len(found)} accepted")
        return
    wrong = sum(row["z"] > CERTAIN for row in accepted)
    normalized = [value for row in accepted for value in row["normalized"]]
    cli.show(
        f"{len(accepted)} of {len(found)} accepted, {wrong} wrong and certain; error of an anchor, median "
        f"{np.median([row['error'] for row in accepted]):.2f} m; root mean square of z "
        f"{np.sqrt(np.mean(np.square(normalized))):.2f}"
    )


def judged(seed, keep=None):
    """dict of figures of one hall. keep : list that gets flights, the FirstMap and true Anchors."""
    rng = np.random.default_rng([seed, 7])
    kind = INPUTS[seed % len(INPUTS)]
    count = int(rng.integers(5, 13))
    name = str(rng.choice(NAMED)) if rng.random() < 0.25 else f"random-{9000 + seed}-{count}"
    true = constellation(name)
    path = str(rng.choice(PATHS)) if kind != "distances by radio" else "-"
    several = {"two flights": 2, "distances by radio": 0}.get(kind, 1)
    flights = [_flight(name, path, rng, 10 * seed + number) for number in range(several)]
    if "without IMU" in kind:
        flights = [flight.without("imu") for flight in flights]
    ids = true.ids
    seen = observe([flight.without("truth") for flight in flights], ids)
    delay = float(rng.choice([0.0, 0.1]))
    distances = _distances(true, delay, rng)
    if "distances" in kind:
        seen = replace(seen, distances=distances, delay_std=max(delay, 0.02))
    seen = replace(seen, coordinates=_coordinates(true, kind, seed, rng))
    found = map_anchors(seen, seed=seed)
    error = found.positions - true.positions
    free = ~found.trusted
    places = np.flatnonzero(free.ravel())
    part = found.covariance[np.ix_(places, places)]
    z = error[free] / found.std[free]
    if keep is not None:
        keep += [flights, found, true]
    unknown = free.any(axis=1)
    return {
        "seed": seed,
        "anchors": len(true),
        "path": path,
        "input": kind,
        "why": found.why_not.partition(";")[0],
        "error": float(np.sqrt(np.mean(np.sum(error[unknown] ** 2, axis=1)))),
        "stated": float(np.sqrt(np.mean(np.sum(found.std[unknown] ** 2, axis=1)))),
        "z": float(np.abs(z).max()),
        "normalized": z.tolist(),
        "nees": float(error[free] @ np.linalg.solve(part, error[free]) / len(places)),
    }


def _chained(seed):
    """dict of `judged`; "tag": 3D RMSE, m, on another flight with the true, mapped, surveyed anchors."""
    kept = []
    row = judged(seed, kept)
    flights, found, true = kept
    if row["why"] or not flights or flights[0].imu is None:
        return row
    rng = np.random.default_rng([seed, 8])
    name = flights[0].meta["config"]["constellation"]
    other = _flight(name, "sines", rng, 10 * seed + 9)
    trusted = tuple(str(i) for row_, i in enumerate(true.ids) if found.trusted[row_].all())
    tape = Tape(min(found.usual_std, 5.0), trusted=trusted)
    surveyed = self_calibrate([at(flight, found.positions) for flight in flights], tape)
    row["tag"] = [
        rmse([other]),
        rmse([at(other, found.positions)]),
        rmse([at(other, surveyed.anchors.positions)], surveyed.effects),
    ]
    return row


def _flight(name, path, rng, seed):
    return simulate(
        SimulationConfig.of(
            "quadrotor",
            constellation=name,
            trajectory=path,
            seed=seed,
            duration=float(rng.uniform(30.0, 120.0)),
            speed=float(rng.uniform(0.7, 1.5)),
            protocol=str(rng.choice(["tdoa2", "tdoa3"])),
            yaw=str(rng.choice(["fixed", "along_track", "rotating"])),
            noise_std=float(rng.uniform(0.03, 0.15)),
            outlier_probability=float(rng.choice([0.0, 0.01, 0.05])),
            anchor_delay_std=float(rng.choice([0.0, 0.05, 0.15])),
            imu_errors=ImuErrors(vibration=float(rng.choice([0.0, 1.0]))),
        )
    )


def _distances(true, delay, rng):
    """Rows a, b, distance, std of pairs of Anchors: some are missing, some err by metres."""
    count = len(true)
    delays = delay * rng.standard_normal(count)
    missing, wrong = rng.choice([0.0, 0.1, 0.3]), rng.choice([0.0, 0.05])
    rows = []
    for a in range(count):
        for b in range(a):
            if rng.random() < missing:
                continue
            length = np.linalg.norm(true.positions[a] - true.positions[b])
            length += delays[a] + delays[b] + 0.05 * rng.standard_normal()
            length += rng.uniform(0.5, 3.0) * (rng.random() < wrong)
            rows.append((a, b, length, 0.05))
    return np.array(rows)


def _coordinates(true, kind, seed, rng):
    """Rows anchor, axis, value, std: two anchors at opposite ends, and what the kind of input names."""
    p = true.positions
    apart = np.linalg.norm((p[:, None] - p)[:, :, :2], axis=2)
    one, other = np.unravel_index(np.argmax(apart), apart.shape)
    rows = [(row, axis, p[row, axis], 0.01) for row in (one, other) for axis in range(3)]
    if "heights" in kind or kind == "distances by radio":
        rows += [
            (row, 2, p[row, 2] + HEIGHT_STD * rng.standard_normal(), HEIGHT_STD)
            for row in range(len(p))
            if row not in (one, other)
        ]
    if "side" in kind or (kind == "distances by radio" and seed % 4 != 3):
        line = p[other] - p[one]
        row = int(np.argmax(np.abs((p - p[one]) @ [-line[1], line[0], 0.0])))
        rows += [(row, axis, p[row, axis] + rng.uniform(-1.0, 1.0), SIDE_STD) for axis in (0, 1)]
    return np.array(rows)
