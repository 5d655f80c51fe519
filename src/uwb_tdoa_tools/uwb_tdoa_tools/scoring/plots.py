"""Pictures. Importing this chooses a drawing backend that needs no screen."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from uwb_tdoa_bias.foundation.files import write_filled  # noqa: E402

from .metrics import position_at  # noqa: E402
from .phases import TITLES  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from uwb_tdoa_bias.foundation.flight import Flight, Truth

    from .metrics import Estimate, Score

SHADES = {  # of phases that follow one another
    "at_rest_earlier": "0.9",
    "at_rest_before": "tab:gray",
    "first_3_s": "tab:green",
    "last_3_s": "tab:orange",
    "at_rest_after": "tab:gray",
}


def plot_error(score: Score, odometry: Estimate, truth: Truth, path: str | Path) -> None:
    """Error per axis with its 3-sigma band over all of the recording, its phases shaded, and the
    path from above and from the side, to an image file.
    """
    figure, axes = plt.subplots(3, 2, figsize=(13, 8), width_ratios=(3, 2), layout="constrained")
    series, found = score.series, score.phases()
    std = np.sqrt(np.einsum("nii->ni", series.covariance))
    since = series.t - truth.t[0]
    for k, axis in enumerate("xyz"):
        ax = axes[k, 0]
        for name in (name for name in SHADES if name in found):
            begin = found[name]["begin"] - truth.t[0]
            ax.axvspan(
                begin,
                begin + found[name]["duration"],
                color=SHADES[name],
                alpha=0.2,
                lw=0,
                label=TITLES[name] if not k else None,
            )
        ax.fill_between(
            since,
            -3 * std[:, k],
            3 * std[:, k],
            color="tab:red",
            alpha=0.2,
            lw=0,
            label=None if k else "3 sigma",
        )
        ax.plot(since, series.error[:, k], lw=0.8, label=None if k else "error")
        sizes = np.abs(series.error[np.isfinite(series.error[:, k]), k])
        limit = max(0.5, 1.2 * sizes.max(initial=0.0))
        ax.set(ylabel=f"{axis} [m]", ylim=(-limit, limit))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(loc="upper center", ncols=4, fontsize="small")
    axes[2, 0].set_xlabel("time of the recording [s]")
    known = (odometry.t >= truth.t[0]) & (odometry.t <= truth.t[-1])
    for ax, (i, k) in zip(axes[:, 1], ((0, 1), (0, 2), (1, 2))):
        ax.plot(truth.p[:, i], truth.p[:, k], "k", lw=1.2, label="truth")
        ax.plot(odometry.p[known, i], odometry.p[known, k], lw=0.8, label="estimate")
        ax.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[k]} [m]", aspect="equal")
        ax.grid(alpha=0.3)
    axes[0, 1].legend(loc="upper right")
    row = score.row()
    where = TITLES[score.part].removesuffix(" recording")
    figure.suptitle(
        f"{row['flight']}: 3D RMSE {row['rmse_3d']:.3f} m {where}, "
        f"{found['whole']['rmse_3d']:.3f} m of all"
    )
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)


def plot_comparison(flight: Flight, scores: Sequence[Score], path: str | Path) -> None:
    """3D error of several Scores of one Flight over time, and the paths they tell from above; to an
    image file.
    """
    assert flight.truth is not None
    figure, (over_time, above) = plt.subplots(
        1, 2, figsize=(13, 5), width_ratios=(3, 2), layout="constrained"
    )
    flown = (flight.truth.t >= scores[0].first) & (flight.truth.t <= scores[0].last)
    above.plot(*flight.truth.p[flown, :2].T, "k", lw=1.2, label="ground truth")
    for score in scores:
        name = f"{score.name}: RMSE {score.row()['rmse_3d']:.3f} m"
        over_time.plot(
            score.t - score.first, np.linalg.norm(score.error, axis=1), lw=0.8, label=name
        )
        above.plot(
            *(position_at(score.t, flight.truth) + score.error)[:, :2].T, lw=0.8, label=score.name
        )
    over_time.set(xlabel="time in the air [s]", ylabel="3D position error [m]", ylim=(0, None))
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    for axes in (over_time, above):
        axes.grid(alpha=0.3)
        axes.legend()
    figure.suptitle(flight.name)
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
