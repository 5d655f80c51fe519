"""Better places and directions for the anchors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

from .descent import descend
from .goal import UNUSABLE
from .layout import Layout, free_ids
from .places import AnchorPlaces, spread

if TYPE_CHECKING:
    from .check import Wrap
    from .goal import Goal

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
    fixed: Anchors | None = None,
    start: np.ndarray | None = None,
    starts: int = 16,
    progress: Wrap = iter,
) -> Anchors:
    """Anchors at the `count` best places, turned in the best directions; after those of `fixed`,
    which stay.

    goal : Goal; places : AnchorPlaces; start : (count, 3) m, a layout to begin with besides the
        quasi-random ones;
    progress : wraps the starts. Descents from all starts at a few of the goal's points; the best of
        what
    they lead to descend again, with the points that turn out to be the worst. The best score at all
    points wins.
    """
    layout = Layout(
        places, count, fixed, goal.points.mean(axis=0), are_turned(goal.installation.anchors)
    )
    rows = _some(goal, ROUGH)
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
    best = min([each for each in found if not _beside(each, count)] or found, key=goal.score)
    if goal.score(best) >= UNUSABLE:
        raise InputError("places: no layout of these anchors locates a tag; allow more places.")
    return best


def one_more(
    goal: Goal, anchors: Anchors, places: AnchorPlaces, count: int = 400
) -> tuple[np.ndarray, np.ndarray]:
    """What one more anchor would give at places all over that are not beside another: (numbers (n,
    places.numbers), scores (n,) m), facing the points.
    """
    layout = Layout(places, 1, anchors, goal.points.mean(axis=0), are_turned(anchors))
    numbers = places.grid(count)
    away = np.linalg.norm(places.positions(numbers)[:, None] - anchors.positions, axis=2).min(
        axis=1
    )
    numbers = numbers[away >= BESIDE]
    return numbers, np.array([goal.score(layout.anchors(layout.start(x))) for x in numbers])


def are_turned(anchors: Anchors) -> bool:
    """Whether the orientation of any of the Anchors is known: only then are directions part of a
    layout.
    """
    return bool(np.isfinite(anchors.orientations).all(axis=1).any())


def with_one(anchors: Anchors, position: np.ndarray) -> Anchors:
    """Anchors with one more, whose orientation is not known, at position (3,) m."""
    return Anchors(
        np.append(anchors.ids, free_ids(anchors.ids, 1)),
        np.vstack([anchors.positions, position]),
        np.vstack([anchors.orientations, np.full(4, np.nan)]),
        anchors.frame,
    )


def named(better: Anchors, before: Anchors) -> Anchors:
    """Anchors of a layout with the ids that they have `before`: who is moved is moved as little as
    possible in all. New ids where there are more than before.
    """
    away = np.linalg.norm(better.positions[:, None] - before.positions, axis=2)
    rows, old = linear_sum_assignment(away)
    ids = np.empty(len(better), int)
    ids[np.setdiff1d(np.arange(len(better)), rows)] = free_ids(before.ids, len(better) - len(rows))
    ids[rows] = before.ids[old]
    order = np.argsort(ids)
    return Anchors(ids[order], better.positions[order], better.orientations[order], before.frame)


def rounded(better: Anchors, before: Anchors) -> Anchors:
    """The same Anchors as somebody can put them up: to the centimetre and the degree; those that
    stay as they are `before` are not touched.
    """
    moved = _moved(better, before)
    positions, orientations = better.positions.copy(), better.orientations.copy()
    positions[moved] = positions[moved].round(2)
    turned = moved & np.isfinite(orientations).all(axis=1)
    if turned.any():
        angles = Rotation.from_quat(orientations[turned]).as_euler("ZYX", degrees=True).round()
        orientations[turned] = Rotation.from_euler("ZYX", angles, degrees=True).as_quat().round(4)
    return Anchors(better.ids, positions, orientations, better.frame)


def placed(better: Anchors, before: Anchors) -> list[dict[str, Any]]:
    """[{"id", "words"}] of the Anchors that are not where they are `before`: where to put them, and
    which way they face.
    """
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
    """Which of the Anchors are new, or more than a millimetre from where they are `before`: (n,)
    bool.
    """
    rows = before.index(better.ids)
    return (rows < 0) | (np.linalg.norm(better.positions - before.positions[rows], axis=1) > 1e-3)


def _beside(anchors: Anchors, count: int) -> bool:
    """Whether any of the last `count` Anchors is beside another."""
    away = np.linalg.norm(
        anchors.positions[:, None] - anchors.positions, axis=2
    ) + 2.0 * BESIDE * np.eye(len(anchors))
    return bool((away[-count:] < BESIDE).any())


def _some(goal: Goal, count: int) -> np.ndarray:
    """Rows of some of the goal's points."""
    if goal.objective == "worst":
        return spread(goal.points, count)
    return np.random.default_rng(SEED).permutation(len(goal.points))[:count]


def _refined(goal: Goal, layout: Layout, x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """x after descents at these rows of the goal's points and at those that turn out to be worse;
    or x itself.
    """
    best, score = x, goal.score(layout.anchors(x))
    for _ in range(EXCHANGES):
        try:
            errors = goal.errors(layout.anchors(x))
        except InputError:  # two anchors have met
            break
        if goal.objective == "worst" and errors.max() <= CLOSE * errors[rows].max():
            break
        worst = np.argsort(-errors)[: 1 + len(errors) // 20]
        rows = np.union1d(rows, worst[spread(goal.points[worst], ADDED)])
        x = descend(goal, layout, goal.points[rows], x, SWEEPS)
        if (found := goal.score(layout.anchors(x))) < score:
            best, score = x, found
    return best
