"""Better places and directions for the anchors."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import expit
from scipy.stats import qmc

from uwb_tdoa_bias.anchors import Anchors
from uwb_tdoa_bias.errors import InputError

from ..simulation.constellations import facing
from .bifurcation import CLEAR, Subsets
from .pairing import PAIRINGS
from .precision import bound, information, position_error

OBJECTIVES = ("worst", "mean")
UNUSABLE = 100.0  # m, what an infinite bound counts for, and a layout from which no position follows
SHARP = 16  # power of the mean that stands for the worst case where derivatives are needed
SOFT = 0.05  # of |q|^2 - 1, over which failure sets in where derivatives are needed
FINALISTS = 4  # how many of the layouts that the starts led to are refined


class Places:
    """Where anchors may be: boxes, which may be flat (a wall), thin (a rail) or a point.

    Two numbers between 0 and 1 for a place on flat boxes, three where a box has volume: the first runs through all
    boxes along their longest sides, the others across."""

    def __init__(self, boxes):
        """boxes : (B, 6) lower x y z and upper x y z of each, m. Raises InputError."""
        boxes = np.asarray(boxes, dtype=float)
        if boxes.ndim != 2 or boxes.shape[1] != 6 or not len(boxes) or not np.isfinite(boxes).all():
            raise InputError("places: give a list of boxes [x0, y0, z0, x1, y1, z1] in metres.")
        if (boxes[:, 3:] < boxes[:, :3]).any():
            raise InputError("places: a box ends before it begins; write [x0, y0, z0, x1, y1, z1], each x1 >= x0.")
        self.lower, self.size = boxes[:, :3], boxes[:, 3:] - boxes[:, :3]
        self.order = np.argsort(-self.size, axis=1, kind="stable")  # longest side first
        lengths = np.take_along_axis(self.size, self.order, axis=1)
        self.numbers = 3 if (lengths[:, 2] > 0.0).any() else 2
        self.ends = np.cumsum(np.maximum(lengths[:, 0], 1e-3))
        self.starts = self.ends - np.maximum(lengths[:, 0], 1e-3)

    @classmethod
    def walls(cls, lower, upper, lowest=0.2):
        """The four walls of a room from `lowest` m above its floor to its ceiling."""
        (x0, y0, z0), (x1, y1, z1) = lower, upper
        z0 = min(z0 + lowest, z1)
        return cls(
            [(x0, y0, z0, x1, y0, z1), (x1, y0, z0, x1, y1, z1), (x0, y1, z0, x1, y1, z1), (x0, y0, z0, x0, y1, z1)]
        )

    @classmethod
    def from_yaml(cls, path):
        """Read `places: [[x0, y0, z0, x1, y1, z1], ...]`; raises InputError."""
        try:
            return cls(yaml.safe_load(Path(path).read_text())["places"])
        except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{path}: is no list of places ({error!r}); write 'places: [[x0, y0, z0, x1, y1, z1]]'."
            ) from error

    def positions(self, numbers):
        """(..., 3) m of (..., self.numbers) numbers between 0 and 1."""
        at = np.clip(numbers[..., 0], 0.0, 1.0) * self.ends[-1]
        box = np.minimum(np.searchsorted(self.ends, at), len(self.ends) - 1)
        along = (at - self.starts[box]) / (self.ends[box] - self.starts[box])
        share = np.zeros((*at.shape, 3))
        for k, value in enumerate([along, *np.moveaxis(numbers[..., 1:], -1, 0)]):
            np.put_along_axis(share, self.order[box][..., k : k + 1], value[..., None], axis=-1)
        return self.lower[box] + share * self.size[box]

    def grid(self, count):
        """Numbers of about `count` places all over: (n, self.numbers)."""
        side = max(2, round(count ** (0.8 / self.numbers)))
        along = max(2, count // side ** (self.numbers - 1))
        axes = [np.linspace(0.0, 1.0, along), *[np.linspace(0.0, 1.0, side)] * (self.numbers - 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.numbers)

    def nearest(self, wanted):
        """Numbers (n, self.numbers), strictly between 0 and 1, of about the places nearest to `wanted` (n, 3), m."""
        numbers = 0.01 + 0.98 * self.grid(4000)
        away = np.linalg.norm(self.positions(numbers) - np.asarray(wanted)[:, None], axis=-1)
        return numbers[np.argmin(away, axis=1)]


@dataclass(frozen=True)
class Goal:
    """What a layout is judged by.

    points : (n, 3) m, where the tag is to be located; installation : what is not the anchors; pairing : name of
    PAIRINGS
    objective : "worst" or "mean" bound over the points; criterion : of maps.FLYABLE, what counts as failure
    """

    points: np.ndarray
    installation: object
    pairing: str = "ring"
    objective: str = "worst"
    criterion: str = "pairings"

    def installed(self, anchors):
        """The Installation with other Anchors. Raises InputError for anchors that locate nothing."""
        return replace(self.installation, anchors=anchors, pairing=PAIRINGS[self.pairing](len(anchors)))

    def errors(self, anchors):
        """Bound at the points, without the small second term of eq. 1: (n,) m. Raises InputError for useless
        anchors."""
        found = position_error(bound(information(self.points, self.installed(anchors), correction=False)))
        return np.minimum(found, UNUSABLE)

    def judge(self, anchors):
        """{"worst", "mean": m, bound over the points; "failing": share of the points that are not flyable}."""
        errors, installation = self.errors(anchors), self.installed(anchors)
        subsets = Subsets(anchors, installation.dimensions)
        if self.criterion == "pairings":
            unique = subsets.ambiguous(self.points) == 0.0
        else:
            unique = subsets.separation(self.points, installation) > CLEAR
        failing = 1.0 - np.mean(unique & installation.inside_hull(self.points))
        return {"worst": float(errors.max()), "mean": float(errors.mean()), "failing": float(failing)}

    def score(self, anchors):
        """What is minimised: the objective, m, twice that where the tag fails at all points."""
        try:
            found = self.judge(anchors)
        except InputError:
            return 2.0 * UNUSABLE
        return found[self.objective] * (1.0 + found["failing"])

    def smooth(self, anchors):
        """A stand-in for the score that has derivatives, m."""
        try:
            errors = self.errors(anchors)
            single = 1.0
            if self.criterion == "pairings":
                subsets = Subsets(anchors, self.installation.dimensions)
                single = float(expit(-subsets.discriminant(self.points) / SOFT).prod(axis=1).mean())
        except InputError:
            return 2.0 * UNUSABLE
        power = SHARP if self.objective == "worst" else 1
        return UNUSABLE * float(np.mean((errors / UNUSABLE) ** power) ** (1.0 / power)) * (2.0 - single)


@dataclass(frozen=True)
class Layout:
    """What is free and what is not, as a vector of numbers. count : anchors to place; fixed : Anchors that stay, or
    None;
    target : (3,) m, what new antennas face, their axis upright, before they are turned."""

    places: Places
    count: int
    fixed: Anchors | None
    target: np.ndarray

    def anchors(self, numbers, turns=()):
        """Anchors of (count * places.numbers,) numbers between 0 and 1 and of rotation vectors, (3 count,) rad or
        none."""
        new = facing(self.places.positions(np.reshape(numbers, (self.count, -1))), self.target)
        q = new.orientations
        if len(turns):
            q = (Rotation.from_rotvec(np.reshape(turns, (-1, 3))) * Rotation.from_quat(q)).as_quat()
        if self.fixed is None:
            return Anchors(new.ids, new.positions, q)
        taken = self.fixed.ids
        ids = np.setdiff1d(np.arange(self.count + taken.max() + 1), taken)[: self.count]
        return Anchors(
            np.append(taken, ids),
            np.vstack([self.fixed.positions, new.positions]),
            np.vstack([self.fixed.orientations, q]),
            self.fixed.frame,
        )


def optimise(goal, places, count, fixed=None, start=None, starts=32, seed=0, progress=iter):
    """Anchors at the `count` best places, turned in the best directions; after those of `fixed`, which stay.

    goal : Goal; places : Places; start : (count, 3) m, a layout to begin with besides the random ones; progress : wraps
    the starts, e.g. tqdm. L-BFGS-B (scipy.optimize) over the places from `starts` quasi-random layouts, then over
    places and directions from the best of what they led to; the one with the best score is taken."""
    layout = Layout(places, count, fixed, goal.points.mean(axis=0))
    size = count * places.numbers
    bounds = [(0.0, 1.0)] * size + [(-np.pi, np.pi)] * (3 * count)

    def descend(x):
        found = minimize(
            lambda x: goal.smooth(layout.anchors(x[:size], x[size:])), x, method="L-BFGS-B", bounds=bounds[: len(x)],
            options={"maxiter": 40},
        )  # fmt: skip
        return min(((goal.score(layout.anchors(y[:size], y[size:])), k, y) for k, y in enumerate((x, found.x))))[::2]

    begin = list(qmc.Sobol(size, seed=seed).random(starts))
    if start is not None:
        begin.append(places.nearest(start).ravel())
    ends = sorted((descend(x) for x in progress(begin)), key=lambda end: end[0])
    ends += [descend(np.append(x, np.zeros(3 * count))) for _, x in progress(ends[:FINALISTS])]
    score, x = min(ends, key=lambda end: end[0])
    if score >= UNUSABLE:
        raise InputError("places: no layout of these anchors locates a tag; allow more places.")
    return layout.anchors(x[:size], x[size:])


def one_more(goal, anchors, places, count=400):
    """What one more anchor would give at places all over: (positions (n, 3) m, scores (n,) m), facing the points."""
    layout = Layout(places, 1, anchors, goal.points.mean(axis=0))
    numbers = places.grid(count)
    return places.positions(numbers), np.array([goal.score(layout.anchors(x)) for x in numbers])
