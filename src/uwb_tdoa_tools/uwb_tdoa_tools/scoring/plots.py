"""Pictures. Importing this chooses a drawing backend that needs no screen."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from .metrics import position_at  # noqa: E402


def plot_error(score, odometry, truth, path, title=None):
    """Error per axis with its 3-sigma band over time, and the path from above and from the side, to an image file."""
    figure, axes = plt.subplots(3, 2, figsize=(13, 8), width_ratios=(3, 2), layout="constrained")
    std = np.sqrt(np.einsum("nii->ni", score.covariance))
    since = score.t - score.first
    for k, axis in enumerate("xyz"):
        ax = axes[k, 0]
        ax.fill_between(since, -3 * std[:, k], 3 * std[:, k], color="tab:red", alpha=0.2, lw=0, label="3 sigma")
        ax.plot(since, score.error[:, k], lw=0.8, label="error")
        limit = max(0.5, 1.2 * np.abs(score.error[:, k]).max(initial=0.0))
        ax.set(ylabel=f"{axis} [m]", ylim=(-limit, limit))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(loc="upper right")
    axes[2, 0].set_xlabel("time in the air [s]")
    flown = (odometry.t >= score.first) & (odometry.t <= score.last)
    real = (truth.t >= score.first) & (truth.t <= score.last)
    for ax, (i, k) in zip(axes[:, 1], ((0, 1), (0, 2), (1, 2))):
        ax.plot(truth.p[real, i], truth.p[real, k], "k", lw=1.2, label="truth")
        ax.plot(odometry.p[flown, i], odometry.p[flown, k], lw=0.8, label="estimate")
        ax.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[k]} [m]", aspect="equal")
        ax.grid(alpha=0.3)
    axes[0, 1].legend(loc="upper right")
    row = score.row()
    figure.suptitle(title or f"{row['flight']}: 3D RMSE {row['rmse_3d']:.3f} m")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def plot_comparison(flight, scores, path):
    """3D error of several Scores of one Flight over time, and the paths they tell from above; to an image file."""
    figure, (over_time, above) = plt.subplots(1, 2, figsize=(13, 5), width_ratios=(3, 2), layout="constrained")
    flown = (flight.truth.t >= scores[0].first) & (flight.truth.t <= scores[0].last)
    above.plot(*flight.truth.p[flown, :2].T, "k", lw=1.2, label="ground truth")
    for score in scores:
        name = f"{score.name}: RMSE {score.row()['rmse_3d']:.3f} m"
        over_time.plot(score.t - score.first, np.linalg.norm(score.error, axis=1), lw=0.8, label=name)
        above.plot(*(position_at(score.t, flight.truth) + score.error)[:, :2].T, lw=0.8, label=score.name)
    over_time.set(xlabel="time in the air [s]", ylabel="3D position error [m]", ylim=(0, None))
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    for axes in (over_time, above):
        axes.grid(alpha=0.3)
        axes.legend()
    figure.suptitle(flight.name)
    figure.savefig(path, dpi=110)
    plt.close(figure)
