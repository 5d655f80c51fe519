# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly many tasks on all cores, keep their verdicts, and draw them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.files import write_filled

from ..bags.bag import write_bag
from ..scoring.metrics import position_at
from .rover import drive
from .trial import Task, TrialResult, fly
from .verdict import reached, sampled, verdict_of, wording_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.anchors import Anchors


SPACING = 0.05  # s


@dataclass(frozen=True)
class DrawnFlight:
    """Hold the figures of a flight that are drawn.

    Parameters
    ----------
    t, p : numpy.ndarray
        Stamps (n,), s, and true positions (n, 3), m.
    wanted : numpy.ndarray
        Wanted positions (n, 3), m, or NaN.
    stamps, error, sigma : numpy.ndarray
        Stamps (k,), s, errors and standard deviations (k, 3), m, of the estimate.
    verdict : dict
        See `verdict_of`.
    """

    t: np.ndarray
    p: np.ndarray
    wanted: np.ndarray
    stamps: np.ndarray
    error: np.ndarray
    sigma: np.ndarray
    verdict: dict[str, Any]


def drawn_flight(result: TrialResult, verdict: dict[str, Any]) -> DrawnFlight:
    """Return the figures of a TrialResult to draw."""
    assert result.flight.truth is not None
    truth, odometry = result.flight.truth, sampled(result.odometry, SPACING)
    every = max(1, round(SPACING / (truth.t[1] - truth.t[0])))
    t, p = truth.t[::every], truth.p[::every]
    wanted = np.full(p.shape, np.nan)
    for mission in (mission for mission in result.missions if mission.started is not None):
        inside = (t >= mission.started) & (t <= (mission.ended or np.inf))
        wanted[inside] = mission.wanted(t[inside])[:, 0]
    error = odometry.p - position_at(odometry.t, truth)
    sigma = np.sqrt(np.einsum("nii->ni", odometry.covariance[:, :3, :3]))
    return DrawnFlight(t, p, wanted, odometry.t, error, sigma, verdict)


def plot(flights: Sequence[DrawnFlight], anchors: Anchors, path: str | Path) -> None:
    """Draw a map, all heights, and the errors of the worst flight to an image file.

    Parameters
    ----------
    flights : sequence of DrawnFlight
    anchors : Anchors
    path : str or Path
    """
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(14, 8), layout="constrained")
    left, right = figure.subfigures(1, 2)
    goal = wording_of(flights[0].verdict).goal
    figure.suptitle(f"{sum(reached(one.verdict) for one in flights)} of {len(flights)} {goal}")
    above, height = left.subplots(2, 1, height_ratios=(3, 1))
    above.plot(*anchors.positions[:, :2].T, "k^")
    for one in flights:
        colour = "tab:green" if reached(one.verdict) else "tab:red"
        above.plot(*one.p[:, :2].T, color=colour, linewidth=0.7, alpha=0.6)
        above.plot(*one.p[-1, :2], "x", color=colour)
        height.plot(one.t, one.p[:, 2], color=colour, linewidth=0.7, alpha=0.6)
    above.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    height.set(xlabel="t, s", ylabel="z, m")
    worst = max(flights, key=_error_key)
    right.suptitle(f"seed {worst.verdict['seed']}: {worst.verdict['why'] or goal}")
    for k, (axes, axis) in enumerate(zip(right.subplots(3, 1, sharex=True), "xyz")):
        axes.plot(worst.t, worst.wanted[:, k] - worst.p[:, k], "0.6", label="wanted - true")
        axes.plot(worst.stamps, worst.error[:, k], label="estimated - true")
        axes.fill_between(
            worst.stamps,
            -3 * worst.sigma[:, k],
            3 * worst.sigma[:, k],
            alpha=0.2,
            label="three sigma",
        )
        axes.set(ylabel=f"{axis}, m")
    axes.set(xlabel="t, s")
    axes.legend()
    write_filled(path, partial(figure.savefig, dpi=120))


def _error_key(one: DrawnFlight) -> tuple[bool, float]:
    return not reached(one.verdict), one.verdict["tracking"] or 0.0


def fly_task(
    record: str | Path | None, draw: bool, task: Task
) -> tuple[dict[str, Any], DrawnFlight | None]:
    """Fly a Task and return (verdict, DrawnFlight or None).

    record : str or Path, optional
        Folder for a bag of the flight.
    draw : bool
        Whether to return figures to draw.
    """
    one = drive(task) if task.vehicle == "rover" else fly(task)
    verdict = verdict_of(one)
    if record is not None:
        write_bag(one.flight, Path(record) / one.flight.name, "mcap", False)
    return verdict, drawn_flight(one, verdict) if draw else None
