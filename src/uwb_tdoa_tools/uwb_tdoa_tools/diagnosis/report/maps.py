# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw the room from above and from the side: anchors, findings, flown and planned paths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects.base import Region, Shift, listed

from ...scoring.metrics import Score
from ...scoring.plots import draw_labels
from ..channels import ChannelResiduals
from ..result import Diagnosis
from .pictures import COLOURS, FOUND, REGION, WIDTH, Picture, drawing, embedded, plt

VIEWS = {"From above": [0, 1], "From the side": [0, 2]}  # drawn axes: x and y, x and z
POINTS = 1500  # points of all paths together
GAP = 1.0  # s, gap in the estimate that breaks a line
MARGIN = 1.0  # m around anchors and paths
LONGEST = 0.16  # longest arrow of a shift, share of the room
ENLARGED = (1, 2, 3, 5, 10, 20, 50, 100)  # possible factors on the length of these arrows
BRIGHT = 0.95  # quantile of the errors at the end of the colour scale
ERROR_COLOURS = LinearSegmentedColormap.from_list(
    "error", plt.get_cmap("viridis_r")(np.linspace(0.06, 1.0, 64))
)
ARROW = {"arrowstyle": "-|>", "color": FOUND, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
EVERY = 2.0  # s, between arrows of the planned yaw
AHEAD = 0.5  # m, length of such an arrow


@dataclass(frozen=True)
class Flown:
    """A judged run, where its estimate is finite.

    t : (n,) s in the air; p : (n, 3) m, true position, world; distance : (n,) m, its 3D error
    """

    t: np.ndarray
    p: np.ndarray
    distance: np.ndarray


def flown(scores: Iterable[Score]) -> list[Flown]:
    """Return the Flown of Scores; Scores without an estimate are left out."""
    out = []
    for score in scores:
        known = np.isfinite(score.error).all(axis=1)
        if known.sum() > 1:
            distance = np.linalg.norm(score.error[known], axis=1)
            out.append(Flown(score.t[known] - score.first, score.p[known], distance))
    return out


def changed(diagnosis: Diagnosis) -> bool:
    """Return whether errors in the air differ between before and after.

    They do if an effect was added that acts above the floor.
    """
    return any(finding.added and not finding.on_floor for finding in diagnosis.findings)


def shifts_and_regions(
    diagnosis: Diagnosis,
) -> tuple[dict[int, tuple[np.ndarray, np.ndarray]], list[Region]]:
    """Return shifts and blocked regions of the flights' anchors in the written model.

    returns : {anchor id: (shift (3,) m, std (3,) m)}, [Region]
    """
    anchors = diagnosis.flights[0].anchors
    shifts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    regions = []
    for mark in (mark for effect in diagnosis.effects.effects for mark in effect.marks(anchors)):
        if mark.anchor not in anchors.ids:
            continue
        if isinstance(mark, Region):
            regions.append(mark)
        elif isinstance(mark, Shift):
            by, std = shifts.get(mark.anchor, (np.zeros(3), np.zeros(3)))
            shifts[mark.anchor] = by + mark.by, np.hypot(std, mark.std)
    return shifts, regions


def maps(diagnosis: Diagnosis) -> tuple[str, list[Picture]]:
    """Return (common caption, pictures): a map before and a map after.

    There is a single map if the model did not change or the errors are unknown.
    """
    before, after = (flown(side["scores"]) for side in (diagnosis.before, diagnosis.after))
    runs = [*before, *after]
    norm = None
    if runs:
        distances = np.concatenate([run.distance for run in runs])
        norm = Normalize(0.0, 100.0 * np.quantile(distances, BRIGHT))
    sides = {"": before}
    if runs and changed(diagnosis):
        sides = {"before": before, "after": after}
    pictures = [_map(diagnosis, title, runs, norm) for title, runs in sides.items()]
    return _caption(diagnosis, bool(runs)), pictures


def _map(
    diagnosis: Diagnosis, title: str, runs: Sequence[Flown], norm: Normalize | None
) -> Picture:
    paths = [run.p for run in runs] or [_estimated(flight) for flight in diagnosis.remaining]
    figure, axes = _views(diagnosis, paths, 1.6)
    for ax, (name, view) in zip(axes, VIEWS.items()):
        ax.set_title(f"{title}: {name.lower()}".lstrip(": ").capitalize(), loc="left", fontsize=10)
        _findings(ax, diagnosis, view)
        for run in runs:
            _coloured(ax, run, view, norm)
        for path in paths if not runs else ():
            ax.plot(*path[:: max(1, len(path) // POINTS), view].T, color="0.6", lw=1.0)
    if norm is not None:
        colours = plt.cm.ScalarMappable(norm, ERROR_COLOURS)
        label = "position error [cm]"
        figure.colorbar(
            colours, ax=axes, orientation="horizontal", label=label, extend="max", aspect=40
        )
    anchors = diagnosis.flights[0].anchors
    enlarged = _enlargement(diagnosis)
    shifts, _ = shifts_and_regions(diagnosis)
    tips = [
        anchors.positions[anchors.index(anchor)] + enlarged * by
        for anchor, (by, _) in shifts.items()
    ]
    _label(figure, axes, anchors, np.reshape(tips, (-1, 3)))
    return embedded(figure, _alt(diagnosis, title, runs))


def _views(
    diagnosis: Diagnosis, paths: Sequence[np.ndarray], more: float
) -> tuple[Figure, Sequence[Axes]]:
    """Return (Figure, axes) that show the anchors from above and from the side.

    paths : [(n, 3) m] that must be inside; more : in, height of what stands beside the axes
    """
    places = np.concatenate([diagnosis.flights[0].anchors.positions, *paths])
    low, high = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    size = high - low
    tall = 0.87 * WIDTH * (size[1] + size[2]) / size[0]
    figure, axes = drawing(min(tall, 2.0 * WIDTH) + more, nrows=2, height_ratios=size[1:])
    for ax, (name, view) in zip(axes, VIEWS.items()):
        x, y = view
        ax.set(aspect="equal", xlim=(low[x], high[x]), ylim=(low[y], high[y]))
        ax.set(xlabel="x [m]", ylabel=f"{'xyz'[y]} [m]")
        ax.set_title(name, loc="left", fontsize=10)
        ax.grid(True)
        ax.plot(*diagnosis.flights[0].anchors.positions[:, view].T, "k^", ms=6, zorder=4)
    return figure, axes


def _label(figure: Figure, axes: Sequence[Axes], anchors: Anchors, avoided: np.ndarray) -> None:
    """Write the ids of anchors beside them, away from points `avoided` (m, 3), m."""
    figure.draw_without_rendering()
    for ax, view in zip(axes, VIEWS.values()):
        draw_labels(ax, anchors.ids.tolist(), anchors.positions[:, view], avoided[:, view])


def _coloured(ax: Axes, run: Flown, view: list[int], norm: Normalize | None) -> None:
    """Draw a run, coloured by its error."""
    every = max(1, len(run.t) // POINTS)
    t, p, distance = run.t[::every], run.p[::every, view], 100.0 * run.distance[::every]
    near = np.diff(t) < max(GAP, 2.0 * np.median(np.diff(run.t)) * every)
    parts, colour = np.stack([p[:-1], p[1:]], axis=1)[near], distance[1:][near]
    order = np.argsort(colour)  # the largest errors on top
    lines = LineCollection(
        parts[order], array=colour[order], cmap=ERROR_COLOURS, norm=norm, lw=1.8, rasterized=True
    )
    ax.add_collection(lines)


def _findings(ax: Axes, diagnosis: Diagnosis, view: list[int]) -> None:
    """Draw shifts of anchors and blocked regions."""
    anchors = diagnosis.flights[0].anchors
    places = dict(zip(anchors.ids.tolist(), anchors.positions[:, view]))
    shifts, regions = shifts_and_regions(diagnosis)
    enlarged = _enlargement(diagnosis)
    for region in regions:
        x, y = region.centre[view]
        circle = Circle((x, y), region.radius, fill=False, ec=REGION, ls="--", lw=1.4, zorder=3)
        ax.add_patch(circle)
        ax.plot(*zip((x, y), places[region.anchor]), color=REGION, ls=":", lw=1.0, zorder=3)
    for anchor, (by, std) in shifts.items():
        tip = places[anchor] + enlarged * by[view]
        ax.annotate("", tip, places[anchor], arrowprops=ARROW)
        width, height = 2.0 * enlarged * np.nan_to_num(std[view])
        ax.add_patch(Ellipse(tip, width, height, fc=FOUND, alpha=0.25, ec=FOUND, lw=0.8))


def _enlargement(diagnosis: Diagnosis) -> int:
    """Return the factor on the length of arrows of shifts."""
    shifts, _ = shifts_and_regions(diagnosis)
    longest = max((float(np.linalg.norm(by)) for by, _ in shifts.values()), default=0.0)
    room = np.ptp(diagnosis.flights[0].anchors.positions, axis=0).max()
    possible = [factor for factor in ENLARGED if factor * longest <= LONGEST * room]
    return possible[-1] if longest and possible else 1


def _estimated(flight: ChannelResiduals) -> np.ndarray:
    """Return the estimated path in the air, (n, 3) m, of {channel: ChannelResidual}."""
    rows = next(iter(flight.values())).rows()
    return rows.place[np.argsort(rows.t, kind="stable")]


def _alt(diagnosis: Diagnosis, title: str, runs: Sequence[Flown]) -> str:
    """Return the alternative text of a map.

    title : "", "before" or "after"; runs : empty if the errors are unknown
    """
    shifts, regions = shifts_and_regions(diagnosis)
    out = [f"Map of {len(diagnosis.flights[0].anchors)} anchors from above and from the side"]
    if runs:
        worst = 100.0 * max(run.distance.max() for run in runs)
        out.append(
            f"the path flown{f' {title}' if title else ''}, coloured by the position error, "
            f"at most {worst:.0f} cm"
        )
    if shifts:
        out.append(f"shifts of {len(shifts)} anchor{'s' if len(shifts) > 1 else ''}")
    if regions:
        plural = "s" if len(regions) > 1 else ""
        out.append(f"{len(regions)} region{plural} where an anchor is disturbed")
    return "; ".join(out)


def _caption(diagnosis: Diagnosis, judged: bool) -> str:
    shifts, regions = shifts_and_regions(diagnosis)
    enlarged = _enlargement(diagnosis)
    out = ["Triangles: anchors with their numbers."]
    if judged:
        names = list(dict.fromkeys(run["flight"] for run in diagnosis.before["runs"]))
        out.append(f"Flight{'s' if len(names) > 1 else ''}: {listed(names)}.")
        out.append("Coloured: the true path, dark where the estimate errs most.")
    else:
        out.append("Grey: the estimated path.")
    if shifts:
        times = f", drawn {enlarged} times as long as they are" if enlarged > 1 else ""
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


def planned(diagnosis: Diagnosis) -> Picture:
    """Return the picture of the planned flight: one colour for each motion, arrows for the yaw."""
    plan = diagnosis.next_flight
    assert plan is not None  # the page asks for it only then
    path = plan.path
    figure, axes = _views(diagnosis, [path.p], 1.4 + 0.17 * len(plan.parts))
    ends = [*(start for start, _ in plan.parts), path.duration]
    colours = iter(COLOURS * len(plan.parts))
    for (first, what), last in zip(plan.parts, ends[1:]):
        inside = (path.t >= first) & (path.t <= last)
        style: dict[str, Any] = {"color": "0.6", "ls": ":"}
        if what != "way":
            style = {"color": next(colours), "label": f"{first:.0f} s: {what}"}
        for ax, view in zip(axes, VIEWS.values()):
            ax.plot(*path.p[inside][:, view].T, lw=2.0, **style)
    for ax, view in zip(axes, VIEWS.values()):
        ax.plot(*path.p[0, view], "ko", ms=5)
    at = np.flatnonzero(np.diff(np.floor(path.t / EVERY), prepend=-1.0))
    ahead = AHEAD * np.array([np.cos(path.yaw[at]), np.sin(path.yaw[at])])
    how = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.006, "color": "0.25"}
    axes[0].quiver(*path.p[at, :2].T, *ahead, zorder=3, **how)
    lines, words = axes[0].get_legend_handles_labels()
    figure.legend(lines, words, loc="outside lower center", ncols=1, fontsize=8)
    _label(figure, axes, diagnosis.flights[0].anchors, path.p[::5])
    return embedded(
        figure,
        f"Planned path of {path.duration:.0f} s among the anchors, from above and from the side",
        "Path of next_flight.csv. The dot is its start; dotted lines lead to the next motion; "
        "triangles are anchors; arrows from above show the yaw every 2 s.",
    )
