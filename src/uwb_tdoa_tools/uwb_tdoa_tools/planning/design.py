"""Anchors for a hall in which none hang yet: how many, how far apart, how high, and which way they
face.

Regular patterns, from sparse to dense, whose margins, stagger and heights `scipy.optimize.minimize`
chooses, until the wanted share of the hall can be flown. Then anchors are taken away one by one
while it still can, the neighbours of each being moved likewise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import expit

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

from ..simulation.constellations import facing
from .goal import UNUSABLE

if TYPE_CHECKING:
    from ..parallel import Progress
    from ..simulation.room import Room
    from .hall import Hall
    from .judging import Judged

FIRST = (
    0.4,
    0.4,
    0.1,
    0.1,
    0.85,
)  # of the first pattern: margins, stagger and heights, see `_pattern`
LOWEST = 0.5  # m above the floor, of an anchor
SPACINGS = (
    1.2,
    0.25,
    0.88,
)  # of the reach: the first pattern, the densest, and each over the one before
MOST = 400  # anchors of a pattern that is tried
SEARCHED = 500  # places that a search looks at
# of the logarithm of the bound, over which a place turns from precise to imprecise while a search
# goes on
SOFT = 0.15
FINE = 0.02  # what the mean logarithm of the bound counts for beside the share
TRIALS, MOVES, TURNS = (
    60,
    40,
    10,
)  # layouts of one pattern, of an anchor that is moved, directions of one
MOVED = 3  # neighbours of an anchor that is taken away
FARTHEST = 4.0  # m that they are moved by, along each axis


@dataclass(frozen=True)
class Step:
    """One layout of a search. count : anchors; spacing : m, root of the area over their number;
    share : that can be flown; median, most : m, median and 95 % of the bound there, None where
    nowhere.
    """

    count: int
    spacing: float
    share: float
    median: float | None
    most: float | None


def step_of(found: Judged, anchors: Anchors, room: Room) -> Step:
    """Step of Judged places."""
    errors, size = found.error[found.flyable], room.upper - room.lower
    quantiles = np.quantile(errors, [0.5, 0.95]).tolist() if len(errors) else [None, None]
    return Step(
        len(anchors),
        float(np.sqrt(size[0] * size[1] / len(anchors))),
        float(found.flyable.mean()),
        *quantiles,
    )


def design(
    hall: Hall, room: Room, points: np.ndarray, share: float, progress: Progress
) -> tuple[list[Anchors], list[Step]]:
    """(layouts, steps) for a Room of which a share of the points (n, 3) m is to be flown: Anchors,
    the fewest first, and Steps.
    hall : Hall, whose anchors are not used. Raises InputError where no pattern gives that.
    """
    points = points[np.sort(np.random.default_rng(0).permutation(len(points))[:SEARCHED])]
    rough, steps, anchors, x = _roughly(hall), [], None, np.array(FIRST)
    for columns, rows in _patterns(room, hall.reach):
        progress(f"layouts of {columns} x {rows} anchors")
        x = _best_pattern(rough, room, points, columns, rows, x)
        found = _pattern(room, columns, rows, x)
        judged = _judged(hall.of(found), points)
        steps.append(step_of(judged, found, room))
        if anchors is not None:
            break  # one pattern more, to say what it costs
        if judged.flyable.mean() >= share:
            anchors = found
    if anchors is None:
        most = max(steps, key=lambda step: step.share)
        raise InputError(
            f"share: {100.0 * share:.0f} % of the hall cannot be flown at an accuracy of "
            f"{hall.goal.demand.accuracy:g} m; {most.count} "
            f"anchors give {100.0 * most.share:.0f} %. Give a larger --accuracy, a smaller "
            "--share, or a known height (--planar, --with height)."
        )
    layouts, more = _pruned(hall, room, points, share, anchors, progress)
    progress("directions of the anchors")
    return [_turned(rough, points, each) for each in layouts[:2]] + layouts[2:], _worth(
        steps + more
    )


def _worth(steps: list[Step]) -> list[Step]:
    """The Steps of which more of the hall can be flown than of any with fewer anchors, the fewest
    first.
    """
    out: list[Step] = []
    for step in sorted(steps, key=lambda step: (step.count, -step.share)):
        if not out or step.share > out[-1].share:
            out.append(step)
    return out


def _patterns(room: Room, reach: float) -> list[tuple[int, int]]:
    """(columns, rows) of patterns, from sparse to dense."""
    first, last, ratio = SPACINGS
    size, out, spacing = (
        room.upper - room.lower,
        [],
        first * min(reach, float((room.upper - room.lower)[:2].max())),
    )
    while spacing > last * min(reach, float(size[:2].max())):
        columns, rows = (max(2, round(side / spacing)) for side in size[:2])
        if columns * rows >= 4 and columns * rows <= MOST and (columns, rows) not in out:
            out.append((columns, rows))
        spacing *= ratio
    return out


def _pattern(room: Room, columns: int, rows: int, x: np.ndarray) -> Anchors:
    """Anchors of a pattern. x : (5,) from 0 to 1: margins along x and y, up to half a pitch;
    stagger of every other row, up to a quarter; heights of one half of the anchors, and of the
    other, which alternate.
    """
    size, (i, j) = room.upper - room.lower, np.indices((columns, rows)).reshape(2, -1)
    pitch = size[:2] / (np.array([columns, rows]) - 1 + x[:2])
    across = np.column_stack([i, j]) * pitch + 0.5 * x[:2] * pitch
    across[:, 0] += np.where(j % 2 == 1, 0.25, -0.25) * x[2] * pitch[0]
    height = LOWEST + np.where((i + j) % 2 == 0, x[3], x[4]) * max(size[2] - LOWEST, 0.0)
    return _facing(np.column_stack([np.clip(across, 0.0, size[:2]), height]) + room.lower, room)


def _facing(positions: np.ndarray, room: Room) -> Anchors:
    return facing(positions.round(1), room.centre)


def _best_pattern(
    rough: Hall, room: Room, points: np.ndarray, columns: int, rows: int, start: np.ndarray
) -> np.ndarray:
    """x of the best `_pattern`, from a start."""
    simplex = np.vstack([start, start + np.where(start < 0.5, 0.3, -0.3) * np.eye(len(start))])
    found = minimize(
        lambda x: _cost(rough, points, _pattern(room, columns, rows, np.clip(x, 0.0, 1.0))),
        start,
        method="Nelder-Mead",
        bounds=[(0.0, 1.0)] * len(start),
        options={"maxfev": TRIALS, "initial_simplex": simplex},
    )
    return np.clip(found.x, 0.0, 1.0)


def _judged(hall: Hall, points: np.ndarray) -> Judged:
    """Judged of points all over a hall."""
    nothing = hall.nothing(points)
    return hall.changed(nothing, points, hall.anchors, hall.anchors.positions)


def _cost(rough: Hall, points: np.ndarray, anchors: Anchors) -> float:
    return _cost_of(_judged(rough.of(anchors), points), rough)


def _cost_of(found: Judged, rough: Hall) -> float:
    """What is minimised: a smooth share of the places that are imprecise, and a little of the
    bound.
    """
    log = np.log(np.minimum(found.error, UNUSABLE))
    return float(
        np.mean(expit((log - np.log(rough.goal.demand.accuracy)) / SOFT)) + FINE * log.mean()
    )


def _pruned(
    hall: Hall, room: Room, points: np.ndarray, share: float, anchors: Anchors, progress: Progress
) -> tuple[list[Anchors], list[Step]]:
    """Anchors less more and more of those without which the share can still be flown, the fewest
    first; and a Step for each that was tried.
    """
    layouts, steps, rough = [anchors], [], _roughly(hall)
    while len(anchors) > hall.goal.installation.unknowns + 1:
        progress(f"layouts of {len(anchors) - 1} anchors")
        now = _judged(rough.of(anchors), points)
        costs = []
        for row in range(len(anchors)):
            rest = anchors.only(np.delete(np.arange(len(anchors)), row))
            costs.append(
                _cost_of(rough.changed(now, points, rest, anchors.positions[[row]]), rough)
            )
        gone = int(np.argmin(costs))
        fewer = anchors.only(np.delete(np.arange(len(anchors)), gone))
        for row in np.argsort(np.linalg.norm(fewer.positions - anchors.positions[gone], axis=1))[
            :MOVED
        ]:
            fewer = _moved(rough, room, points, fewer, int(row))
        judged = _judged(hall.of(fewer), points)
        steps.append(step_of(judged, fewer, room))
        if judged.flyable.mean() < share:
            break
        anchors = fewer
        layouts.insert(0, anchors)
    return layouts, steps


def _roughly(hall: Hall) -> Hall:
    """The same Hall, judged as quickly as a search needs."""
    return replace(hall, goal=replace(hall.goal, demand=replace(hall.goal.demand, quick=True)))


def _moved(rough: Hall, room: Room, points: np.ndarray, anchors: Anchors, row: int) -> Anchors:
    """Anchors with one moved to where the cost is least nearby."""
    start = anchors.positions[row]
    low = np.maximum(
        start - FARTHEST, room.lower + [0.0, 0.0, min(LOWEST, (room.upper - room.lower)[2])]
    )
    high = np.minimum(start + FARTHEST, room.upper)
    before = _judged(rough.of(anchors), points)

    def at(place: np.ndarray) -> Anchors:
        return _facing(
            np.insert(np.delete(anchors.positions, row, axis=0), row, place, axis=0), room
        )

    def cost(place: np.ndarray) -> float:
        return _cost_of(rough.changed(before, points, at(place), np.stack([start, place])), rough)

    options = {"maxfev": MOVES, "initial_simplex": _simplex(start, low, high)}
    found = minimize(
        cost, start, method="Nelder-Mead", bounds=list(zip(low, high)), options=options
    )
    return at(found.x) if found.fun < cost(start) else anchors


def _simplex(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(4, 3) places to begin with, half-way to the farther bound along each axis."""
    steps = np.where(high - start >= start - low, high - start, low - start)
    return np.vstack([start, start + 0.5 * np.diag(steps)])


def _turned(rough: Hall, points: np.ndarray, anchors: Anchors) -> Anchors:
    """Anchors, each turned about the vertical to where the cost is least."""
    for row in range(len(anchors)):
        before = _judged(rough.of(anchors), points)

        def at(yaw: float, row: int = row) -> Anchors:
            orientations = anchors.orientations.copy()
            orientations[row] = Rotation.from_euler("z", yaw, degrees=True).as_quat().round(4)
            return Anchors(anchors.ids, anchors.positions, orientations, anchors.frame)

        def cost(yaw: float, row: int = row, before: Judged = before) -> float:
            return _cost_of(
                rough.changed(before, points, at(yaw, row), anchors.positions[[row]]), rough
            )

        found = minimize_scalar(
            cost, bounds=(-180.0, 180.0), method="bounded", options={"maxiter": TURNS}
        )
        if found.fun < _cost_of(before, rough):
            anchors = at(round(float(found.x)), row)
    return anchors


def about(anchors: Anchors) -> list[dict[str, Any]]:
    """[{"id", "position" m, "yaw" degrees}] of Anchors that stand upright: where to put them, and
    which way their front is turned.
    """
    yaws = Rotation.from_quat(anchors.orientations).as_euler("ZYX", degrees=True)[:, 0].round()
    return [
        {"id": number, "position": position, "yaw": yaw}
        for number, position, yaw in zip(
            anchors.ids.tolist(), anchors.positions.tolist(), yaws.tolist()
        )
    ]
