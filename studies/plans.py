# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""plans: random rooms and halls, planned and solved a second time by an independent solver.

The solver is scipy's `least_squares`, from random starts at each place. Its Cramer-Rao bound is made
of numerical derivatives. It shares the noise model and the definitions with `plan`, and no other code.
Then `plan` runs as a user would run it, and once more with the anchor that it proposes.
"""

from dataclasses import dataclass
from functools import partial
import json
from pathlib import Path
import subprocess
import sys
import tempfile

import numpy as np
from scipy.optimize import least_squares

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import Failure
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.parallel import whole_number
from uwb_tdoa_tools.planning.maps import FLYABLE, IMPRECISE, TOO_FEW, TWO_SOLUTIONS, Demand, Hall
from uwb_tdoa_tools.planning.precision import CLEAR, FLIP, FixedNoise, Installation, RadioNoise
from uwb_tdoa_tools.simulation.config import Room, Walls

from . import table

STATES = {
    FLYABLE: "can be flown",
    TWO_SOLUTIONS: "two solutions",
    IMPRECISE: "imprecise",
    TOO_FEW: "too few",
}
STARTS = 40  # of the solver, at each place
ACCURACY = 0.5  # m, of the bound
CELLS = 3000  # of a map
HEIGHT = 1.2  # m, of the tag on a map with known height
# allowed differences: of shares, of a gain, m of the bound
SHARE, GAIN, PRECISION = (0.03, 0.02, 0.01)


@dataclass(frozen=True)
class Drawn:
    """A room in which all is heard (`reach` inf), or a hall with a wall across its lower part.

    room : Room; anchors : (N, 3) m; noise : of a reception; planar : whether the height is known;
    reach : m; wall : (x, y) m, from (x, 0) to (x, y), or None.
    """

    room: Room
    anchors: np.ndarray
    noise: FixedNoise | RadioNoise
    planar: bool
    reach: float
    wall: tuple[float, float] | None

    @property
    def unknowns(self):
        """Coordinates that TDOAs must determine."""
        return 2 if self.planar else 3

    def heard(self, point):
        """Return the rows of the anchors within reach that no wall hides from a point (3,) m."""
        near = np.linalg.norm(self.anchors - point, axis=1) <= self.reach
        if self.wall is not None:
            x, y = self.wall
            along = (x - point[0]) / (self.anchors[:, 0] - point[0])
            crossing = point[1] + along * (self.anchors[:, 1] - point[1])
            near &= ~((along > 0.0) & (along < 1.0) & (crossing <= y))
        return np.flatnonzero(near)


def add_options(add):
    """Add the options of the study. add : add_argument of a parser."""
    words = "places of each that are solved (default 120)"
    add("--places", type=whole_number, default=120, metavar="N", help=words)
    table.add_options(add, draws=20, first=100)


def run(args):
    """Print a row for each room and hall, and the largest differences."""
    rows = list(table.results(partial(compared, args.places), table.seeds(args), args))
    cli.show(markdown(rows))


def markdown(rows):
    """The table of rows of `compared`."""
    columns = ["", "anchors", "noise", "can be flown, %", "by the solver", "two solutions, %"]
    columns += ["by the solver", "imprecise, %", "by the solver", "promised gain, points", "rerun"]
    lines = [table.head(*columns, "promised bound, m", "rerun")]
    for row in rows:
        pairs = [f"{100.0 * row[how][k]:.1f}" for k in range(3) for how in ("plan", "solver")]
        kind = f"{row['kind']} {row['seed']}{', planar' if row['planar'] else ''}"
        lines.append(table.line([kind, row["anchors"], row["noise"], *pairs, *_gains(row)]))
    worst, gain, bound = np.max([differences(row) for row in rows], axis=0)
    lines.append(
        f"\nLargest differences: shares {100.0 * worst:.1f} points (allowed {100.0 * SHARE:.0f}), "
        f"gain {100.0 * gain:.2f} points (allowed {100.0 * GAIN:.0f}), "
        f"bound {100.0 * bound:.2f} cm (allowed {100.0 * PRECISION:.0f})."
    )
    return "\n".join(lines)


def _gains(row):
    """Return the four cells on the added anchor; empty where `plan` proposes none."""
    promised, rerun = row["promised"], row["rerun"]
    if promised is None:
        return ["none", "", "", ""]
    gains = [f"{100.0 * (one['share'] - row['before']):.1f}" for one in (promised, rerun)]
    bounds = [f"{one['bound']:.3f}" for one in (promised, rerun)]
    return [*gains, *bounds]


def differences(row):
    """Return how far a row is off: (largest of a share, of the promised share, of the bound in m)."""
    share = max(abs(a - b) for a, b in zip(row["plan"], row["solver"]))
    if row["promised"] is None:
        return share, 0.0, 0.0
    promised, rerun = row["promised"], row["rerun"]
    return share, *(abs(promised[key] - rerun[key]) for key in ("share", "bound"))


def compared(places, seed):
    """Return the figures of one room or hall. places : number of points that are solved."""
    rng = np.random.default_rng(seed)
    one = drawn(rng, seed % 2 == 1)
    points = rng.uniform(one.room.lower, one.room.upper, (places, 3))
    return {
        "seed": seed,
        "kind": "hall" if one.wall else "room",
        "anchors": len(one.anchors),
        "planar": one.planar,
        "noise": f"{one.noise.std:.2f} m" if isinstance(one.noise, FixedNoise) else "radio",
        "plan": shares(planned(one, points)),
        "solver": shares(solved(one, points, rng)),
        **promised_and_rerun(one),
    }


def drawn(rng, hall):
    """Return a Drawn room or hall."""
    planar, radio = rng.integers(2, size=2).astype(bool).tolist()
    noise = RadioNoise() if radio else FixedNoise(round(float(rng.uniform(0.05, 0.25)), 2))
    low, high = ([30, 20, 4], [60, 40, 8]) if hall else ([4, 4, 2.5], [12, 12, 4])
    room = Room(np.zeros(3), rng.uniform(low, high).round(1))
    count = int(rng.integers(9, 22) if hall else rng.integers(4 + (not planar), 9))
    anchors = rng.uniform(room.lower, room.upper, (count, 3)).round(2)
    if not hall:
        return Drawn(room, anchors, noise, planar, np.inf, None)
    wall = (round(float(rng.uniform(0.3, 0.7) * room.upper[0]), 2), round(room.upper[1] / 2, 2))
    return Drawn(room, anchors, noise, planar, round(float(rng.uniform(14, 22)), 1), wall)


def shares(status):
    """Return the share of each of STATES."""
    return [float(np.mean(np.array(status) == state)) for state in STATES]


def planned(one, points):
    """Return the states of points (n, 3) m by the library of `plan`."""
    anchors = Anchors.from_positions(one.anchors)
    installation = Installation(anchors, one.noise, dimensions=one.unknowns, hall=True)
    walls = None if one.wall is None else Walls(((one.wall[0], 0.0, *one.wall, np.inf),))
    hall = Hall(installation, Demand(one.room, ACCURACY), one.reach, walls)
    return hall.judge(points)[0].status


def solved(one, points, rng):
    """Return the states of points (n, 3) m by the independent solver."""
    return [_state(one, point, one.heard(point), rng) for point in points]


def _state(one, point, rows, rng):
    if len(rows) <= one.unknowns:
        return TOO_FEW
    anchors = one.anchors[rows]
    if second_minimum(one, point, anchors, rng) <= CLEAR:
        return TWO_SOLUTIONS
    return FLYABLE if bound(one, point, anchors) <= ACCURACY else IMPRECISE


def second_minimum(one, point, anchors, rng):
    """Return the least misfit of a minimum of the TDOAs elsewhere in the room; inf without one."""
    k, best = one.unknowns, np.inf
    variance = one.noise.variance(point[None], Anchors.from_positions(anchors))[0]
    differences = np.diff(np.eye(len(anchors)), axis=0)
    root = np.linalg.inv(np.linalg.cholesky(differences * variance @ differences.T)) @ differences
    true = np.linalg.norm(point - anchors, axis=1)

    def residual(x):
        return root @ (np.linalg.norm(np.append(x, point[k:]) - anchors, axis=1) - true)

    around = min(2.0 * one.reach, 1e3)
    low = np.maximum(one.room.lower, point - around)[:k]
    high = np.minimum(one.room.upper, point + around)[:k]
    for start in rng.uniform(low, high, (STARTS, k)):
        found = least_squares(residual, start, xtol=1e-10, ftol=1e-10, gtol=1e-10, max_nfev=200)
        inside = (found.x >= one.room.lower[:k]).all() and (found.x <= one.room.upper[:k]).all()
        if found.status > 0 and inside and np.linalg.norm(found.x - point[:k]) > FLIP:
            best = min(best, np.sqrt(2.0 * found.cost))
    return best


def bound(one, point, anchors):
    """Return the Cramer-Rao bound of a round, m, of Gaussian errors with a covariance F(x).

    The information is J' F^-1 J + tr(F^-1 F_i F^-1 F_j) / 2, with numerical derivatives.
    """
    differences = np.diff(np.eye(len(anchors)), axis=0)
    among = Anchors.from_positions(anchors)

    def model(x):
        covariance = differences * one.noise.variance(x[None], among)[0] @ differences.T
        return differences @ np.linalg.norm(x - anchors, axis=1), covariance

    weight = np.linalg.inv(model(point)[1])
    means, slopes = [], []
    for step in 1e-4 * np.eye(3)[: one.unknowns]:
        (mean, covariance), (other, another) = model(point + step), model(point - step)
        means.append((mean - other) / 2e-4)
        slopes.append(weight @ (covariance - another) / 2e-4)
    information = np.array(means) @ weight @ np.array(means).T
    information += 0.5 * np.array([[np.trace(a @ b) for b in slopes] for a in slopes])
    if np.linalg.cond(information) > 1e12:
        return np.inf
    return float(np.sqrt(np.trace(np.linalg.inv(information))))


def promised_and_rerun(one):
    """Return {"before": share, "promised", "rerun": {"share", "bound" m, median} or None}."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = _plan(one, one.anchors, folder)
        addition, before = figures["addition"], figures["map"]["flyable_share"]
        if addition is None:
            return {"before": before, "promised": None, "rerun": None}
        after = _plan(one, np.vstack([one.anchors, addition["position"]]), folder)["map"]
    promised, rerun = (
        {"share": it["flyable_share"], "bound": it["bound_flyable"]["median"]}
        for it in (addition, after)
    )
    return {"before": before, "promised": promised, "rerun": rerun}


def _plan(one, anchors, folder):
    """Return plan.json of the command `plan` among anchors (N, 3) m."""
    Anchors.from_positions(anchors).to_yaml(folder / "anchors.yaml")
    size = one.room.upper
    cells = size[:2] if one.planar else size
    words = [
        folder / "anchors.yaml",
        *("--room", 0, size[0], 0, size[1], 0, size[2]),
        *(("--planar", "--height", HEIGHT) if one.planar else ("--volume",)),
        *("--step", round(float((np.prod(cells) / CELLS) ** (1.0 / len(cells))), 3)),
        *("--accuracy", ACCURACY, "--jobs", 1, "--out", folder / "plan"),
    ]
    if isinstance(one.noise, FixedNoise):
        words += ["--noise", one.noise.std]
    if one.wall is not None:
        (x, y), path = one.wall, folder / "walls.yaml"
        write_text(path, f"walls: [[{x}, 0.0, {x}, {y}]]\n")
        words += ["--radio-reach", one.reach, "--walls", path]
    command = [sys.executable, "-m", "uwb_tdoa_tools.commands", "plan", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise Failure(f"plan: ended with code {done.returncode}: {done.stderr}")
    return json.loads((folder / "plan" / "plan.json").read_text())
