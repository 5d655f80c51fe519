"""The learning curve of a training."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from uwb_tdoa_bias.foundation.files import write_filled

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def plot_curve(
    label: str,
    x: Sequence[float],
    training: Sequence[float],
    validation: Sequence[float],
    path: Path,
) -> None:
    """Learning curve: RMS errors of training and validation flights, m, over epochs or number of
    flights.
    """
    from ..scoring.plots import plt  # takes a second to import

    figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, errors in (("training", training), ("validation", validation)):
        ax.plot(x, errors, "o-", ms=3, label=name)
    ax.set(xlabel=label, ylabel="error of the TDOAs, RMS [m]")
    ax.grid(alpha=0.3)
    ax.legend()
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
