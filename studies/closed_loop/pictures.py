# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counterparts of figures 7 to 9 of Zhao et al. (RA-L 2021)."""

from functools import partial
from pathlib import Path

from matplotlib.figure import Figure
import matplotlib.pyplot as plt
import numpy as np

from uwb_tdoa_bias.common.files import write_filled

COLOURS = "0.55", "tab:red", "tab:cyan", "tab:olive", "tab:green"
LONG = 35.0  # s of a flight that are drawn at most


def draw_errors_by_kind(verdicts: dict[tuple[str, str, str], list[dict]], path: Path) -> None:
    """Figure 7: RMSE of the estimate in the air of each flight, and their mean as a bar. verdicts :
    {(estimator, constellation, trajectory): [verdict]}.
    """
    by = list(dict.fromkeys(kind[0] for kind in verdicts))
    groups = list(dict.fromkeys(kind[1:] for kind in verdicts))
    figure, axes = plt.subplots(figsize=(12, 4), layout="constrained")
    for k, (name, colour) in enumerate(zip(by, COLOURS)):
        at = np.arange(len(groups)) + (k - 0.5 * (len(by) - 1)) * 0.8 / len(by)
        some = [
            [one["estimation"] for one in verdicts[(name, *group)] if one["took_off"]]
            for group in groups
        ]
        axes.bar(
            at,
            [np.mean(values) for values in some],
            0.75 / len(by),
            color=colour,
            alpha=0.6,
            label=name,
        )
        for x, values in zip(at, some):
            axes.plot(np.full(len(values), x), values, ".", color="k", ms=3)
    axes.set_xticks(range(len(groups)), [f"{where}\n{trajectory}" for where, trajectory in groups])
    axes.set_ylabel("RMSE of the estimate, m")
    axes.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=len(by), fontsize="small")
    _save(figure, path)


def draw_paths(shown: dict[str, list], path: Path) -> None:
    """Draw figure 8: flown and desired paths relative to their start, from above and from the side.

    shown : {estimator: [Drawn]}
    """
    figure, axes = plt.subplots(
        2,
        len(shown),
        figsize=(3.2 * len(shown), 5.4),
        sharex=True,
        sharey="row",
        layout="constrained",
        height_ratios=(3, 1),
    )
    for column, (name, flights), colour in zip(axes.T, shown.items(), COLOURS):
        for one in flights:
            start = np.array([*one.p[0, :2], 0.0])
            p, wanted = one.p - start, one.wanted - start
            for ax, k in zip(column, (1, 2)):
                ax.plot(p[:, 0], p[:, k], color=colour, lw=0.8, alpha=0.8)
                ax.plot(wanted[:, 0], wanted[:, k], "k--", lw=0.6)
        column[0].set(
            title=f"{name}\n{sum(one.verdict['landed'] for one in flights)} of {len(flights)} landed",
            aspect="equal",
            xlim=(-2.7, 0.7),
            ylim=(-1.7, 1.7),
        )
        column[1].set(xlabel="x, m", ylim=(0, 2))
        for ax in column:
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("y, m")
    axes[1, 0].set_ylabel("z, m")
    _save(figure, path)


def draw_errors(shown: dict[str, list], path: Path) -> None:
    """Figure 9: errors of the estimate of the first flight by each estimator, with three of its
    deviations. shown : {estimator: [Drawn]}.
    """
    figure, axes = plt.subplots(
        3,
        len(shown),
        figsize=(3.2 * len(shown), 5.4),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    for column, (name, flights) in zip(axes.T, shown.items()):
        one = flights[0]
        for k, ax in enumerate(column):
            ax.plot(one.stamps, one.error[:, k], lw=0.8)
            for sign in (-3.0, 3.0):
                ax.plot(one.stamps, sign * one.sigma[:, k], "r", lw=0.6)
            ax.grid(alpha=0.3)
            ax.set(ylim=(-0.8, 0.8), xlim=(0.0, LONG))
        column[0].set_title(name)
        column[2].set_xlabel("t, s")
    for ax, axis in zip(axes[:, 0], "xyz"):
        ax.set_ylabel(f"{axis}: estimated - true, m")
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
