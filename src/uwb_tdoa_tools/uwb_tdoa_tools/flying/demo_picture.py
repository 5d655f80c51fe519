# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw what a correction does to a flight."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.files import write_filled
from uwb_tdoa_bias.effects.base import listed

from ..scoring.metrics import Score, position_at
from .loop import CM, PairResiduals

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from uwb_tdoa_bias.common.flight import Flight


COLOURS = ("tab:red", "tab:blue")  # of a flight without and with the correction
SIZE = 14  # points: legible if the picture is shrunk to 700 pixels
NAMED = 8  # pairs in the legend: those with the largest residuals
ROOM = 1.3  # of the largest error, the end of the axis: the legend covers no line


def draw(
    path: Path, flight: Flight, residuals: Sequence[PairResiduals], scores: Sequence[Score]
) -> None:
    """Draw the residuals of TDOAs, the path and the error of a Flight to an image file.

    Parameters
    ----------
    path : Path
    flight : Flight
    residuals, scores : sequence
        Without a correction, and with it, if there is one.
    """
    from matplotlib import rc_context  # takes a second to import
    from matplotlib.figure import Figure

    with rc_context({"font.size": SIZE, "axes.titlesize": SIZE, "legend.fontsize": SIZE - 2}):
        figure = Figure(figsize=(12, 9.5), layout="constrained")
        axes = figure.subplots(2, 2)
        values = np.abs(np.concatenate(list(residuals[0].median.values())))
        limit = 1.1 * CM * max(float(np.nanmax(values)), 0.05)
        for ax, one, score in zip(axes[0], residuals, scores):
            _residuals(ax, one)
            ax.set(title=f"TDOAs {score.name}: {CM * one.size:.1f} cm off", ylim=(-limit, limit))
        ax.legend(title="pair of anchors", ncols=4, loc="lower center", handlelength=1.0)
        _path(axes[1, 0], flight, scores)
        _error(axes[1, 1], scores)
        write_filled(path, partial(figure.savefig, dpi=100))


def _residuals(ax: Axes, residuals: PairResiduals) -> None:
    named = residuals.largest(NAMED)
    for pair, values in residuals.median.items():
        ax.plot(residuals.t, CM * values, lw=1.8, label=pair if pair in named else None)
    ax.set(xlabel="time in the air [s]", ylabel="residual [cm]")
    ax.grid(alpha=0.3)


def _path(ax: Axes, flight: Flight, scores: Sequence[Score]) -> None:
    truth = flight.truth
    assert truth is not None
    first, last = scores[0].first, scores[0].last
    flown = (truth.t >= first) & (truth.t <= last)
    ax.plot(*truth.p[flown, :2].T, "k", lw=2.5, label="true")
    for score, colour in zip(scores, COLOURS):
        estimate = position_at(score.t, truth) + score.error
        ax.plot(*estimate[:, :2].T, color=colour, lw=1.2, label=score.name)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="Path from above")
    ax.legend(loc="best")
    ax.grid(alpha=0.3)


def _error(ax: Axes, scores: Sequence[Score]) -> None:
    for score, colour in zip(scores, COLOURS):
        size = CM * np.linalg.norm(score.error, axis=1)
        ax.plot(score.t - score.first, size, color=colour, lw=1.5, label=score.name)
    sizes = [f"{CM * score.row()['rmse_3d']:.1f}" for score in scores]
    highest = CM * max(np.linalg.norm(score.error, axis=1).max() for score in scores)
    ax.set(xlabel="time in the air [s]", ylabel="3D position error [cm]")
    ax.set_ylim(0.0, ROOM * highest)
    ax.set_title(f"Position: {listed(sizes)} cm off")
    ax.legend(loc="upper right", ncols=2)
    ax.grid(alpha=0.3)
