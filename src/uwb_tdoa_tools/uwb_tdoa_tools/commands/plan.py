"""plan: where a tag can be located among given anchors, how precisely, and where the anchors had better be."""

import json
import sys
from functools import partial

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..readers import inputs
from .. import parallel
from ..planning import accuracy, layout, messages, options, plots, report
from ..planning.check import brute_force
from ..planning.maps import Grid, chart
from ..readers import read_flight, read_survey

_watched = partial(tqdm, disable=None, leave=False)


def main(argv=None):
    """The executable. Returns the exit code."""
    return cli.run(_plan, options.parser(), argv)


def _plan(args):
    anchors = read_survey(args.anchors)
    installation = options.installation_of(args, anchors)
    room = options.room_for(args, anchors)
    grid = options.grid_of(args, room)
    if args.flights and args.planar:
        raise InputError("flights: are judged in three dimensions; leave out --planar.")
    recordings = inputs.find_flights(args.flights, args.anchors, bool(args.dask)) if args.flights else []
    aim = options.aim_of(args, installation, room, grid.axes[2][0]) if args.improve else None

    if not np.isfinite(anchors.orientations).all():
        print("note: anchors without orientation are taken to radiate alike in all directions")
    args.out.mkdir(parents=True, exist_ok=True)
    found = chart(installation, grid, args.flyable)
    figures = {"anchors": len(anchors), "arguments": options.plain(args), "map": report.summary(found)}
    report.say_summary(figures["map"])
    plots.plot_precision(installation, found, args.out / "precision.png")
    plots.plot_failure(installation, found, args.out / "failure.png")
    found.volume(installation).save(args.out / "flyable.npz")
    outgoing = messages.messages(found, anchors)
    messages.write(outgoing, args.out / "plan.bag")
    if args.check:
        figures["check"] = _check(args, installation, grid)
    if recordings:
        figures["flights"] = _flights(args, installation, room, recordings)
    if aim:
        figures["improve"] = _improve(args, found, aim)
    for path in (args.out / "plan.json", args.json):
        if path is not None:
            path.write_text(json.dumps(figures, indent=1) + "\n")
    print(f"wrote {', '.join(sorted(path.name for path in args.out.iterdir()))} in {args.out}")
    if args.publish:
        print(f"publishing {', '.join(outgoing)} until Ctrl-C", flush=True)
        messages.publish(outgoing)
    return 0


def _check(args, installation, grid):
    unique, agrees, points, arrows = brute_force(installation, grid, partial(_watched, desc="solving"))
    plots.plot_flips(installation, points, unique, agrees, arrows, args.out / "flips.png")
    print(f"check: {len(points)} places, agreement with the brute-force solver {np.mean(agrees):.2%}")
    return {"places": len(points), "agreement": float(np.mean(agrees)), "unique_share": float(np.mean(unique))}


def _flights(args, installation, room, recordings):
    samples, rows = [], []
    for name, flown in parallel.over(_fly, recordings, args.jobs, args.dask):
        samples.append(flown)
        rows.append({"flight": name, **accuracy.comparison(flown, installation)})
    pooled = accuracy.together(samples)
    rows.append({"flight": f"{len(samples)} pooled", **accuracy.comparison(pooled, installation)})
    report.say_flights(rows)
    found = accuracy.accuracy_map(pooled, installation, Grid.box(room.lower, room.upper, args.step or 0.4))
    plots.plot_accuracy(installation, found, args.out / "accuracy.png")
    return rows


def _fly(recording):
    """(name, Samples) of one (path, survey)."""
    flight = read_flight(*recording)
    return flight.name, accuracy.fly(flight)


def _improve(args, before, aim):
    goal, places, installation, candidates = aim.goal, aim.places, aim.goal.installation, None
    anchors, search = installation.anchors, {"starts": args.starts, "progress": partial(_watched, desc="layouts")}
    if args.improve == "add":
        candidates = layout.one_more(goal, anchors, places)
        start = candidates[0][[np.argmin(candidates[1])]]
        better = layout.optimise(goal, places, 1, anchors, start, **search)
    else:
        start = anchors.positions if aim.count == len(anchors) else None
        better = layout.optimise(goal, places, aim.count, None, start, **search)
    better.to_yaml(args.out / "improved.yaml")
    after = goal.installed(better)
    charts = [("before, ", installation, before), ("after, ", after, chart(after, before.grid, args.flyable))]
    plots.plot_layouts(charts, args.out / "layout.png", candidates)
    found = {"points": len(aim.judge.points), "before": aim.judge.judge(anchors), "after": aim.judge.judge(better)}
    report.say_improvement(found)
    return found


if __name__ == "__main__":
    sys.exit(main())
