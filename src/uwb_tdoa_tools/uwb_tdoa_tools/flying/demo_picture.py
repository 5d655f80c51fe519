"""Draw what a correction does to a flight. The import selects a backend without a screen."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from uwb_tdoa_bias.common.files import write_filled  # noqa: E402
from uwb_tdoa_bias.effects.base import listed  # noqa: E402

from ..scoring.metrics import position_at  # noqa: E402
from .loop import CM  # noqa: E402

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from .demo import LoopResult
    from .loop import PairResiduals

COLOURS = ("tab:red", "tab:blue")  # of a flight without and with the correction
SIZE = 14  # points: legible if the picture is shrunk to 700 pixels
ROOM = 1.3  # of the largest error, the end of the axis: the legend covers no line


def draw(result: LoopResult, path: Path) -> None:
    """Draw residuals before and after, the path and the error to an image file."""
    with plt.rc_context({"font.size": SIZE, "axes.titlesize": SIZE, "legend.fontsize": SIZE - 2}):
        figure, axes = plt.subplots(2, 2, figsize=(12, 9.5), layout="constrained")
        limit = _limit(result.residuals[0])
        for ax, residuals, score in zip(axes[0], result.residuals, result.scores):
            _residuals(ax, residuals, limit)
            ax.set_title(f"TDOAs {score.name} bias.onnx: {CM * residuals.size:.1f} cm off")
        ax.legend(title="pair of anchors", ncols=4, loc="lower center", handlelength=1.0)
        _path(axes[1, 0], result)
        _error(axes[1, 1], result)
        write_filled(path, partial(figure.savefig, dpi=100))
        plt.close(figure)


def _limit(residuals: PairResiduals) -> float:
    values = np.abs(np.concatenate(list(residuals.median.values())))
    return float(1.1 * CM * max(np.nanmax(values), 0.05))


def _residuals(ax: Axes, residuals: PairResiduals, limit: float) -> None:
    for pair, values in residuals.median.items():
        ax.plot(residuals.t, CM * values, lw=1.8, label=pair)
    ax.set(xlabel="time in the air [s]", ylabel="residual [cm]", ylim=(-limit, limit))
    ax.grid(alpha=0.3)


def _path(ax: Axes, result: LoopResult) -> None:
    truth = result.flight.truth
    assert truth is not None
    first, last = result.scores[0].first, result.scores[0].last
    flown = (truth.t >= first) & (truth.t <= last)
    ax.plot(*truth.p[flown, :2].T, "k", lw=2.5, label="true")
    for score, colour in zip(result.scores, COLOURS):
        estimate = position_at(score.t, truth) + score.error
        ax.plot(*estimate[:, :2].T, color=colour, lw=1.2, label=score.name)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="Path from above")
    ax.legend(loc="best")
    ax.grid(alpha=0.3)


def _error(ax: Axes, result: LoopResult) -> None:
    for score, colour in zip(result.scores, COLOURS):
        size = CM * np.linalg.norm(score.error, axis=1)
        ax.plot(score.t - score.first, size, color=colour, lw=1.5, label=score.name)
    highest = CM * max(np.linalg.norm(score.error, axis=1).max() for score in result.scores)
    ax.set(xlabel="time in the air [s]", ylabel="3D position error [cm]")
    ax.set_ylim(0.0, ROOM * highest)
    ax.set_title(f"Position: {listed([f'{CM * error:.1f}' for error in result.errors])} cm off")
    ax.legend(loc="upper right", ncols=2)
    ax.grid(alpha=0.3)
