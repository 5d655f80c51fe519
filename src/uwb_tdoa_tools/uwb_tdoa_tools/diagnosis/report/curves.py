# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw curves: error over time, residuals, and functions without a name."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_bias.effects.base import listed
from uwb_tdoa_bias.effects.samples import shown_in
from uwb_tdoa_bias.effects.smooth_term import described

from ...scoring.pairs import residuals_of
from ..channels import CHANNELS, ChannelResiduals
from ..findings import prefixes_of
from ..result import Diagnosis
from .entries import CM
from .maps import Flown, changed, flown
from .pictures import AFTER, BEFORE, COLOURS, Picture, drawing, embedded
from .tables import labels

BINS = 300  # bins of a curve over time; the largest value of each is drawn
MOST = 12  # largest number of drawn flights
FUNCTIONS = 12  # that are drawn
GRID = 120  # values of each covariate in the picture of a product
POINTS = 3000  # largest number of drawn points of a residual series
# position of a legend above the axes
ABOVE = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 2}


def residuals_of_pairs(diagnosis: Diagnosis) -> list[Picture]:
    """Draw the residuals of each pair in the first judged flight, before and after.

    returns : [] without TDOAs, or if the reference does not know all of the path
    """
    if not (diagnosis.cases and all(diagnosis.reference.positions_known)):
        return []
    flight = diagnosis.cases[0].flight
    if flight.truth is None or not len(flight.tdoa):
        return []
    sides = {"before": diagnosis.base}
    if changed(diagnosis):
        sides["after"] = diagnosis.cases[0].effects
    found = {
        title: residuals_of(effects.correct_streams(flight), Corrector(flight.anchors, effects))
        for title, effects in sides.items()
    }
    out = []
    for title, residuals in found.items():
        figure, ax = drawing(2.8)
        residuals.draw(ax, found["before"])
        size = f"{CM * residuals.size:.1f} cm"
        ax.set_title(f"{title.capitalize()}: RMS {size}", loc="left", fontsize=10)
        figure.legend(loc="outside lower center", ncols=4, fontsize=8, title="pair of anchors")
        alt = f"Residuals of the TDOAs of each pair of anchors {title}, {flight.name}: {size}"
        out.append(embedded(figure, alt))
    return out


def errors_over_time(diagnosis: Diagnosis) -> tuple[list[Picture], int]:
    """Draw the 3D error of each judged run, before and after, and mark the maximum.

    returns : pictures, number of runs
    """
    sides = {"error": diagnosis.before}
    if changed(diagnosis):
        sides = {"before": diagnosis.before, "after": diagnosis.after}
    runs = []
    for k, name in enumerate(labels(diagnosis)):
        each = {title: flown(side["scores"][k : k + 1]) for title, side in sides.items()}
        curves = {title: some[0] for title, some in each.items() if some}
        if curves:
            runs.append((name, curves))
    shown = runs[:MOST]
    top = max((run.distance.max() for _, curves in shown for run in curves.values()), default=0.0)
    return [_errors(name, curves, CM * top) for name, curves in shown], len(runs)


def _errors(name: str, curves: dict[str, Flown], top: float) -> Picture:
    """Return the picture of one run.

    curves : {"before", "after" or "error": Flown}; top : cm, largest error in any picture
    """
    figure, ax = drawing(2.4)
    largest = []
    for title, run in curves.items():
        colour = BEFORE if title == "before" else AFTER
        t, distance, k = run.t, CM * run.distance, int(np.argmax(run.distance))
        words = f"{distance[k]:.0f} cm ({title})"
        ax.plot(*_peaks(t, distance), color=colour, lw=1.2, label=f"at most {words}")
        ax.plot(t[k], distance[k], "o", color=colour, ms=5)
        largest.append(words)
    ax.set(xlabel="time in the air [s]", ylabel="position error [cm]", ylim=(0.0, 1.35 * top))
    ax.set_title(name, loc="left", fontsize=10)
    ax.grid(True)
    ax.legend(loc="upper right")
    return embedded(figure, f"Position error over time, {name}: at most {listed(largest)}")


def _peaks(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a series reduced to the largest value of each of BINS bins."""
    if len(t) <= BINS:
        return t, values
    starts = np.linspace(0, len(t), BINS, endpoint=False).astype(int)
    largest = np.maximum.reduceat(values, starts)
    return t[starts], largest


def residual_series(diagnosis: Diagnosis) -> list[Picture]:
    """Draw the residuals of each channel in the first flight, before and after."""
    before = _series(diagnosis.attribution.residuals[0])
    after = _series(diagnosis.remaining[0])
    name = diagnosis.flights[0].name
    return [
        _residuals(f"{label}, {name}", {"before": before[label], "after": after[label]})
        for label in before
        if label in after
    ]


def _series(flight: ChannelResiduals) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return {label: (stamps s, residuals)} of {channel: ChannelResidual}."""
    return {label: series for part in flight.values() for label, series in part.series().items()}


def _residuals(name: str, sides: dict[str, tuple[np.ndarray, np.ndarray]]) -> Picture:
    figure, ax = drawing(1.8)
    limit = 1.3 * np.quantile(np.abs(sides["before"][1]), 0.99) + 1e-9
    scatter = []
    for (title, (t, r)), colour in zip(sides.items(), (BEFORE, AFTER)):
        every = max(1, len(t) // POINTS)
        style = {"ms": 2.0, "color": colour, "rasterized": True}
        ax.plot(t[::every], r[::every], ".", label=title, **style)
        scatter.append(f"{np.std(np.clip(r, -limit, limit)):.2g} {title}")
    ax.set(ylim=(-limit, limit), xlabel="time [s]")
    ax.set_title(name.replace("^2", "²"), loc="left", fontsize=10)
    ax.grid(True)
    ax.legend(**ABOVE, markerscale=5)
    return embedded(figure, f"Residual of {name} over time, standard deviation {listed(scatter)}")


def functions(diagnosis: Diagnosis) -> list[Picture]:
    """Draw the functions without a name, in the model or not."""
    found = [finding.function for finding in diagnosis.findings if finding.function]
    return [_product(term) if term.factor else _function(term) for term in found[:FUNCTIONS]]


def _product(effect: SmoothTerm) -> Picture:
    """Draw a function of two covariates, over the values that the flights have."""
    low, high = effect.knots[0], effect.knots[-1]
    if effect.shape in ("wave", "pulse"):  # their knots are one period
        low, high = effect.domain.get(effect.covariate, (low, high))
    x = np.linspace(low, high, GRID)
    y = np.linspace(effect.factor_knots[0], effect.factor_knots[-1], GRID)
    prefix = prefixes_of(effect)[0]
    values = effect.curve(np.tile(x, GRID), prefix, np.repeat(y, GRID)).reshape(GRID, GRID)
    part = CHANNELS[effect.channel.partition(".")[0]]
    figure, ax = drawing(2.6)
    most = np.abs(values).max()
    (x_unit, x_factor), (y_unit, y_factor) = (
        shown_in(name, "as recorded") for name in effect.arguments
    )
    x, y = x_factor * x, y_factor * y
    mesh = ax.pcolormesh(
        x, y, values, shading="nearest", cmap="RdBu_r", vmin=-most, vmax=most, rasterized=True
    )
    figure.colorbar(mesh, ax=ax, label=f"part of {effect.channel} [{part.unit}]")
    names = [name.replace("_", " ") for name in effect.arguments]
    ax.set(xlabel=f"{names[0]} [{x_unit}]", ylabel=f"{names[1]} [{y_unit}]")
    said = described(effect, prefix.rstrip(".")).capitalize()
    caption = f"{said}. Beyond these values it fades."
    subject = effect.label.rpartition(" over ")[0]
    return embedded(figure, f"Function of {listed(names)} in {subject}", caption)


def _function(effect: SmoothTerm) -> Picture:
    at = np.linspace(effect.knots[0], effect.knots[-1], 60)
    prefixes = prefixes_of(effect)
    covariate, part = effect.covariate.replace("_", " "), CHANNELS[effect.channel.partition(".")[0]]
    unit, factor = shown_in(effect.covariate, "as recorded")
    figure, ax = drawing(2.6)
    for k, prefix in enumerate(prefixes):
        style = ("-", "--", ":", "-.")[k // len(COLOURS) % 4]
        colour = COLOURS[k % len(COLOURS)]
        ax.plot(
            factor * at,
            effect.curve(at, prefix),
            colour,
            ls=style,
            lw=1.4,
            label=prefix.rstrip("."),
        )
    ax.set(
        xlabel=f"{covariate} [{unit}]",
        ylabel=f"part of {effect.channel} [{part.unit}]",
    )
    ax.grid(True)
    if len(prefixes) > 1:
        ax.legend(title="anchor", loc="center left", bbox_to_anchor=(1.0, 0.5))
        caption = f"What depends on {covariate} without having a name, a curve for each anchor."
    else:
        spread, course = effect.spread(at, prefixes[0]), effect.curve(at, prefixes[0])
        ax.fill_between(
            factor * at, course - spread, course + spread, color=COLOURS[0], alpha=0.2, lw=0
        )
        said = described(effect, prefixes[0].rstrip("."))
        caption = f"{said}. The band is twice the standard deviation wide.".capitalize()
    subject = effect.label.rpartition(" over ")[0]
    return embedded(figure, f"Function of {covariate} in {subject}", caption)
