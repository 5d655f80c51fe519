# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""An estimate drawn: as a picture, and for the viewer Rerun (rerun.io)."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_filled
from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_ekf.results import Odometry, Residuals

from ..estimate import FlightEstimator
from ..scoring.metrics import position_at, within
from .residuals import by_pair

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import ModuleType

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ..bags.bag import RecordedOdometry
    from ..diagnosis.result import Diagnosis


ELLIPSES = 60  # along the path
SIGMAS = 3.0
MARGIN = 0.5  # m around anchors and path
RERUN_RATE = 20.0  # Hz, of poses that are written
BLUE, RED, GREY, BLACK, ORANGE = (
    (31, 119, 180),
    (214, 39, 40),
    (120, 120, 120),
    (40, 40, 40),
    (255, 127, 14),
)


def draw_estimate(
    path: Path,
    odometry: Odometry,
    anchors: Anchors,
    spans: Sequence[tuple[float, float]],
    title: str,
) -> None:
    """Write the `estimate_figure` of an Odometry to an image file."""
    figure = estimate_figure(odometry, anchors, spans, title)
    write_filled(path, partial(figure.savefig, dpi=110))


def estimate_figure(
    odometry: Odometry, anchors: Anchors, spans: Sequence[tuple[float, float]], title: str
) -> Figure:
    """Return a Figure of an Odometry among Anchors, from above, from the side, and over time.

    Parameters
    ----------
    spans : [(begin, end)] s, in which the tag was lost.
    title : one line.
    """
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    grid = figure.add_gridspec(3, 3, width_ratios=(1.4, 1.4, 1.0))
    lost = within(odometry.t, spans)
    for column, (u, v, name) in enumerate(((0, 1, "from above"), (0, 2, "from the side"))):
        _plane(figure.add_subplot(grid[:, column]), odometry, anchors, lost, (u, v, name))
    std = np.sqrt(np.einsum("nii->ni", odometry.covariance[:, :3, :3]))
    limit = 1.1 * SIGMAS * float(np.quantile(std, 0.98)) if len(std) else 1.0
    begin = odometry.t[0] if len(odometry) else 0.0
    for k, axis in enumerate("xyz"):
        ax = figure.add_subplot(grid[k, 2])
        since, value = odometry.t - begin, odometry.p[:, k]
        ax.fill_between(
            since,
            value - SIGMAS * std[:, k],
            value + SIGMAS * std[:, k],
            color="tab:blue",
            alpha=0.25,
            lw=0,
            label="3 sigma",
        )
        ax.plot(since, value, lw=0.9, color="tab:blue", label="estimate")
        for first, last in spans:
            ax.axvspan(first - begin, last - begin, color="tab:red", alpha=0.2, lw=0)
        inside = value[~lost] if (~lost).any() else value
        if len(inside):
            ax.set_ylim(inside.min() - max(limit, MARGIN), inside.max() + max(limit, MARGIN))
        ax.set_ylabel(f"{axis} [m]")
        ax.grid(alpha=0.25)
    ax.set_xlabel("time of the estimate [s]")
    figure.suptitle(title, fontsize=11)
    return figure


def _plane(
    ax: Axes, odometry: Odometry, anchors: Anchors, lost: np.ndarray, plane: tuple[int, int, str]
) -> None:
    """Draw path, ellipses and anchors in a plane: (two axes, name)."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.lines import Line2D

    from ..scoring.plots import labels

    u, v, name = plane
    known = odometry.p[~lost] if (~lost).any() else odometry.p
    if len(odometry):
        some = np.unique(np.linspace(0, len(odometry) - 1, ELLIPSES).astype(int))
        values, vectors = np.linalg.eigh(odometry.covariance[some][:, (u, v)][:, :, (u, v)])
        width, height = 2.0 * SIGMAS * np.sqrt(np.maximum(values, 0.0)).T
        turned = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
        ax.add_collection(
            EllipseCollection(
                width,
                height,
                turned,
                units="xy",
                offsets=odometry.p[some][:, (u, v)],
                transOffset=ax.transData,
                facecolor="tab:blue",
                edgecolor="none",
                alpha=0.12,
            )
        )
        path = np.where(lost[:, None], np.nan, odometry.p)
        ax.plot(path[:, u], path[:, v], lw=1.0, color="tab:blue")
        ax.plot(*np.where(lost[:, None], odometry.p, np.nan)[:, (u, v)].T, lw=1.0, color="tab:red")
        ax.plot(*odometry.p[0, [u, v]], "o", ms=6, mfc="white", color="tab:blue")
        ax.plot(*odometry.p[-1, [u, v]], "s", ms=5, color="tab:blue")
    ax.plot(anchors.positions[:, u], anchors.positions[:, v], "^", ms=8, color="0.2")
    for names, place in labels(anchors.ids.tolist(), anchors.positions[:, (u, v)]):
        ax.annotate(
            names, (place[0], place[1]), textcoords="offset points", xytext=(6, 5), fontsize=9
        )
    both = np.concatenate([anchors.positions, known])[:, (u, v)]
    lower, upper = both.min(axis=0) - MARGIN, both.max(axis=0) + MARGIN
    ax.set(
        xlim=(lower[0], upper[0]),
        ylim=(lower[1], upper[1]),
        aspect="equal",
        title=name,
        xlabel=f"{'xyz'[u]} [m]",
        ylabel=f"{'xyz'[v]} [m]",
    )
    ax.grid(alpha=0.25)
    if v == 1:
        marks = [
            Line2D([], [], color="tab:blue", label="estimate"),
            Line2D([], [], color="tab:blue", alpha=0.25, lw=6, label="3 sigma"),
            Line2D([], [], color="tab:red", label="lost"),
            Line2D([], [], color="tab:blue", marker="o", mfc="white", ls="", label="begin"),
            Line2D([], [], color="tab:blue", marker="s", ls="", label="end"),
            Line2D([], [], color="0.2", marker="^", ls="", label="anchor"),
        ]
        ax.legend(
            handles=marks, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=8
        )


def rerun_is_installed(say: Callable[[str], object]) -> bool:
    """Return whether the library is installed; if not, call say(sentence)."""
    if find_spec("rerun") is not None:
        return True
    say(
        "--rerun is left out: the viewer's library is not installed; pip install rerun-sdk "
        "(it needs numpy 2)."
    )
    return False


def write_rerun(
    path: Path,
    flight: Flight,
    odometry: Odometry | RecordedOdometry,
    residuals: Residuals | None,
    verdict: Sequence[str],
    truth: Truth | None = None,
    before: Odometry | RecordedOdometry | None = None,
) -> None:
    """Write a .rrd file for the viewer Rerun. Time is s since the first TDOA.

    Parameters
    ----------
    odometry : estimate among the anchors of the Flight.
    residuals : shown per pair, or None.
    verdict : sentences.
    truth : ground truth, if it is to be shown.
    before : estimate before a correction, or None.
    """
    import rerun

    begin = flight.start
    stream = rerun.RecordingStream("uwb_tdoa")
    stream.save(path)
    anchors = flight.anchors
    labels = [str(number) for number in anchors.ids.tolist()]
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(
        "world/anchors",
        rerun.Points3D(anchors.positions, labels=labels, radii=0.06, colors=BLACK),
        static=True,
    )
    stream.log(
        "world/path", rerun.LineStrips3D([odometry.p], colors=BLUE, radii=0.005), static=True
    )
    stream.log(
        "verdict", rerun.TextDocument("\n\n".join(verdict), media_type="text/markdown"), static=True
    )
    if truth is not None:
        stream.log(
            "world/truth", rerun.LineStrips3D([truth.p], colors=GREY, radii=0.005), static=True
        )
    _write_poses(rerun, stream, odometry, begin)
    std = np.sqrt(np.einsum("nii->ni", odometry.covariance[:, :3, :3]))
    for k, axis in enumerate("xyz"):
        _write_scalars(rerun, stream, f"deviation/{axis}", odometry.t - begin, std[:, k])
    for one in by_pair(residuals) if residuals is not None else ():
        _write_scalars(rerun, stream, f"residual/{one.a}-{one.b}", one.t - begin, one.value)
    if before is not None:
        stream.log(
            "world/before", rerun.LineStrips3D([before.p], colors=ORANGE, radii=0.005), static=True
        )
    if truth is not None:
        for name, estimate in (("error", odometry), ("error/before", before)):
            if estimate is not None:
                error = np.linalg.norm(estimate.p - position_at(estimate.t, truth), axis=1)
                _write_scalars(rerun, stream, name, estimate.t - begin, error)
    stream.flush()
    stream.disconnect()


def write_diagnosis(
    path: Path, result: Diagnosis, base: EffectSet, config: FilterConfig | None
) -> None:
    """Write the single flight of a Diagnosis: estimates with `base` and with the found effects."""
    from ..diagnosis.output import as_text  # takes a second to import

    (flight,) = result.flights
    before, after = (FlightEstimator(config, effects)(flight) for effects in (base, result.effects))
    truth = flight.truth if result.reference.tells_errors else None
    write_rerun(
        path,
        flight,
        after.odometry,
        after.residuals,
        as_text(result).splitlines(),
        truth,
        before.odometry,
    )


def _write_poses(
    rerun: ModuleType, stream: Any, odometry: Odometry | RecordedOdometry, begin: float
) -> None:
    """Write the tag and its ellipsoid of three standard deviations, at most RERUN_RATE times per second."""
    cells = np.floor((odometry.t - begin) * RERUN_RATE) if len(odometry.t) else np.zeros(0)
    rows = np.flatnonzero(np.diff(cells, prepend=-np.inf) > 0.0)
    values, vectors = np.linalg.eigh(odometry.covariance[rows, :3, :3])
    vectors *= np.sign(np.linalg.det(vectors))[:, None, None]  # right-handed
    turned = Rotation.from_matrix(vectors).as_quat() if len(rows) else np.zeros((0, 4))
    half = SIGMAS * np.sqrt(np.maximum(values, 0.0))
    for row, size, q in zip(rows.tolist(), half, turned):
        stream.set_time("time", duration=float(odometry.t[row] - begin))
        stream.log("world/tag", rerun.Points3D([odometry.p[row]], radii=0.04, colors=RED))
        stream.log(
            "world/tag/3_sigma",
            rerun.Ellipsoids3D(
                centers=[odometry.p[row]],
                half_sizes=[size],
                quaternions=[rerun.Quaternion(xyzw=q)],
                colors=RED,
            ),
        )
    stream.reset_time()


def _write_scalars(
    rerun: ModuleType, stream: Any, name: str, t: np.ndarray, values: np.ndarray
) -> None:
    """Write a curve over time, s."""
    known = np.isfinite(values)
    stream.send_columns(
        name,
        indexes=[rerun.TimeColumn("time", duration=t[known])],
        columns=rerun.Scalars.columns(scalars=values[known]),
    )
