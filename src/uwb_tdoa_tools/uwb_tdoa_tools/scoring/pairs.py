# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Residuals of TDOAs at the true place, of each pair of anchors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import true_samples
from uwb_tdoa_bias.effects.base import listed

from .metrics import rms, scored_phase

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.correction.corrector import Corrector

PERIOD = 1.0  # s, of one residual of a pair
FEWEST = 3  # TDOAs of a pair in it
CM = 100.0  # cm per metre
LARGEST = 2  # pairs that are named
NAMED = 7  # pairs in colours: those with the most error; an eighth would be grey
DRAWN = 200  # pairs in a picture at most: those with the largest residuals
GREY: dict[str, Any] = {"color": "0.75", "lw": 0.8, "zorder": 1}  # of the other pairs
LOWEST = 0.2  # m, smallest limit of the axis of residuals: noise looks small


@dataclass(frozen=True, eq=False)
class PairResiduals:
    """Residuals of TDOAs at the true place: medians over PERIOD, of each pair of anchors.

    Attributes
    ----------
    t : (n,) s since take-off
    median : {pair "a-b": (n,) m}, NaN where a pair has fewer than FEWEST TDOAs
    """

    t: np.ndarray
    median: dict[str, np.ndarray]

    @property
    def size(self) -> float:
        """Return the root mean square, m."""
        return _known_rms(*self.median.values())

    @property
    def constant(self) -> float:
        """Return the root mean square of the mean of each pair, m: what the path does not change."""
        return rms(np.array([np.nanmean(values) for values in self.median.values()]))

    @property
    def changing(self) -> float:
        """Return the root mean square around the mean of each pair, m."""
        return _known_rms(*(values - np.nanmean(values) for values in self.median.values()))

    @property
    def limit(self) -> float:
        """Return the limit of an axis that shows all residuals, m."""
        largest = [float(np.nanmax(np.abs(values))) for values in self.median.values()]
        return 1.1 * max([LOWEST, *largest])

    def largest(self, count: int) -> list[str]:
        """Return the pairs with the largest sum of squares: one that is seldom heard counts less."""
        sizes = {pair: np.nansum(values**2) for pair, values in self.median.items()}
        return sorted(sizes, key=lambda pair: -sizes[pair])[:count]

    def sentences(self) -> list[str]:
        """Return the residuals in words: their size, and over what they change."""
        named = listed(
            f"{pair} ({_signed_cm(self.median[pair])})" for pair in self.largest(LARGEST)
        )
        return [
            f"TDOAs are {CM * self.size:.1f} cm off (RMS over pairs of anchors and seconds)",
            f"{CM * self.constant:.1f} cm of it stays the same for a pair, "
            f"{CM * self.changing:.1f} cm changes along the path; largest for pairs {named}",
        ]

    def draw(self, ax: Axes, before: PairResiduals) -> None:
        """Draw a line for each pair; `before` sets the axis, and which pairs have colours."""
        for number, pair in enumerate(before.largest(DRAWN)):
            style: dict[str, Any] = (
                {"color": f"C{number}", "lw": 1.8, "label": pair} if number < NAMED else GREY
            )
            ax.plot(self.t, CM * self.median.get(pair, np.full(len(self.t), np.nan)), **style)
        ax.set(xlabel="time in the air [s]", ylabel="residual [cm]")
        ax.set_ylim(-CM * before.limit, CM * before.limit)
        ax.grid(alpha=0.3)


def _known_rms(*parts: np.ndarray) -> float:
    """Return the root mean square of all values that are known."""
    together = np.concatenate([*parts, []])
    return rms(together[np.isfinite(together)])


def _signed_cm(values: np.ndarray) -> str:
    low, high = (CM * value for value in np.nanquantile(values, [0.1, 0.9]))
    return f"{low:+.0f} to {high:+.0f} cm"


def residuals_of(flight: Flight, corrector: Corrector | None = None) -> PairResiduals:
    """Return the PairResiduals of a Flight with ground truth in the air, corrected if asked."""
    samples, rows = true_samples(flight)
    off = flight.tdoa.d[rows] - tdoa(samples.p, samples.position_a, samples.position_b)
    if corrector is not None:
        off = off - corrector.prediction(samples).bias
    _, first, last = scored_phase(flight.known_truth)
    number, count = (samples.t - first) // PERIOD, int((last - first) / PERIOD)
    rows = np.flatnonzero((number >= 0) & (number < count))
    cells = np.column_stack([samples.a, samples.b, number])[rows].astype(int)
    cells, which = np.unique(cells, axis=0, return_inverse=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(which.reshape(-1)))[:-1]
    ids = flight.anchors.ids
    found: dict[str, np.ndarray] = {}
    for (a, b, k), part in zip(cells, np.split(off[rows][order], ends)):
        if len(part) >= FEWEST:
            values = found.setdefault(f"{ids[a]}-{ids[b]}", np.full(count, np.nan))
            values[k] = np.median(part)
    return PairResiduals(PERIOD * (np.arange(count) + 0.5), found)
