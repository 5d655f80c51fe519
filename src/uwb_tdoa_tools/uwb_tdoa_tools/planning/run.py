"""The parts of plan: each writes its pictures to a folder and returns its figures, plain values."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from ..progress import Progress
from ..readers.inputs import Reading
from . import accuracy, layout, messages, plots
from .check import brute_force
from .maps import Grid, chart


def draw_map(found, installation, out):
    """Pictures, flyable volume and bag of a Chart. Returns {topic: message}, see `messages.messages`."""
    plots.plot_precision(installation, found, out / "precision.png")
    plots.plot_failure(installation, found, out / "failure.png")
    found.volume(installation).save(out / "flyable.npz")
    outgoing = messages.messages(found, installation.anchors)
    messages.write(outgoing, out / "plan.bag")
    return outgoing


def check(installation, grid, out):
    """The failure map against a solver that is started from many places."""
    with Progress("plan") as progress:
        unique, agrees, points, arrows = brute_force(installation, grid, partial(progress.over, what="solving"))
    plots.plot_flips(installation, points, unique, agrees, arrows, out / "flips.png")
    return {"places": len(points), "agreement": float(np.mean(agrees)), "unique_share": float(np.mean(unique))}


@dataclass(frozen=True)
class Fly:
    """fly((path, survey)) is the name of a recording and its Samples. reading : Reading; aids : what it may use, as for
    accuracy.fly. Can be pickled. Raises InputError."""

    reading: Reading
    aids: tuple = ()

    def __call__(self, recording):
        flight = self.reading.read(recording)
        for name in self.aids:
            if getattr(flight, name) is None:
                raise InputError(f"{flight.name}: holds no {name}; leave out --with {name}, or this flight.")
        return flight.name, accuracy.fly(flight, self.aids)


def judge_flights(flown, installation, room, step, out):
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


def improve(before, aim, how, starts, criterion, out):
    """Better places for the anchors, improved.yaml. before : Chart as it is; aim : options.Aim; how : "move" or "add";
    criterion : of what is flyable."""
    goal, places, installation, candidates = aim.goal, aim.places, aim.goal.installation, None
    anchors = installation.anchors
    with Progress("plan") as progress:
        search = {"starts": starts, "progress": partial(progress.over, what="layouts")}
        if how == "add":
            candidates = layout.one_more(goal, anchors, places)
            start = candidates[0][[np.argmin(candidates[1])]]
            better = layout.optimise(goal, places, 1, anchors, start, **search)
        else:
            start = anchors.positions if aim.count == len(anchors) else None
            better = layout.optimise(goal, places, aim.count, None, start, **search)
        better.to_yaml(out / "improved.yaml")
        after = goal.installed(better)
        charts = [("before, ", installation, before), ("after, ", after, chart(after, before.grid, criterion))]
    plots.plot_layouts(charts, out / "layout.png", candidates)
    return {"points": len(aim.judge.points), "before": aim.judge.judge(anchors), "after": aim.judge.judge(better)}
