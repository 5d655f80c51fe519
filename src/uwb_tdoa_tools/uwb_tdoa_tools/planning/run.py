"""The parts of plan: each writes its pictures to a folder and returns its figures, plain values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..progress import Progress
from ..readers.inputs import Reading
from ..simulation.walls import Walls
from . import accuracy, hall, messages, optimisation, options, plots, report
from .check import brute_force
from .maps import Grid, chart, flyable

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Callable, Iterable
    from pathlib import Path
    from uwb_tdoa_bias.foundation.anchors import Anchors
    from ..readers.inputs import Recording
    from ..simulation.room import Room
    from .installation import Installation
    from .maps import Chart
    from .places import AnchorPlaces

ENOUGH = 0.95  # of the room that can be flown: no anchor is proposed
LOOKED_AT, TRIED = 600, 60  # cells of the room, and places, that are tried for one more anchor, about


def plan_hall(
    args: Namespace, anchors: Anchors, installation: Installation, room: Room, grid: Grid
) -> tuple[dict[str, Any], dict[str, Any]]:
    """All of plan with --radio-reach: (figures, messages). args : the options; anchors : Anchors of the hall; installation : Installation
    of some of them; room : Room; grid : Grid. Raises InputError."""
    for name in ("check", "flights", "improve"):
        if getattr(args, name):
            raise InputError(f"{name}: is for a room in which every anchor is heard; leave out --{name}, or --radio-reach.")
    if not args.radio_reach > 0.0:
        raise InputError(f"radio reach: {args.radio_reach:g} m is none; give one above 0, e.g. 18.")
    report.say_room(room, args.room is not None)
    args.out.mkdir(parents=True, exist_ok=True)
    walls = None if args.walls is None else Walls.from_yaml(args.walls)
    whole = hall.Hall(options.goal_of(args, installation), anchors, args.radio_reach, walls)
    found, heard = whole.chart(grid, args.jobs, args.dask)
    figures: dict[str, Any] = {"anchors": len(anchors), "arguments": options.plain(args)}
    figures["map"] = hall.summary(found, heard)
    figures["addition"] = whole.addition(found, room.lower[2])
    figures["side"] = whole.side(grid.points)
    hall.say(figures["map"], figures["addition"], figures["side"])
    hall.plot(whole, found, heard, args.out / "hall.png")
    found.volume(anchors, installation.dimensions).save(args.out / "flyable.npz")
    outgoing = messages.messages(found, anchors)
    messages.write(outgoing, args.out / "plan.bag")
    return figures, outgoing


def end(args: Namespace, figures: dict[str, Any], outgoing: dict[str, Any]) -> None:
    """Write the figures, say what was written, and publish the messages if that was asked for."""
    for path in (args.out / "plan.json", args.json):
        if path is not None:
            cli.write_json(path, figures)
    cli.show(f"wrote {', '.join(sorted(path.name for path in args.out.iterdir()))} in {args.out}")
    if args.publish:
        cli.show(f"publishing {', '.join(outgoing)} until Ctrl-C")
        messages.publish(outgoing)


def draw_map(found: Chart, installation: Installation, out: Path) -> dict[str, Any]:
    """Pictures, flyable volume and bag of a Chart. Returns {topic: message}, see `messages.messages`."""
    plots.plot_precision(installation, found, out / "precision.png")
    if not installation.pairing.one_solution:
        plots.plot_failure(installation, found, out / "failure.png")
    found.volume(installation.anchors, installation.dimensions).save(out / "flyable.npz")
    outgoing = messages.messages(found, installation.anchors)
    messages.write(outgoing, out / "plan.bag")
    return outgoing


def check(installation: Installation, grid: Grid, out: Path) -> dict[str, Any]:
    """The failure map against a solver that is started from many places."""
    with Progress("plan") as progress:
        unique, agrees, points, arrows = brute_force(installation, grid, partial(progress.over, what="solving"))
    plots.plot_flips(installation, points, unique, agrees, arrows, out / "flips.png")
    return {"places": len(points), "agreement": float(np.mean(agrees)), "unique_share": float(np.mean(unique))}


@dataclass(frozen=True)
class Fly:
    """fly((path, survey)) is the name of a recording and its ErrorSamples. reading : Reading; aids : what it may use, as for
    accuracy.fly. Can be pickled. Raises InputError."""

    reading: Reading
    aids: tuple[str, ...] = ()

    def __call__(self, recording: Recording) -> tuple[str, accuracy.ErrorSamples]:
        flight = self.reading.read(recording)
        for name in self.aids:
            if getattr(flight, name) is None:
                raise InputError(f"{flight.name}: holds no {name}; leave out --with {name}, or this flight.")
        return flight.name, accuracy.fly(flight, self.aids)


def evaluate_flights(
    flown: Iterable[tuple[str, accuracy.ErrorSamples]], installation: Installation, room: Room, step: float, out: Path
) -> list[dict[str, Any]]:
    """Rows of `accuracy.comparison`, one for each of what a Fly gave, and one for all. step : m, of the picture."""
    samples, rows = [], []
    for name, one in flown:
        samples.append(one)
        rows.append({"flight": name, **accuracy.comparison(one, installation)})
    pooled = accuracy.together(samples)
    rows.append({"flight": f"{len(samples)} pooled", **accuracy.comparison(pooled, installation)})
    found = accuracy.accuracy_map(pooled, installation, Grid.box(room.lower, room.upper, step))
    plots.plot_accuracy(installation, found, out / "accuracy.png")
    return rows


def addition(
    found: Chart, anchors: Anchors, installed: Callable[[Anchors], Installation], places: AnchorPlaces, criterion: str
) -> dict[str, Any] | None:
    """What the best of some places for one more anchor would add to what is flyable: {"position": (3,) m, "gain": share of the room}, to
    the centimetre; None where nearly all is flyable. found : Chart of Anchors; installed(anchors) : Installation of others; places :
    AnchorPlaces."""
    if found.flyable.mean() > ENOUGH:
        return None
    grid = found.grid
    coarse = Grid.box(
        grid.lower, grid.lower + grid.step * np.array(grid.shape), grid.step * (found.flyable.size / LOOKED_AT) ** (1.0 / _across(grid))
    )
    if grid.shape[2] == 1:
        x, y, z = grid.axes
        coarse = Grid.slice((x[0], x[-1]), (y[0], y[-1]), z[0], coarse.step)
    points = coarse.points
    before, best = flyable(installed(anchors), points, criterion)[2].mean(), (0.0, None)
    for position in np.unique(places.positions(places.grid(TRIED)).round(2), axis=0):
        try:
            more = installed(optimisation.with_one(anchors, position))
        except InputError:  # where there is one already
            continue
        best = max(best, (flyable(more, points, criterion)[2].mean() - before, position.tolist()), key=lambda one: one[0])
    return {"position": best[1], "gain": float(best[0])}


def _across(grid: Grid) -> int:
    """Dimensions of a grid."""
    return 2 if grid.shape[2] == 1 else 3


def improve(before: Chart, aim: options.Aim, how: str, starts: int, criterion: str, out: Path) -> dict[str, Any]:
    """Better places for the anchors, improved.yaml. before : Chart as it is; aim : options.Aim; how : "move" or "add";
    criterion : of what is flyable."""
    goal, places, installation, candidates = aim.goal, aim.places, aim.goal.installation, None
    anchors = installation.anchors
    with Progress("plan") as progress:
        search: dict[str, Any] = {"starts": starts, "progress": partial(progress.over, what="layouts")}
        if how == "add":
            candidates = optimisation.one_more(goal, anchors, places)
            start: np.ndarray | None = candidates[0][[np.argmin(candidates[1])]]
            better = optimisation.optimise(goal, places, 1, anchors, start, **search)
        else:
            start = anchors.positions if aim.count == len(anchors) else None
            better = optimisation.named(optimisation.optimise(goal, places, aim.count, None, start, **search), anchors)
        better = optimisation.rounded(better, anchors)
        better.to_yaml(out / "improved.yaml")
        after = goal.installed(better)
        charted = chart(after, before.grid, criterion)
        charts = [("before, ", installation, before), ("after, ", after, charted)]
    plots.plot_layouts(charts, out / "layout.png", candidates)
    judged = {
        when: {"flyable_share": float(one.flyable.mean()), **aim.reported.figures(those)}
        for when, one, those in (("before", before, anchors), ("after", charted, better))
    }
    return {"points": len(aim.reported.points), **judged, "placed": optimisation.placed(better, anchors)}
