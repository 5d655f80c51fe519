"""Pictures. Importing this chooses a drawing backend that needs no screen."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402


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
