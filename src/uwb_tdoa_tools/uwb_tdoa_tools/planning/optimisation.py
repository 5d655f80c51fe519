# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Search better anchors: where they may be, layouts as numbers, gradients of the bound, descents from many layouts, and one more anchor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment, minimize
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.safe_yaml import read_yaml

from ..cli import Progress
from ..simulation.config import facing
from .maps import Chart, Demand, Hall, Judged, Wrap, judge
from .precision import (
    UNUSABLE,
    Installation,
    bound,
    information,
    position_error,
)
from .report import quantiles


class AnchorPlaces:
    """Boxes in which anchors may be. A box may be flat (a wall), thin (a rail) or a point.

    Two numbers between 0 and 1 give a place on flat boxes, three if a box has volume. The first runs
    through all boxes along their longest sides, the others across.
    """

    def __init__(self, boxes: ArrayLike) -> None:
        """Take boxes (B, 6) m: lower x y z and upper x y z of each. Raises InputError."""
        boxes = np.asarray(boxes, dtype=float)
        if boxes.ndim != 2 or boxes.shape[1] != 6 or not len(boxes) or not np.isfinite(boxes).all():
            raise InputError("places: give a list of boxes [x0, y0, z0, x1, y1, z1] in metres.")
        if (boxes[:, 3:] < boxes[:, :3]).any():
            raise InputError(
                "places: a box ends before it begins; write [x0, y0, z0, x1, y1, z1], each x1 "
                ">= x0."
            )
        self.lower, self.size = boxes[:, :3], boxes[:, 3:] - boxes[:, :3]
        self.order = np.argsort(-self.size, axis=1, kind="stable")  # longest side first
        lengths = np.take_along_axis(self.size, self.order, axis=1)
        self.numbers = 3 if (lengths[:, 2] > 0.0).any() else 2
        self.ends = np.cumsum(np.maximum(lengths[:, 0], 1e-3))
        self.starts = self.ends - np.maximum(lengths[:, 0], 1e-3)
        across = np.maximum(lengths[:, 1 : self.numbers].max(axis=0), 1e-3)
        # m, of what each number runs through, at most
        self.lengths = np.append(self.ends[-1], across)

    @classmethod
    def walls(
        cls,
        lower: Sequence[float] | np.ndarray,
        upper: Sequence[float] | np.ndarray,
        lowest: float = 0.2,
        depth: float = 0.0,
    ) -> AnchorPlaces:
        """Return the four walls of a room, and the space within `depth` m of them.

        They reach from `lowest` m above the floor to the ceiling.
        """
        (x0, y0, z0), (x1, y1, z1) = lower, upper
        z0 = min(z0 + lowest, z1)
        return cls(
            [
                (x0, y0, z0, x1, y0 + depth, z1),
                (x1 - depth, y0, z0, x1, y1, z1),
                (x0, y1 - depth, z0, x1, y1, z1),
                (x0, y0, z0, x0 + depth, y1, z1),
            ]
        )

    @classmethod
    def from_yaml(cls, path: str | Path) -> AnchorPlaces:
        """Read `places: [[x0, y0, z0, x1, y1, z1], ...]`. Raises InputError."""
        content = read_yaml(path)
        try:
            return cls(content["places"])
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}: is no list of places ({error!r}); write 'places: [[x0, y0, z0, x1, "
                "y1, z1]]'."
            ) from error

    def positions(self, numbers: np.ndarray) -> np.ndarray:
        """Return the positions (..., 3) m of (..., self.numbers) numbers between 0 and 1."""
        at = np.clip(numbers[..., 0], 0.0, 1.0) * self.ends[-1]
        box = np.minimum(np.searchsorted(self.ends, at), len(self.ends) - 1)
        along = (at - self.starts[box]) / (self.ends[box] - self.starts[box])
        share = np.zeros((*at.shape, 3))
        for k, value in enumerate([along, *np.moveaxis(numbers[..., 1:], -1, 0)]):
            np.put_along_axis(share, self.order[box][..., k : k + 1], value[..., None], axis=-1)
        return self.lower[box] + share * self.size[box]

    def grid(self, count: int) -> np.ndarray:
        """Return the numbers of about `count` places, evenly spread: (n, self.numbers)."""
        side = max(2, round(count ** (0.8 / self.numbers)))
        along = max(2, count // side ** (self.numbers - 1))
        axes = [np.linspace(0.0, 1.0, along), *[np.linspace(0.0, 1.0, side)] * (self.numbers - 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.numbers)

    def nearest(self, wanted: ArrayLike) -> np.ndarray:
        """Return the numbers of the places nearest to `wanted` (n, 3) m: (n, self.numbers).

        They are strictly between 0 and 1, and approximate.
        """
        numbers = 0.01 + 0.98 * self.grid(4000)
        away = np.linalg.norm(self.positions(numbers) - np.asarray(wanted)[:, None], axis=-1)
        return numbers[np.argmin(away, axis=1)]


def lattice(
    lower: Sequence[float] | np.ndarray, upper: Sequence[float] | np.ndarray, step: float
) -> np.ndarray:
    """Return points at most `step` m apart that fill a box and its faces: (n, 3) m."""
    counts = [
        max(1, int(np.ceil((high - low) / step - 1e-9))) + 1 for low, high in zip(lower, upper)
    ]
    axes = [np.unique(np.linspace(*ends)) for ends in zip(lower, upper, counts)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of `count` points (n, 3) m that are far from each other.

    The corners come first, then the points between them.
    """
    diagonals = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    rows = list(np.unique(np.argmax(points @ diagonals.T, axis=0)))
    away = np.min([np.linalg.norm(points - points[row], axis=1) for row in rows], axis=0)
    while len(rows) < min(count, len(points)):
        rows.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[rows[-1]], axis=1))
    return np.array(rows[:count])


@dataclass(frozen=True)
class Goal:
    """Score of a layout of anchors.

    points : (n, 3) m, to be located; installation : everything but the anchors; demand : Demand
    """

    points: np.ndarray
    installation: Installation
    demand: Demand = field(default_factory=Demand)

    def errors(self, anchors: Anchors, points: np.ndarray | None = None) -> np.ndarray:
        """Return the bound at the points (default: its own): (n,) m, at most UNUSABLE.

        The small second term of eq. 1 is left out.
        """
        points = self.points if points is None else points
        installation = self.installation.with_anchors(anchors)
        found = position_error(bound(information(points, installation, correction=False)))
        return np.fmin(found, UNUSABLE)

    def figures(self, anchors: Anchors) -> dict[str, float]:
        """Return {"worst", "mean": m, of the bound; "failing": share that cannot be flown}."""
        errors = self.errors(anchors)
        judged = judge(self.points, replace(self.installation, anchors=anchors), self.demand)
        return {
            "worst": float(errors.max()),
            "mean": float(errors.mean()),
            "failing": float(1.0 - np.mean(judged.flyable)),
        }

    def score(self, anchors: Anchors) -> float:
        """Return the worst bound in m, times 1 to 2 for the share of points that fail."""
        try:
            found = self.figures(anchors)
        except InputError:
            return 2.0 * UNUSABLE
        return found["worst"] * (1.0 + found["failing"])


_ARM = 3.0  # m; to move an anchor so far changes about as much as to turn it by 1 rad


@dataclass(frozen=True)
class Layout:
    """Anchors as a vector x of numbers of about the same effect.

    x holds for each anchor the numbers of AnchorPlaces, times their length over an arm, then a
    rotation vector, rad.

    count : anchors to place; target : (3,) m, which antennas face, with their axis upright, before
    the rotation; turned : False if antennas radiate alike in all directions, like anchors without a
    surveyed orientation.
    """

    places: AnchorPlaces
    count: int
    target: np.ndarray
    turned: bool = True

    @property
    def width(self) -> int:
        """Numbers per anchor."""
        return self.places.numbers + 3 * self.turned

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """The (low, high) of each number of x."""
        return (
            [(0.0, length / _ARM) for length in self.places.lengths]
            + [(-np.pi, np.pi)] * 3 * self.turned
        ) * self.count

    def start(self, numbers: np.ndarray) -> np.ndarray:
        """Return x for place numbers (count, places.numbers), with antennas that are not rotated."""
        placed = np.reshape(numbers, (self.count, -1)) * self.places.lengths / _ARM
        return np.hstack([placed, np.zeros((self.count, 3 * self.turned))]).ravel()

    def anchors(self, x: np.ndarray) -> Anchors:
        """Return the Anchors of x."""
        placed = self._placed(np.reshape(x, (self.count, self.width)))
        return Anchors(np.arange(self.count), *placed)

    def _placed(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (n, 3) m and orientations (n, 4) of rows (n, width)."""
        n = self.places.numbers
        new = facing(self.places.positions(rows[:, :n] * _ARM / self.places.lengths), self.target)
        if not self.turned:
            return new.positions, np.full((len(rows), 4), np.nan)
        return new.positions, (
            Rotation.from_rotvec(rows[:, n:]) * Rotation.from_quat(new.orientations)
        ).as_quat()


def free_ids(taken: np.ndarray, count: int) -> np.ndarray:
    """Return the `count` smallest ids that are not taken."""
    return np.setdiff1d(np.arange(count + taken.max() + 1), taken)[:count]


LEAST_GAIN = 1e-4  # of the log of the bound: a step that gains less is the last


def descend(
    goal: Goal, layout: Layout, points: np.ndarray, x: np.ndarray, sweeps: int
) -> np.ndarray:
    """Return x after at most `sweeps` steps of SLSQP towards the goal's bound at points (n, 3) m.

    The worst case is not smooth. The smallest s that no log error exceeds is smooth, with one
    constraint per point. Which layout fails least is no part of a descent: `Goal.score` judges the ends.
    """
    size, (low, high) = len(x), np.transpose(layout.bounds)

    def log_errors(x: np.ndarray) -> np.ndarray:
        x = np.clip(np.nan_to_num(x), low, high)  # SLSQP has been seen to ask for NaN
        return np.log(goal.errors(layout.anchors(x), points))

    def worst(z: np.ndarray) -> tuple[float, np.ndarray]:
        return z[size], np.append(np.zeros(size), 1.0)

    x = np.clip(x, low, high)
    options: dict[str, Any] = {"jac": True, "method": "SLSQP"}
    options["options"] = {"maxiter": sweeps, "ftol": LEAST_GAIN}
    z, bounds = np.append(x, log_errors(x).max()), [*layout.bounds, (None, None)]
    constraint = {"type": "ineq", "fun": lambda z: z[size] - log_errors(z[:size])}
    found = minimize(worst, z, bounds=bounds, constraints=[constraint], **options)
    return np.clip(np.nan_to_num(found.x[:size]), low, high)


BESIDE = 1.0  # m; no anchor is proposed nearer to another
SEED = 0  # of the starts, and of the points at which they are judged
ROUGH = 80  # points that the starts are judged at
DRAWN = 16  # layouts drawn for every start; the best are taken
SWEEPS = 40  # steps of one descent
FINALISTS = 4  # how many of the layouts that the starts led to are refined
EXCHANGES = 4  # how often the worst points between those looked at are added
ADDED = 30  # points each time, about
CLOSE = 1.002  # worst error over the worst looked at, with which none are added


def optimise(
    goal: Goal,
    places: AnchorPlaces,
    count: int,
    start: np.ndarray | None = None,
    starts: int = 16,
    progress: Wrap = iter,
) -> Anchors:
    """Return Anchors at the `count` best places, in the best directions.

    goal : Goal; places : AnchorPlaces; start : (count, 3) m, a layout to begin with besides the
    quasi-random ones; starts : number of these; progress : wraps the starts.
    Each start descends at a few of the goal's points. The best ends descend again, with the worst
    points added. The best score at all points wins.
    """
    # directions are part of a layout only if one is known
    turned = bool(np.isfinite(goal.installation.anchors.orientations).all(axis=1).any())
    layout = Layout(places, count, goal.points.mean(axis=0), turned)
    rows = spread(goal.points, ROUGH)
    looked_at = replace(goal, points=goal.points[rows])
    from scipy.stats import qmc  # takes a second to import

    drawn = qmc.Halton(count * places.numbers, seed=SEED).random(DRAWN * starts)
    begin = [layout.start(numbers) for numbers in drawn]
    begin = sorted(begin, key=lambda x: looked_at.score(layout.anchors(x)))[:starts]
    if start is not None:
        begin.append(layout.start(places.nearest(start)))
    ends = [descend(goal, layout, looked_at.points, x, SWEEPS) for x in progress(begin)]
    ends.sort(key=lambda x: goal.score(layout.anchors(x)))
    ends = [_refined(goal, layout, x, rows) for x in ends[:FINALISTS]]
    found = [layout.anchors(x) for x in ends]
    best = min([each for each in found if not _beside(each)] or found, key=goal.score)
    if goal.score(best) >= UNUSABLE:
        raise InputError("places: no layout of these anchors locates a tag; allow more places.")
    return best


def with_one(anchors: Anchors, position: np.ndarray) -> Anchors:
    """Return Anchors with one more at position (3,) m, of unknown orientation."""
    return Anchors(
        np.append(anchors.ids, free_ids(anchors.ids, 1)),
        np.vstack([anchors.positions, position]),
        np.vstack([anchors.orientations, np.full(4, np.nan)]),
        anchors.frame,
    )


def with_old_ids(better: Anchors, before: Anchors) -> Anchors:
    """Return Anchors with the ids of the nearest anchors before.

    The assignment moves the anchors as little as possible in all. Additional anchors get new ids.
    """
    away = np.linalg.norm(better.positions[:, None] - before.positions, axis=2)
    rows, old = linear_sum_assignment(away)
    ids = np.empty(len(better), int)
    ids[np.setdiff1d(np.arange(len(better)), rows)] = free_ids(before.ids, len(better) - len(rows))
    ids[rows] = before.ids[old]
    order = np.argsort(ids)
    return Anchors(ids[order], better.positions[order], better.orientations[order], before.frame)


def rounded(better: Anchors, before: Anchors) -> Anchors:
    """Return the Anchors to the centimetre and the degree. Anchors that stay do not change."""
    moved = _moved(better, before)
    positions, orientations = better.positions.copy(), better.orientations.copy()
    positions[moved] = positions[moved].round(2)
    turned = moved & np.isfinite(orientations).all(axis=1)
    if turned.any():
        angles = Rotation.from_quat(orientations[turned]).as_euler("ZYX", degrees=True).round()
        orientations[turned] = Rotation.from_euler("ZYX", angles, degrees=True).as_quat().round(4)
    return Anchors(better.ids, positions, orientations, better.frame)


def placements(better: Anchors, before: Anchors) -> list[dict[str, Any]]:
    """Return [{"id", "words"}] of the Anchors that move: their new place and direction."""
    rows = before.index(better.ids)
    found = []
    for row in np.flatnonzero(_moved(better, before)).tolist():
        position, q = better.positions[row], better.orientations[row]
        words = ("new, at" if rows[row] < 0 else "to") + " ({:.2f}, {:.2f}, {:.2f})".format(
            *position
        )
        if rows[row] >= 0:
            words += f", by {np.linalg.norm(position - before.positions[rows[row]]):.2f} m"
        if np.isfinite(q).all():
            yaw, pitch, roll = Rotation.from_quat(q).as_euler("ZYX", degrees=True).round()
            words += (
                f", its front turned {yaw:.0f} deg from x towards y, {pitch:.0f} deg downwards, "
                f"rolled by {roll:.0f} deg"
            )
        found.append({"id": int(better.ids[row]), "words": words})
    return found


def _moved(better: Anchors, before: Anchors) -> np.ndarray:
    """Return which Anchors are new, or more than a millimetre from where they were: (n,) bool."""
    rows = before.index(better.ids)
    return (rows < 0) | (np.linalg.norm(better.positions - before.positions[rows], axis=1) > 1e-3)


def _beside(anchors: Anchors) -> bool:
    """Return whether two Anchors are nearer than BESIDE."""
    away = np.linalg.norm(
        anchors.positions[:, None] - anchors.positions, axis=2
    ) + 2.0 * BESIDE * np.eye(len(anchors))
    return bool((away < BESIDE).any())


def _refined(goal: Goal, layout: Layout, x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return x after descents at these rows of the goal's points and at the worst others.

    Returns x itself if no descent is better.
    """
    best, score = x, goal.score(layout.anchors(x))
    for _ in range(EXCHANGES):
        errors = goal.errors(layout.anchors(x))
        if errors.max() <= CLOSE * errors[rows].max():
            break
        worst = np.argsort(-errors)[: 1 + len(errors) // 20]
        rows = np.union1d(rows, worst[spread(goal.points[worst], ADDED)])
        x = descend(goal, layout, goal.points[rows], x, SWEEPS)
        found = goal.score(layout.anchors(x))
        if found < score:
            best, score = x, found
    return best


LOOKED_AT = 600  # cells on which all places are tried
VERIFIED = 4  # places that are judged on all cells
# value of a bound that falls to 0, as a share of the room: halving it counts like 10 % more room
PRECISION_WEIGHT = 0.2
# An anchor that gains less than both is not worth it.
LEAST_SHARE = 0.01  # of the room
LEAST_PRECISION = 0.05  # of the bound


def best_addition(
    hall: Hall, found: Chart, places: np.ndarray, progress: Progress
) -> dict[str, Any] | None:
    """Return the gain of one more anchor at the best of some places; None if it is not worth it.

    places : (m, 3) m; found : Chart of the Hall. All places are tried on some cells, the best on all.
    Returns {"position" (3,) m, "flyable_share", "bound_flyable": quantiles, m, of a plan with it;
    "gain": share of the cells; "bound_before", "bound_after": m, median where it can be flown
    without it}.
    """
    points = found.grid.points
    away = np.linalg.norm(places[:, None] - hall.anchors.positions, axis=2).min(axis=1)
    places = places[away >= BESIDE]
    if len(points) <= 4 * LOOKED_AT:
        rows = np.sort(spread(points, LOOKED_AT))
    else:
        rows = np.sort(np.random.default_rng(0).permutation(len(points))[:LOOKED_AT])
    before = found.subset(rows)

    def gains(before: Judged, points: np.ndarray, place: np.ndarray) -> dict[str, Any]:
        more = with_one(hall.anchors, place)
        return _gains(before, hall.changed(before, points, more, place[None]), place)

    promised = [
        _value(gains(before, points[rows], place))
        for place in progress.over(places, what="places for one more anchor")
    ]
    best: dict[str, Any] | None = None
    for number in np.argsort(-np.array(promised), kind="stable")[:VERIFIED]:
        if best is not None and promised[number] <= _value(best):
            break  # the others promise less than this gain
        progress("judging the best place on the whole map")
        judged = gains(found, points, places[number])
        if best is None or _value(judged) > _value(best):
            best = judged
    if best is None or (best["gain"] < LEAST_SHARE and _finer(best) < LEAST_PRECISION):
        return None
    return best


def _finer(gains: dict[str, Any]) -> float:
    """Return by which share the bound falls where it could be flown before."""
    return 1.0 - gains["bound_after"] / gains["bound_before"] if gains["bound_before"] else 0.0


def _value(gains: dict[str, Any]) -> float:
    """Return the value of an anchor: gained share of the cells, and precision where it could be flown."""
    return gains["gain"] + PRECISION_WEIGHT * _finer(gains)


def _gains(before: Judged, after: Judged, place: np.ndarray) -> dict[str, Any]:
    """Return what one more anchor at `place` (3,) m changes, as of `best_addition`.

    Bounds are compared where the tag could be flown before, else new cells at the edge would count
    as less precise. before, after : Judged of the same cells without and with the anchor
    """
    flyable = before.flyable
    medians: list[float | None] = [None, None]
    if flyable.any():
        medians = [float(np.median(judged.error[flyable])) for judged in (before, after)]
    return {
        "position": place.tolist(),
        "flyable_share": float(after.flyable.mean()),
        "bound_flyable": quantiles(after.error[after.flyable]),
        "gain": float(after.flyable.mean() - before.flyable.mean()),
        "bound_before": medians[0],
        "bound_after": medians[1],
    }
