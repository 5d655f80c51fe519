# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run `plan`: read the options, compute, write the pictures and the figures."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.radio import Antenna
from uwb_tdoa_bias.common.survey import read_named_anchors

from .. import cli, parallel
from ..choices import OF_PROTOCOL
from ..readers.inputs import Reading, Recording
from ..simulation.config import Room, Walls, room_of
from . import maps, optimisation, report
from .maps import Chart, Demand, Grid, Hall, design, placements, step_of
from .optimisation import AnchorPlaces, Goal, lattice
from .precision import FixedNoise, Installation, RadioNoise, antenna_from_yaml

FARTHEST = 30.0  # m, size of a room from which on the radio's reach must be given
# cells along the longest side, without --step
CELLS_ACROSS = {"slice": 100, "volume": 50}
# cells of the flown volume; a search for better anchors looks at their corners
FLOWN_CELLS = 300
PLACES_TRIED = 60  # places on the walls of a room that are tried for one more anchor, about
# Places that are tried in a hall:
HALL_SPACING = 0.35  # of the reach, between them
HALL_HEIGHTS = (1.0, 4.0)  # m above the floor


def plan(args: Namespace) -> bool:
    """Plan by the options of the command.

    Returns False if --hall finds no layout with the wanted share. Raises InputError.
    """
    check_options(args)
    anchors = None if args.hall else read_named_anchors(args.anchors).anchors
    room = room_of_options(args, anchors)
    reach = reach_of(args, room)
    installation = installation_of(args, anchors or Anchors.from_positions([room.centre]))
    demand = Demand(room, args.accuracy, args.flyable)
    grid = grid_of(args, room)
    reading = Reading(args.anchors)
    recordings = reading.find(args.flights or [])
    walls = None if args.walls is None else Walls.from_yaml(args.walls)
    aim = aim_of(args, installation, demand, grid.axes[2][0]) if args.improve else None
    whole = Hall(installation, demand, reach, walls)

    if not (installation.hall or np.isfinite(installation.anchors.orientations).all()):
        cli.show("anchors without orientation are taken to radiate alike in all directions")
    report.print_room(room, args.room is not None)
    args.out.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"arguments": vars(args)}
    if anchors is None:
        whole, found, figures["design"] = designed(args, whole, grid)
    else:
        found = whole.chart(grid, args.jobs)
    installation = whole.installation
    about = report.summary(found)
    figures |= {"anchors": len(whole.anchors), "map": about}
    if installation.hall:
        figures["side"] = whole.side(grid.points)
        report.print_heard(about)
        report.plot_heard(whole.anchors, found, args.out / "heard.png", walls)
    else:
        about |= report.in_hull(found, installation)
        report.print_in_hull(about)
    report.print_flyable(about, demand.accuracy)
    report.print_side(figures.get("side"))
    if demand.criterion == "round":
        figures["addition"] = advice(args, whole, found)
        report.print_addition(figures["addition"], about["flyable_share"])
    draw_map(whole, found, args.out)
    if recordings:
        read = partial(flight_errors, reading, tuple(args.sensors))
        flown = parallel.over(read, recordings, args.jobs)
        step = args.step or 0.4
        figures["flights"] = evaluate_flights(flown, installation, room, step, args.out)
        report.print_flights(figures["flights"])
    if aim:
        figures["improve"] = improve(found, *aim, args.starts, args.out)
        report.print_improvement(figures["improve"])
    cli.write_json(args.out / "plan.json", figures)
    cli.write_json(args.json, figures)
    cli.show(f"wrote {', '.join(sorted(path.name for path in args.out.iterdir()))} in {args.out}")
    return bool(found.flyable.mean() >= args.share) or not args.hall


def check_options(args: Namespace) -> None:
    """Raise InputError for options that do not go together."""
    is_hall = args.hall or args.radio_reach is not None
    numbers = 0 if args.room is None else len(args.room)
    pairings = args.flyable == "pairings"
    for wrong, said in (
        (
            args.hall == (args.anchors is not None),
            "ANCHORS: give a file of the anchors that there are, or --hall where they are asked for.",
        ),
        (
            not 0.0 < args.share <= 1.0,
            f"share: {args.share:g} is none; give more than 0 and at most 1, e.g. 0.95.",
        ),
        (
            args.walls is not None and args.radio_reach is None,
            "walls: are for a hall of which a tag hears a part; give --radio-reach too.",
        ),
        *(
            (
                is_hall and getattr(args, name),
                f"{name}: is for a room in which every anchor is heard; leave out --{name}, or "
                "--radio-reach.",
            )
            for name in ("flights", "improve")
        ),
        (
            args.flights and args.planar,
            "flights: are judged in three dimensions; leave out --planar.",
        ),
        (
            args.volume and args.planar,
            "planar: with a known height there is no volume; leave out --volume, or --planar.",
        ),
        (
            pairings and "ranges" in args.protocol,
            "flyable: looks for a second solution of TDOAs, and ranges have none; leave it out, or "
            "plan for --protocol tdoa2.",
        ),
        (
            pairings and is_hall,
            "flyable: pairings are of a room in which every anchor is heard; leave out --flyable, or "
            "--radio-reach.",
        ),
        (
            args.radio_reach is not None and not args.radio_reach > 0.0,
            f"radio reach: {args.radio_reach} m is none; give one above 0, e.g. 18.",
        ),
        (
            args.hall and numbers != 6,
            "room: --hall needs all of it, in metres; give --room X0 X1 Y0 Y1 Z0 Z1.",
        ),
        (
            numbers not in (0, 4, 6),
            f"room: {numbers} numbers were given; give X0 X1 Y0 Y1 or X0 X1 Y0 Y1 Z0 Z1.",
        ),
    ):
        if wrong:
            raise InputError(said)


def installation_of(args: Namespace, anchors: Anchors) -> Installation:
    """Return the Installation of Anchors and the options. Raises InputError.

    With a reach, each place hears a part of the anchors, as in a hall.
    """
    noise: RadioNoise | FixedNoise
    if args.noise is not None:
        noise = FixedNoise(args.noise)
    else:
        antenna = antenna_from_yaml(args.antenna) if args.antenna else Antenna()
        noise = RadioNoise(antenna, args.tx_power)
    height_std = args.height_std if "height" in args.sensors else np.inf
    return Installation(
        anchors,
        noise,
        OF_PROTOCOL[args.protocol],
        2 if args.planar else 3,
        height_std,
        args.hall or args.radio_reach is not None,
    )


def reach_of(args: Namespace, room: Room) -> float:
    """Return the radio's reach, m. Raises InputError if a large Room needs it."""
    longest = (room.upper - room.lower).max()
    if args.radio_reach is None and longest > FARTHEST:
        raise InputError(
            f"room: is {longest:.0f} m long, and a tag does not hear all of its anchors; give "
            "what your radios reach, e.g. --radio-reach 25."
        )
    return np.inf if args.radio_reach is None else float(args.radio_reach)


def room_of_options(args: Namespace, anchors: Anchors | None) -> Room:
    """Return the Room of --room, or the room that the anchors span. Raises InputError.

    anchors : None if --hall asks for them.
    """
    if anchors is None:
        return Room.of_numbers("room", args.room)
    room = room_of(anchors)
    if args.room is None:
        return room
    return Room.of_numbers("room", [*args.room, room.lower[2], room.upper[2]][:6])


def grid_of(args: Namespace, room: Room) -> Grid:
    """Return the Grid of a slice or of the Room. Raises InputError."""
    size = room.upper - room.lower
    if args.volume:
        return Grid.box(room.lower, room.upper, args.step or size.max() / CELLS_ACROSS["volume"])
    height = room.centre[2] if args.height is None else args.height
    step = args.step or size[:2].max() / CELLS_ACROSS["slice"]
    return Grid.slice((room.lower[0], room.upper[0]), (room.lower[1], room.upper[1]), height, step)


def aim_of(
    args: Namespace, installation: Installation, demand: Demand, height: float
) -> tuple[Goal, Goal, AnchorPlaces, int]:
    """Return what --improve asks for. Raises InputError.

    It is a Goal of the search, one at more points for the report, the places of anchors, and their number.

    height : m, of the flown slice if the tag's height is known.
    """
    count = len(installation.anchors) if args.count is None else args.count
    for name, value, least in (
        ("count", count, installation.unknowns + 1),
        ("starts", args.starts, 1),
    ):
        if value < least:
            raise InputError(f"{name}: {value} is too few; give at least {least}.")
    fly = Room.of_numbers("fly", args.fly) if args.fly else Room(*demand.room.path_box)
    lower, upper, k = fly.lower.copy(), fly.upper.copy(), installation.dimensions
    lower[k:] = upper[k:] = height
    step = max(0.1, (np.prod((upper - lower)[:k]) / FLOWN_CELLS) ** (1.0 / k))
    goal, reported = (
        Goal(lattice(lower, upper, each), installation, demand) for each in (step, 0.4 * step)
    )
    return goal, reported, places_of(args, demand.room), count


def places_of(args: Namespace, room: Room) -> AnchorPlaces:
    """Return the AnchorPlaces of --places, or the walls of the Room. Raises InputError."""
    return (
        AnchorPlaces.from_yaml(args.places)
        if args.places
        else AnchorPlaces.walls(room.lower, room.upper)
    )


def designed(args: Namespace, whole: Hall, grid: Grid) -> tuple[Hall, Chart, list[dict[str, Any]]]:
    """Return (the Hall with the anchors of --hall, its Chart, steps of the search), and write hall.yaml.

    It is the layout with the fewest anchors that has the wanted share on all of the Grid.
    """
    with cli.Progress("plan") as progress:
        layouts, steps = design(whole, grid.points, args.share, progress)
    for anchors in layouts:
        found = whole.with_anchors(anchors).chart(grid, args.jobs)
        if found.flyable.mean() >= args.share:
            break
    chosen = step_of(found, anchors, whole.demand.room)
    report.print_design(steps, chosen, placements(anchors), args.share)
    anchors.to_yaml(args.out / "hall.yaml")
    return whole.with_anchors(anchors), found, steps


def places_in_hall(room: Room, reach: float) -> np.ndarray:
    """Return the places that are tried for one more anchor in a hall: (n, 3) m."""
    across = lattice([*room.lower[:2], 0.0], [*room.upper[:2], 0.0], HALL_SPACING * reach)
    levels = []
    for height in HALL_HEIGHTS:
        across[:, 2] = min(room.lower[2] + height, room.upper[2])
        levels.append(across.round(1))
    return np.unique(np.vstack(levels), axis=0)


def advice(args: Namespace, whole: Hall, found: Chart) -> dict[str, Any] | None:
    """Return the `best_addition` to a Hall, or on the walls of a room. found : Chart of it.

    Places on walls are rounded to the centimetre.
    """
    if whole.installation.hall:
        tried = places_in_hall(whole.demand.room, min(whole.reach, FARTHEST))
    else:
        places = places_of(args, whole.demand.room)
        tried = np.unique(places.positions(places.grid(PLACES_TRIED)).round(2), axis=0)
    with cli.Progress("plan") as progress:
        return optimisation.best_addition(whole, found, tried, progress)


def draw_map(whole: Hall, found: Chart, out: Path) -> None:
    """Write the pictures, flyable volume and bag of a Chart.

    With the criterion "pairings" the curves of each choice of anchors are drawn.
    """
    anchors, installation = whole.anchors, whole.installation
    pairings = installation if whole.demand.criterion == "pairings" else None
    report.plot_precision(anchors, found, out / "precision.png", whole.walls)
    report.plot_flyable(anchors, found, out / "flyable.png", whole.walls, pairings)
    found.volume(anchors, installation.dimensions).save(out / "flyable.npz")
    report.write_messages(report.map_messages(found, anchors), out / "plan_bag")


def flight_errors(
    reading: Reading, sensors: tuple[str, ...], recording: Recording
) -> tuple[str, maps.ErrorSamples]:
    """Return (name, ErrorSamples) of a recording (path, survey). Raises InputError.

    sensors : names of SENSOR_NAMES that the filter uses.
    """
    flight = reading.read(recording)
    for name in sensors:
        if getattr(flight, name) is None:
            raise InputError(
                f"{flight.name}: holds no {name}; leave out --with {name}, or this flight."
            )
    return flight.name, maps.error_samples(flight, sensors)


def evaluate_flights(
    flown: Iterable[tuple[str, maps.ErrorSamples]],
    installation: Installation,
    room: Room,
    step: float,
    out: Path,
) -> list[dict[str, Any]]:
    """Return rows of `comparison`: one for each flight, and one for all.

    step : m, of the picture.
    """
    samples, rows = [], []
    for name, one in flown:
        samples.append(one)
        rows.append({"flight": name, **maps.comparison(one, installation)})
    pooled = maps.pooled(samples)
    rows.append({"flight": f"{len(samples)} pooled", **maps.comparison(pooled, installation)})
    found = maps.accuracy_map(pooled, installation, Grid.box(room.lower, room.upper, step))
    report.plot_accuracy(installation, found, out / "accuracy.png")
    return rows


def improve(
    before: Chart,
    goal: Goal,
    reported: Goal,
    places: AnchorPlaces,
    count: int,
    starts: int,
    out: Path,
) -> dict[str, Any]:
    """Search better places for the anchors, and write improved.yaml.

    before : Chart with the anchors as they are; goal, reported, places, count : of `aim_of`.
    """
    installation, anchors = goal.installation, goal.installation.anchors
    with cli.Progress("plan") as progress:
        start = anchors.positions if count == len(anchors) else None
        over = partial(progress.over, what="layouts")
        found = optimisation.optimise(goal, places, count, start, starts, over)
        better = optimisation.rounded(optimisation.with_old_ids(found, anchors), anchors)
        better.to_yaml(out / "improved.yaml")
        after = Hall(replace(installation, anchors=better), goal.demand)
        charted = after.chart(before.grid)
        report.plot_layouts(
            [("before", installation, before), ("after", after.installation, charted)],
            goal.points,
            out / "layout.png",
        )
    judged = {
        when: {"flyable_share": float(one.flyable.mean()), **reported.figures(those)}
        for when, one, those in (("before", before, anchors), ("after", charted, better))
    }
    return {
        "points": len(reported.points),
        **judged,
        "placed": optimisation.placements(better, anchors),
    }
