# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw the room from above and from the side: anchors, findings, and position errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Circle, Ellipse
import numpy as np

from uwb_tdoa_bias.effects.base import listed

from .pictures import FOUND, REGION, WIDTH, Picture, drawing, embedded, plt
from .room import CELL, VIEWS, changed, estimated, flown, mean_errors, shifts_and_regions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.quiver import Quiver

    from ..result import Diagnosis
    from .room import Flown

POINTS = 1500  # points of all paths together
GAP = 1.0  # s, gap in the estimate that breaks a line
BESIDE = 0.7  # m, largest distance of anchors with a common label
MARGIN = 1.0  # m around anchors and paths
LONGEST = 0.16  # longest arrow, share of the room
AWAY = 11.0  # points between an anchor and the middle of its label
KEYS = (1, 2, 5, 10, 20, 50, 100, 200)  # cm, possible lengths of the arrow in the key
ENLARGED = (1, 2, 3, 5, 10, 20, 50, 100)  # possible factors on the length of arrows
# quantile of the errors at the end of the colour scale, and for the scale of arrows
BRIGHT = 0.95
COLOURS = LinearSegmentedColormap.from_list(
    "error", plt.get_cmap("viridis_r")(np.linspace(0.06, 1.0, 64))
)
ARROW = {"arrowstyle": "-|>", "color": FOUND, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}


def maps(diagnosis: Diagnosis) -> tuple[str, list[Picture]]:
    """Return (common caption, pictures): a map before and a map after.

    There is a single map if the model did not change or the errors are unknown.
    """
    sides = [
        (name, flown(side["scores"]))
        for name, side in (("before", diagnosis.before), ("after", diagnosis.after))
    ]
    if not any(runs for _, runs in sides):
        arrows = Arrows.of(diagnosis, [])
        return _caption(diagnosis, [], arrows.enlarged), [_drawn(diagnosis, "", [], None, arrows)]
    if not changed(diagnosis):
        sides = [("", sides[0][1])]
    distances = np.concatenate([run.distance for _, runs in sides for run in runs])
    norm = Normalize(0.0, 100.0 * np.quantile(distances, BRIGHT))
    arrows = Arrows.of(diagnosis, [runs for _, runs in sides])
    caption = _caption(diagnosis, sides[0][1], arrows.enlarged)  # one caption for both maps
    return caption, [_drawn(diagnosis, title, runs, norm, arrows) for title, runs in sides]


@dataclass(frozen=True)
class Arrows:
    """The scale of arrows on all maps.

    enlarged : factor on their length; key : cm, length of the arrow in the key
    """

    enlarged: int
    key: int

    @classmethod
    def of(cls, diagnosis: Diagnosis, sides: Sequence[Sequence[Flown]]) -> Arrows:
        """Return the scale for a Diagnosis.

        sides : lists of Flown, before and after
        """
        errors = [mean_errors(runs, view)[1] for runs in sides for view in VIEWS]
        lengths = np.concatenate(
            [np.zeros(1), *(np.linalg.norm(error, axis=1) for error in errors)]
        )
        # a quantile, because a wrong start can have huge errors
        longest = np.quantile(lengths, BRIGHT)
        shifts = [np.linalg.norm(by) for by, _ in shifts_and_regions(diagnosis)[0].values()]
        room = np.ptp(diagnosis.flights[0].anchors.positions, axis=0).max()
        most = LONGEST * room / max(longest, *shifts, 1e-9)
        return cls(
            max((factor for factor in ENLARGED if factor <= most), default=1),
            max((key for key in KEYS if key <= 100.0 * longest), default=KEYS[0]),
        )


def _drawn(
    diagnosis: Diagnosis, title: str, runs: Sequence[Flown], norm: Normalize | None, arrows: Arrows
) -> Picture:
    low, high = _limits(diagnosis, runs)
    size = high - low
    tall = WIDTH * 0.87 * (size[1] + size[2]) / size[0]
    figure, axes = drawing(min(tall, 2.0 * WIDTH) + 1.6, nrows=2, height_ratios=size[1:])
    engine = figure.get_layout_engine()
    assert isinstance(engine, ConstrainedLayoutEngine)  # `drawing` sets it
    engine.set(w_pad=0.1)
    for ax, view in zip(axes, VIEWS):
        _path(ax, diagnosis, runs, view, norm)
        _anchors(ax, diagnosis, view, arrows.enlarged)
        key = _arrows(ax, runs, view, arrows.enlarged)
        limits = [(low[k], high[k]) for k in view]
        ax.set(
            aspect="equal",
            xlim=limits[0],
            ylim=limits[1],
            xlabel="x [m]",
            ylabel=f"{'xyz'[view[1]]} [m]",
        )
        ax.grid(alpha=0.25, lw=0.5)
        if key is not None and ax is axes[0]:
            ax.quiverkey(
                key,
                0.8,
                1.03,
                0.01 * arrows.key,
                f"{arrows.key} cm",
                labelpos="E",
                coordinates="axes",
            )
    axes[0].set_title(f"{title}: from above".lstrip(": ").capitalize(), loc="left", fontsize=10)
    axes[1].set_title(f"{title}: from the side".lstrip(": ").capitalize(), loc="left", fontsize=10)
    if norm is not None:
        colours = plt.cm.ScalarMappable(norm, COLOURS)
        figure.colorbar(
            colours,
            ax=axes,
            orientation="horizontal",
            label="position error [cm]",
            extend="max",
            aspect=40,
            pad=0.02,
        )
    return embedded(figure, _alt(diagnosis, title, runs))


def _limits(diagnosis: Diagnosis, runs: Sequence[Flown]) -> tuple[np.ndarray, np.ndarray]:
    """Return (lowest (3,), highest (3,)), m, of the drawn region."""
    paths = [run.p for run in runs] or list(map(estimated, diagnosis.remaining))
    places = [diagnosis.flights[0].anchors.positions, *paths]
    low, high = (getattr(np.concatenate(places), name)(axis=0) for name in ("min", "max"))
    return low - MARGIN, high + MARGIN


def _path(
    ax: Axes, diagnosis: Diagnosis, runs: Sequence[Flown], view: list[int], norm: Normalize | None
) -> None:
    if not runs:
        for flight in diagnosis.remaining:
            path = estimated(flight)
            ax.plot(*path[:: max(1, len(path) // POINTS), view].T, color="0.6", lw=1.0)
        return
    every = max(1, sum(len(run.t) for run in runs) // POINTS)
    for run in runs:
        t, p, distance = run.t[::every], run.p[::every, view], 100.0 * run.distance[::every]
        near = np.diff(t) < max(GAP, 2.0 * np.median(np.diff(run.t)) * every)
        parts, colour = np.stack([p[:-1], p[1:]], axis=1)[near], distance[1:][near]
        order = np.argsort(colour)  # the largest errors on top
        lines = LineCollection(
            parts[order], array=colour[order], cmap=COLOURS, norm=norm, lw=1.8, rasterized=True
        )
        ax.add_collection(lines)


def _anchors(ax: Axes, diagnosis: Diagnosis, view: list[int], enlarged: int) -> None:
    anchors = diagnosis.flights[0].anchors
    places = dict(zip(anchors.ids.tolist(), anchors.positions[:, view]))
    shifts, regions = shifts_and_regions(diagnosis)
    for region in regions:
        centre = region.centre[view]
        ax.add_patch(
            Circle(
                (centre[0], centre[1]),
                region.radius,
                fill=False,
                ec=REGION,
                ls="--",
                lw=1.4,
                zorder=3,
            )
        )
        ax.plot(*zip(centre, places[region.anchor]), color=REGION, ls=":", lw=1.0, zorder=3)
    for anchor, (by, std) in shifts.items():
        tip = places[anchor] + enlarged * by[view]
        ax.annotate("", tip, places[anchor], arrowprops=ARROW)
        width, height = 2.0 * enlarged * np.nan_to_num(std[view])
        ax.add_patch(Ellipse(tip, width, height, fc=FOUND, alpha=0.25, ec=FOUND, lw=0.8))
    ax.plot(*anchors.positions[:, view].T, "k^", ms=6, zorder=4)
    _names(ax, places, {anchor: by[view] for anchor, (by, _) in shifts.items()})


def _names(ax: Axes, places: Mapping[int, np.ndarray], shifts: Mapping[int, np.ndarray]) -> None:
    """Write ids next to anchors, opposite to their arrows.

    Anchors behind each other share a label.
    """
    middle = np.mean(list(places.values()), axis=0)
    labels: dict[tuple[float, ...], list[int]] = {}
    for anchor, place in places.items():
        near = next(
            (known for known in labels if np.linalg.norm(place - known) < BESIDE), tuple(place)
        )
        labels.setdefault(near, []).append(anchor)
    for together in labels.values():
        own = np.array([places[anchor] for anchor in together])
        way = -np.sum([shifts.get(anchor, np.zeros(2)) for anchor in together], axis=0)
        if not way.any():
            way = np.array([0.0, np.sign(own.mean(axis=0)[1] - middle[1]) or 1.0])
        way /= np.linalg.norm(way)
        ax.annotate(
            ", ".join(map(str, together)),
            own[np.argmax(own @ way)],
            AWAY * way * [1.0 + 0.4 * (len(together) > 1), 1.0],
            textcoords="offset points",
            ha="center",
            va="center",
            fontweight="bold",
            zorder=7,
        )


def _arrows(ax: Axes, runs: Sequence[Flown], view: list[int], enlarged: int) -> Quiver | None:
    """Draw arrows of mean errors, and return them; None without any."""
    places, errors = mean_errors(runs, view)
    if not len(places):
        return None
    how = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": 1.0 / enlarged,
        "width": 0.008,
        "headwidth": 4,
        "headlength": 4.5,
        "headaxislength": 4,
        "minlength": 0.1,
    }
    return ax.quiver(*places.T, *errors.T, color="k", zorder=6, **how)


def _alt(diagnosis: Diagnosis, title: str, runs: Sequence[Flown]) -> str:
    shifts, regions = shifts_and_regions(diagnosis)
    out = [f"Map of {len(diagnosis.flights[0].anchors)} anchors from above and from the side"]
    if runs:
        worst = 100.0 * max(run.distance.max() for run in runs)
        out.append(
            f"the path flown{f' {title}' if title else ''}, coloured by the position error, "
            f"at most {worst:.0f} cm"
        )
    if shifts:
        out.append(f"shifts of {len(shifts)} anchors")
    if regions:
        out.append(
            f"{len(regions)} region{'s' if len(regions) > 1 else ''} where an anchor is disturbed"
        )
    return "; ".join(out)


def _caption(diagnosis: Diagnosis, runs: Sequence[Flown], enlarged: int) -> str:
    shifts, regions = shifts_and_regions(diagnosis)
    times = f", drawn {enlarged} times as long as they are" if enlarged > 1 else ""
    out = ["Triangles: anchors with their numbers."]
    if runs:
        judged = list(dict.fromkeys(run["flight"] for run in diagnosis.before["runs"]))
        out.append(f"Flight{'s' if len(judged) > 1 else ''}: {listed(judged)}.")
        out.append(
            "Coloured: the true path, dark where the estimate errs most. Black arrows: mean "
            "error in cells of "
            f"{CELL:g} m, from the true place towards the estimate{times}."
        )
    else:
        out.append("Grey: the estimated path.")
    if shifts:
        out.append(
            f"Orange arrows: by how much anchors seem to stand elsewhere than surveyed{times}; "
            "ellipses: one standard deviation; an arrow shorter than twice that may be chance."
        )
    if regions:
        out.append(
            "Dashed circles: where the tag is when the anchor at the end of the dotted line "
            "is heard late."
        )
    return " ".join(out)
