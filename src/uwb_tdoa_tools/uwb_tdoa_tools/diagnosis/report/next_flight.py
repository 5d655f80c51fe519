# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw the planned flight from above and from the side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .pictures import COLOURS, WIDTH, Picture, drawing, embedded
from .room import VIEWS

if TYPE_CHECKING:
    from ..result import Diagnosis

EVERY = 2.0  # s, between arrows of the heading
AHEAD = 0.5  # m, length of such an arrow
MARGIN = 0.5  # m around anchors and path


def picture(diagnosis: Diagnosis) -> Picture:
    """Return the picture of the planned flight: one colour for each motion, arrows for the yaw."""
    plan = diagnosis.next_flight
    assert plan is not None  # the page asks for it only then
    path, anchors = plan.path, diagnosis.flights[0].anchors
    heard = anchors.positions
    places = np.vstack([path.p, heard])
    size = np.ptp(places, axis=0) + 2.0 * MARGIN
    tall = 0.87 * WIDTH * (size[1] + size[2]) / size[0]
    rows = max(1, len(plan.parts) // 2 + 1)
    figure, axes = drawing(
        min(tall, 2.0 * WIDTH) + 1.2 + 0.17 * rows, nrows=2, height_ratios=size[1:]
    )
    ends = [*(start for start, _ in plan.parts), path.duration]
    arrows = np.flatnonzero(np.diff(np.floor(path.t / EVERY), prepend=-1.0))
    heading = AHEAD * np.column_stack([np.cos(path.yaw), np.sin(path.yaw), np.zeros(len(path.t))])
    colours = iter(COLOURS * len(plan.parts))
    styles = [
        (what, {"color": "0.6", "ls": ":"} if what == "way" else {"color": next(colours)})
        for _, what in plan.parts
    ]
    for ax, view in zip(axes, VIEWS):
        for first, last, (what, style) in zip(ends, ends[1:], styles):
            inside = (path.t >= first) & (path.t <= last)
            words = None if what == "way" else f"{first:.0f} s: {what}"
            ax.plot(*path.p[inside][:, view].T, lw=2.0, label=words, **style)
        ax.plot(*path.p[0, view], "ko", ms=5)
        ax.plot(*heard[:, view].T, "^", color="0.2", ms=5)
        labels: dict[tuple[float, ...], list[str]] = {}
        for number, place in zip(anchors.ids, heard):
            labels.setdefault(tuple(np.round(place[view], 1)), []).append(str(number))
        for place, ids in labels.items():
            ax.annotate(", ".join(ids), place, (4, 4), textcoords="offset points")
        ax.set(aspect="equal", xlabel="x [m]", ylabel=f"{'xyz'[view[1]]} [m]")
        ax.margins(0.08)
        ax.grid(alpha=0.25, lw=0.5)
    axes[0].quiver(
        *path.p[arrows, :2].T,
        *heading[arrows, :2].T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.006,
        color="0.25",
        zorder=3,
    )
    axes[0].set_title("From above", loc="left", fontsize=10)
    axes[1].set_title("From the side", loc="left", fontsize=10)
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=1, fontsize=8
    )
    return embedded(
        figure,
        f"Planned path of {path.duration:.0f} s among the anchors, from above and from the side",
        "Path of next_flight.csv. The dot is its start; dotted lines lead to the next motion; "
        "triangles are anchors; arrows from above show the yaw every 2 s.",
    )
