"""The parts of plan: each writes its pictures to a folder and returns its figures, plain values."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli, parallel
from ..parallel import Progress
from ..readers.inputs import Reading
from ..simulation.walls import Walls
from . import accuracy, advice, design, hall, messages, optimisation, options, plots, report
from .check import brute_force
from .judging import judge
from .maps import Grid, chart
from .places import lattice

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from uwb_tdoa_bias.foundation.anchors import Anchors

    from ..readers.inputs import Recording
    from ..simulation.room import Room
    from .goal import Goal
    from .installation import Installation
    from .judging import Demand
    from .maps import Chart
    from .places import AnchorPlaces

TRIED = 60  # places on the walls of a room that are tried for one more anchor, about
IN_HALL = (
    0.35,
    (1.0, 4.0),
)  # of the reach, between places that are tried in a hall; m above the floor


def plan_hall(
    args: Namespace, anchors: Anchors | None, installation: Installation, demand: Demand, grid: Grid
) -> tuple[dict[str, Any], dict[str, Any], bool]:
    """All of plan with --radio-reach or --hall: (figures, messages, whether the wanted share can be
    flown). args : the options; anchors : Anchors of the hall, None where they are asked for. Raises
    InputError.
    """
    for name in ("check", "flights", "improve"):
        if getattr(args, name):
            raise InputError(
                f"{name}: is for a room in which every anchor is heard; leave out --{name}, "
                "or --radio-reach."
            )
    room, walls = demand.room, None if args.walls is None else Walls.from_yaml(args.walls)
    goal, reach = options.goal_of(args, installation, demand), options.reach_of(args, demand.room)
    whole = hall.Hall(goal, installation.anchors, reach, walls)
    args.out.mkdir(parents=True, exist_ok=True)
    report.say_room(room, args.room is not None)
    figures: dict[str, Any] = {"arguments": options.plain(args)}
    if anchors is None:
        anchors, found, figures["design"] = _designed(args, whole, grid)
        anchors.to_yaml(args.out / "hall.yaml")
    else:
        found = whole.chart(grid, args.jobs, args.dask)
    whole = whole.of(anchors)
    figures |= {
        "anchors": len(anchors),
        "map": report.summary(found),
        "side": whole.side(grid.points),
    }
    report.say_heard(figures["map"])
    report.say_flyable(figures["map"], demand.accuracy)
    report.say_side(figures["side"])
    figures["addition"] = hall_advice(whole, found)
    report.say_addition(figures["addition"], figures["map"]["flyable_share"])
    plots.plot_heard(anchors, found, args.out / "heard.png", walls)
    outgoing = draw_map(found, installation.of(anchors), args.out, walls)
    return figures, outgoing, bool(found.flyable.mean() >= args.share or not args.hall)


def _designed(
    args: Namespace, whole: hall.Hall, grid: Grid
) -> tuple[Anchors, Chart, list[dict[str, Any]]]:
    """(Anchors, Chart, rows of the table) of --hall: the fewest of which the wanted share can be
    flown on all of the Grid.
    """
    room = whole.goal.demand.room
    with Progress("plan") as progress:
        layouts, steps = design.design(whole, room, grid.points, args.share, progress)
    for anchors in layouts:
        found = whole.of(anchors).chart(grid, args.jobs, args.dask)
        if found.flyable.mean() >= args.share:
            break
    rows = [asdict(step) for step in steps]
    report.say_design(
        rows, asdict(design.step_of(found, anchors, room)), design.about(anchors), args.share
    )
    return anchors, found, rows


def _places(room: Room, reach: float) -> np.ndarray:
    """Places (n, 3) m all over a hall that are tried for one more anchor."""
    step, heights = IN_HALL
    z = [min(room.lower[2] + height, room.upper[2]) for height in heights]
    across = lattice([*room.lower[:2], 0.0], [*room.upper[:2], 0.0], step * reach)[:, :2]
    return np.unique(
        np.vstack([np.column_stack([across, np.full(len(across), height)]) for height in z]).round(
            1
        ),
        axis=0,
    )


def plan_room(
    args: Namespace,
    anchors: Anchors,
    installation: Installation,
    demand: Demand,
    grid: Grid,
    reading: Reading,
    recordings: Sequence[Recording],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """All of plan of a room in which every anchor is heard: (figures, messages). args : the
    options; recordings : of --flights, which Reading found. Raises InputError.
    """
    aim = options.aim_of(args, installation, demand, grid.axes[2][0]) if args.improve else None
    if not np.isfinite(anchors.orientations).all():
        cli.show("anchors without orientation are taken to radiate alike in all directions")
    report.say_room(demand.room, args.room is not None)
    args.out.mkdir(parents=True, exist_ok=True)
    with Progress("plan") as progress:
        progress("mapping")
        found = chart(installation, grid, demand)
    about = {**report.summary(found), **report.in_hull(found, installation)}
    figures: dict[str, Any] = {
        "anchors": len(anchors),
        "arguments": options.plain(args),
        "map": about,
    }
    report.say_in_hull(about)
    report.say_flyable(about, demand.accuracy)
    if demand.criterion == "round":
        goal, places = (
            options.goal_of(args, installation, demand),
            options.places_of(args, demand.room),
        )
        figures["addition"] = room_advice(found, anchors, goal, places)
        report.say_addition(figures["addition"], about["flyable_share"])
    outgoing = draw_map(found, installation, args.out, pairings=demand.criterion == "pairings")
    if args.check:
        figures["check"] = check(installation, grid, args.out)
        report.say_check(figures["check"])
    if recordings:
        flown = parallel.over(Fly(reading, tuple(args.aids)), recordings, args.jobs, args.dask)
        figures["flights"] = evaluate_flights(
            flown, installation, demand.room, args.step or 0.4, args.out
        )
        report.say_flights(figures["flights"])
    if aim:
        figures["improve"] = improve(found, aim, args.improve, args.starts, args.out)
        report.say_improvement(figures["improve"])
    return figures, outgoing


def hall_advice(whole: hall.Hall, found: Chart) -> dict[str, Any] | None:
    """What `advice.one_more` finds in a Hall. found : Chart of it."""
    places = _places(whole.goal.demand.room, min(whole.reach, options.FARTHEST))
    with Progress("plan") as progress:
        return advice.one_more(
            found,
            whole.anchors,
            places,
            lambda before, points, more, place: whole.changed(before, points, more, place[None]),
            progress,
        )


def room_advice(
    found: Chart, anchors: Anchors, goal: Goal, places: AnchorPlaces
) -> dict[str, Any] | None:
    """What `advice.one_more` finds on AnchorPlaces of a room in which all is heard, to the
    centimetre. found : Chart of Anchors.
    """
    tried = np.unique(places.positions(places.grid(TRIED)).round(2), axis=0)
    with Progress("plan") as progress:
        return advice.one_more(
            found,
            anchors,
            tried,
            lambda before, points, more, place: judge(points, goal.installed(more), goal.demand),
            progress,
        )


def end(args: Namespace, figures: dict[str, Any], outgoing: dict[str, Any]) -> None:
    """Write the figures, say what was written, and publish the messages if that was asked for."""
    for path in (args.out / "plan.json", args.json):
        if path is not None:
            cli.write_json(path, figures)
    cli.show(f"wrote {', '.join(sorted(path.name for path in args.out.iterdir()))} in {args.out}")
    if args.publish:
        cli.show(f"publishing {', '.join(outgoing)} until Ctrl-C")
        messages.publish(outgoing)


def draw_map(
    found: Chart,
    installation: Installation,
    out: Path,
    walls: Walls | None = None,
    pairings: bool = False,
) -> dict[str, Any]:
    """Pictures, flyable volume and bag of a Chart. Returns {topic: message}, see
    `messages.messages`. pairings : with the curves of every choice of anchors.
    """
    anchors = installation.anchors
    plots.plot_precision(anchors, found, out / "precision.png", walls)
    plots.plot_flyable(
        anchors, found, out / "flyable.png", walls, installation if pairings else None
    )
    found.volume(anchors, installation.dimensions).save(out / "flyable.npz")
    outgoing = messages.messages(found, anchors)
    messages.write(outgoing, out / "plan.bag")
    return outgoing


def check(installation: Installation, grid: Grid, out: Path) -> dict[str, Any]:
    """The failure map against a solver that is started from many places."""
    with Progress("plan") as progress:
        unique, agrees, points, arrows = brute_force(
            installation, grid, partial(progress.over, what="solving")
        )
    plots.plot_flips(installation, points, unique, agrees, arrows, out / "flips.png")
    return {
        "places": len(points),
        "agreement": float(np.mean(agrees)),
        "unique_share": float(np.mean(unique)),
    }


@dataclass(frozen=True)
class Fly:
    """fly((path, survey)) is the name of a recording and its ErrorSamples. reading : Reading; aids
    : what it may use, as for accuracy.fly. Can be pickled. Raises InputError.
    """

    reading: Reading
    aids: tuple[str, ...] = ()

    def __call__(self, recording: Recording) -> tuple[str, accuracy.ErrorSamples]:
        flight = self.reading.read(recording)
        for name in self.aids:
            if getattr(flight, name) is None:
                raise InputError(
                    f"{flight.name}: holds no {name}; leave out --with {name}, or this flight."
                )
        return flight.name, accuracy.fly(flight, self.aids)


def evaluate_flights(
    flown: Iterable[tuple[str, accuracy.ErrorSamples]],
    installation: Installation,
    room: Room,
    step: float,
    out: Path,
) -> list[dict[str, Any]]:
    """Rows of `accuracy.comparison`, one for each of what a Fly gave, and one for all. step : m, of
    the picture.
    """
    samples, rows = [], []
    for name, one in flown:
        samples.append(one)
        rows.append({"flight": name, **accuracy.comparison(one, installation)})
    pooled = accuracy.together(samples)
    rows.append({"flight": f"{len(samples)} pooled", **accuracy.comparison(pooled, installation)})
    found = accuracy.accuracy_map(pooled, installation, Grid.box(room.lower, room.upper, step))
    plots.plot_accuracy(installation, found, out / "accuracy.png")
    return rows


def improve(before: Chart, aim: options.Aim, how: str, starts: int, out: Path) -> dict[str, Any]:
    """Better places for the anchors, improved.yaml. before : Chart as it is; aim : options.Aim; how
    : "move" or "add".
    """
    goal, places, installation = aim.goal, aim.places, aim.goal.installation
    anchors = installation.anchors
    with Progress("plan") as progress:
        search: dict[str, Any] = {
            "starts": starts,
            "progress": partial(progress.over, what="layouts"),
        }
        if how == "add":
            numbers, scores = optimisation.one_more(goal, anchors, places)
            plots.plot_places(places, numbers, scores, out / "places.png")
            start: np.ndarray | None = places.positions(numbers[[np.argmin(scores)]])
            better = optimisation.optimise(goal, places, 1, anchors, start, **search)
        else:
            start = anchors.positions if aim.count == len(anchors) else None
            better = optimisation.named(
                optimisation.optimise(goal, places, aim.count, None, start, **search), anchors
            )
        better = optimisation.rounded(better, anchors)
        better.to_yaml(out / "improved.yaml")
        after = goal.installed(better)
        charted = chart(after, before.grid, goal.demand)
        plots.plot_layouts(
            [("before", installation, before), ("after", after, charted)],
            goal.points,
            out / "layout.png",
        )
    judged = {
        when: {"flyable_share": float(one.flyable.mean()), **aim.reported.figures(those)}
        for when, one, those in (("before", before, anchors), ("after", charted, better))
    }
    return {
        "points": len(aim.reported.points),
        **judged,
        "placed": optimisation.placed(better, anchors),
    }
