# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of comparisons of bias models."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import norm

from uwb_tdoa_bias.common.files import write_filled

COLOURS = {
    "none": "0.6",
    "paper_no_orientation": "tab:red",
    "paper": "tab:cyan",
    "physics": "tab:orange",
    "structured": "tab:blue",
    "physics+structured": "tab:green",
}


def plot_histograms(errors: Mapping[str, np.ndarray], path: Path) -> None:
    """Errors of TDOAs before and after correction, one panel per model with its Gaussian fit:
    counterpart of figure 6 of Zhao et al. errors : {model: (n,) m}.
    """
    size = (6, 1.8 * len(errors))
    figure, axes = plt.subplots(
        len(errors), 1, figsize=size, sharex=True, layout="constrained", squeeze=False
    )
    bins = np.linspace(-0.8, 0.8, 81)
    before = next(iter(errors.values()))
    for ax, (name, values) in zip(axes[:, 0], errors.items()):
        ax.hist(before, bins, density=True, color="0.8")
        ax.hist(values, bins, density=True, color=COLOURS.get(name, "tab:purple"), alpha=0.7)
        mean, std = values.mean(), values.std()
        ax.plot(bins, norm.pdf(bins, mean, std), "k--", lw=1)
        ax.set_title(
            f"{name}: mean {100 * mean:.1f} cm, deviation {100 * std:.1f} cm", fontsize="small"
        )
    axes[-1, 0].set_xlabel("error of a TDOA [m]")
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)


def plot_bars(groups: Mapping[str, Mapping[str, float]], path: Path) -> None:
    """RMSE bars: counterpart of figure 7 of Zhao et al. groups : {group: {model: mean 3D RMSE, m}}."""
    figure, ax = plt.subplots(figsize=(1.5 + 2.2 * len(groups), 4), layout="constrained")
    names = list(next(iter(groups.values())))
    for k, name in enumerate(names):
        at = np.arange(len(groups)) + (k - 0.5 * (len(names) - 1)) * 0.8 / len(names)
        ax.bar(
            at,
            [means[name] for means in groups.values()],
            0.8 / len(names),
            label=name,
            color=COLOURS.get(name),
        )
    ax.set_xticks(range(len(groups)), list(groups))
    ax.set_ylabel("3D RMSE [m]")
    ax.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=3, fontsize="small")
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
