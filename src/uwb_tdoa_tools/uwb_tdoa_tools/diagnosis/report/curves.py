# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw curves: error over time, residuals, and functions without a name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.effects.base import listed
from uwb_tdoa_bias.effects.covariates import UNITS
from uwb_tdoa_bias.effects.smooth_term import described

from ..channels import CHANNELS
from ..health import health
from .pictures import AFTER, BEFORE, COLOURS, FULL, WIDTH, Picture, drawing, embedded
from .room import changed, flown
from .runs import CM, labels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from uwb_tdoa_bias.effects import SmoothTerm

    from ..channels import ChannelResiduals
    from ..result import Diagnosis
    from .room import Flown

    _Curve = tuple[str, str, Flown]  # title, colour

BINS = 300  # bins of a curve over time; the largest value of each is drawn
MOST = 12  # largest number of drawn flights
PAIRS, FEWEST = 16, 20  # largest number of drawn pairs, and fewest measurements of a pair
FUNCTIONS = 12  # that are drawn
POINTS = 3000  # largest number of drawn points of a residual series
# position of a legend above the axes
ABOVE = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 2, "frameon": False}


def errors_over_time(diagnosis: Diagnosis) -> tuple[list[Picture], int]:
    """Draw the 3D error of each judged run, before and after, and mark the maximum.

    returns : pictures, number of runs
    """
    sides = (
        [("before", BEFORE, diagnosis.before), ("after", AFTER, diagnosis.after)]
        if changed(diagnosis)
        else []
    )
    sides = sides or [("error", AFTER, diagnosis.before)]
    curves = [
        [
            (title, colour, run)
            for title, colour, side in sides
            for run in flown(side["scores"][k : k + 1])
        ]
        for k in range(len(diagnosis.before["scores"]))
    ]
    runs = [(name, each) for name, each in zip(labels(diagnosis), curves) if each]
    top = CM * max(
        (run.distance.max() for _, each in runs[:MOST] for _, _, run in each), default=0.0
    )
    return [_errors(name, each, top) for name, each in runs[:MOST]], len(runs)


def _errors(name: str, each: Sequence[_Curve], top: float) -> Picture:
    """Return the picture of one run.

    each : [(title, colour, Flown)]; top : cm, largest error in any picture
    """
    largest = listed(f"{CM * run.distance.max():.0f} cm ({title})" for title, _, run in each)
    wide, narrow = (_drawn_errors(name, each, top, width) for width in (FULL, WIDTH))
    return embedded(wide, f"Position error over time, {name}: at most {largest}", narrow=narrow)


def _drawn_errors(name: str, each: Sequence[_Curve], top: float, width: float) -> Figure:
    figure, ax = drawing(2.4, width)
    peaks = []
    for title, colour, run in each:
        t, distance, k = run.t, CM * run.distance, int(np.argmax(run.distance))
        ax.plot(*_peaks(t, distance), color=colour, lw=1.2, label=title)
        ax.plot(t[k], distance[k], "o", color=colour, ms=5)
        peaks.append((t[k], distance[k], colour))
    for t, distance, colour in peaks:
        near = [
            other
            for other in peaks
            if other[1] != distance
            and abs(other[0] - t) < 0.15 * each[0][2].t[-1]
            and abs(other[1] - distance) < 0.2 * top
        ]
        below = any(other[1] > distance for other in near)  # the labels would overlap
        right = t > 0.5 * each[0][2].t[-1]
        place = {
            "xytext": (-6 if right else 6, -11 if below else 3),
            "textcoords": "offset points",
            "ha": "right" if right else "left",
        }
        ax.annotate(f"{distance:.0f} cm", (t, distance), color=colour, fontweight="bold", **place)
    ax.set(xlabel="time in the air [s]", ylabel="position error [cm]", ylim=(0.0, 1.35 * top))
    ax.set_title(name, loc="left", fontsize=10)
    ax.grid(alpha=0.25, lw=0.5)
    if len(each) > 1:
        ax.legend(loc="upper right", ncols=2, frameon=False)
    return figure


def _peaks(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a series reduced to the largest value of each of BINS bins."""
    if len(t) <= BINS:
        return t, values
    starts = np.linspace(0, len(t), BINS, endpoint=False).astype(int)
    largest = np.maximum.reduceat(values, starts)
    return t[starts], largest


def residual_series(diagnosis: Diagnosis) -> list[Picture]:
    """Draw the residuals of each channel in the first flight, before and after."""
    before, after = (
        _series(found[0]) for found in (diagnosis.attribution.residuals, diagnosis.remaining)
    )
    return [
        _residuals(f"{name}, {diagnosis.flights[0].name}", before[name], after[name])
        for name in before
        if name in after
    ]


def _series(flight: ChannelResiduals) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return {label: (stamps s, residuals)} of {channel: ChannelResidual}."""
    return {label: series for part in flight.values() for label, series in part.series().items()}


def _residuals(name: str, *sides: tuple[np.ndarray, np.ndarray]) -> Picture:
    figure, ax = drawing(1.8)
    for side, colour, title in zip(sides, (BEFORE, AFTER), ("before", "after")):
        t, r = (values[:: max(1, len(values) // POINTS)] for values in side)
        ax.plot(t, r, ".", ms=2.0, color=colour, label=title, rasterized=True)
    limit = 1.3 * np.quantile(np.abs(sides[0][1]), 0.99) + 1e-9
    ax.set(ylim=(-limit, limit), xlabel="time [s]")
    ax.set_title(name.replace("^2", "²"), loc="left", fontsize=10)
    ax.grid(alpha=0.25, lw=0.5)
    ax.legend(**ABOVE, markerscale=5)
    scatter = " and ".join(
        f"{np.std(np.clip(r, -limit, limit)):.2g} {title}"
        for (_, r), title in zip(sides, ("before", "after"))
    )
    return embedded(figure, f"Residual of {name} over time, standard deviation {scatter}")


def pairs(diagnosis: Diagnosis) -> list[Picture]:
    """Draw offset and scatter of the residual of each pair of anchors, before and after.

    The list is empty without pairs.
    """
    after = {item["pair"]: item for item in health(diagnosis.remaining)["pairs"]}
    before = {
        item["pair"]: item
        for item in diagnosis.health["pairs"]
        if item["count"] >= FEWEST and item["pair"] in after
    }
    names = sorted(before, key=lambda name: -before[name]["count"])[:PAIRS]
    if not names:
        return []
    sides, of = (before, after), listed(flight.name for flight in diagnosis.flights)
    caption = (
        "Dots: by how much the measurements of a pair are off, their median; bars: how much they "
        f"scatter about it. Of {of}."
    )
    wide, narrow = (_drawn_pairs(names, sides, width) for width in (FULL, WIDTH))
    return [
        embedded(
            wide,
            "Offset and scatter of the residual of every pair of anchors, before and after",
            caption,
            narrow,
        )
    ]


def _drawn_pairs(
    names: Sequence[str], sides: tuple[dict[str, Any], dict[str, Any]], width: float
) -> Figure:
    before, after = sides
    figure, ax = drawing(3.0, width)
    for shift, side, colour, title in (
        (-0.15, before, BEFORE, "before"),
        (0.15, after, AFTER, "after"),
    ):
        bias, spread = (
            CM * np.array([side[name][key] for name in names]) for key in ("bias", "spread")
        )
        ax.errorbar(
            np.arange(len(names)) + shift,
            bias,
            spread,
            fmt="o",
            ms=4,
            color=colour,
            label=title,
            lw=1.2,
        )
    ax.axhline(0.0, color="k", lw=0.6)
    ax.set(xticks=np.arange(len(names)), xlabel="pair of anchors", ylabel="residual [cm]")
    ax.set_xticklabels(names, rotation=0 if width == FULL else 90)
    ax.grid(alpha=0.25, lw=0.5, axis="y")
    ax.legend(**ABOVE)
    return figure


def functions(diagnosis: Diagnosis) -> list[Picture]:
    """Draw the functions without a name, in the model or not."""
    return [_function(finding.function) for finding in diagnosis.findings if finding.function][
        :FUNCTIONS
    ]


def _function(effect: SmoothTerm) -> Picture:
    at = np.linspace(effect.knots[0], effect.knots[-1], 60)
    prefixes = sorted({key.rpartition("c")[0] for key in effect.values})
    figure, ax = drawing(2.6)
    for k, prefix in enumerate(prefixes):
        style = ("-", "--", ":", "-.")[k // len(COLOURS) % 4]
        ax.plot(
            at,
            effect.curve(at, prefix),
            COLOURS[k % len(COLOURS)],
            ls=style,
            lw=1.4,
            label=prefix.rstrip(".") or None,
        )
    if len(prefixes) == 1:
        spread, course = effect.spread(at, prefixes[0]), effect.curve(at, prefixes[0])
        ax.fill_between(at, course - spread, course + spread, color=COLOURS[0], alpha=0.2, lw=0)
    covariate, part = effect.covariate.replace("_", " "), CHANNELS[effect.channel.partition(".")[0]]
    ax.set(
        xlabel=f"{covariate} [{UNITS.get(effect.covariate, 'as recorded')}]",
        ylabel=f"part of {effect.channel} [{part.unit}]",
    )
    ax.grid(alpha=0.25, lw=0.5)
    if len(prefixes) > 1:
        ax.legend(title="anchor", loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    caption = f"What depends on {covariate} without having a name, a curve for each anchor."
    if len(prefixes) == 1:
        caption = (
            f"{described(effect, prefixes[0].rstrip('.'))}. The band is twice the standard "
            "deviation wide."
        ).capitalize()
    return embedded(
        figure, f"Function of {covariate} in {effect.label.rpartition(' over ')[0]}", caption
    )
