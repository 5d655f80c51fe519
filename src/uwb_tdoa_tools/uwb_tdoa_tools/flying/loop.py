# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Close the loop in a simulated hall: record flights, trace their residuals, write the correction.

The hall has one effect that a seed draws. `record` puts it into the recordings. Everything after
that reads the recordings only: no file, no argument and no stream declares the effect.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.files import write_filled
from uwb_tdoa_bias.effects.base import listed, rounded

from ..bags.bag import write_bag
from ..diagnosis.report.entries import entries, worth_in_words
from ..readers.inputs import Reading
from ..scoring.metrics import Score, position_at
from ..simulation import SimulationConfig, simulate
from ..simulation.inject import hidden_effect

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from uwb_tdoa_bias.common.flight import Flight

    from ..diagnosis.result import Diagnosis
    from ..exporting.correction import TracedCorrection
    from ..scoring.pairs import PairResiduals

# Effects of `simulate` are off: what the residuals show is the drawn effect, noise and outliers.
HALL = SimulationConfig(
    duration=40.0, speed=1.2, imu_rate=200.0, truth_rate=100.0, bias=False, multipath=False
)
YAWS = ("along_track", "rotating", "along_track")  # of the flights
CM = 100.0  # cm per metre
COLOURS = ("tab:red", "tab:blue")  # of a flight without and with the correction
SIZE = 14  # points: legible if the picture is shrunk to 700 pixels
ROOM = 1.3  # of the largest error, the end of the axis: the legend covers no line


def flight_of(seed: int, number: int) -> Flight:
    """Simulate flight 1, 2 or 3 in the hall of a seed, with its hidden effect.

    The ground truth is that of the simulation. It stands in for a motion capture system.
    """
    config = replace(HALL, seed=len(YAWS) * seed + number, yaw=YAWS[number - 1])
    flown = replace(simulate(config), name=f"flight-{number}", extra={}, meta={})
    return hidden_effect(seed, flown.anchors).inject(flown)


def record(seed: int, folder: Path) -> list[Path]:
    """Fly three times in the hall of a seed, and return the bags."""
    bags = [folder / f"flight-{number}.bag" for number in range(1, len(YAWS) + 1)]
    for number, bag in enumerate(bags, start=1):
        write_bag(flight_of(seed, number), bag, force=True)
    return bags


def read(bags: Sequence[Path]) -> list[Flight]:
    """Read recordings."""
    return [Reading().one(bag) for bag in bags]


def write_correction(path: Path, diagnosis: Diagnosis) -> TracedCorrection | None:
    """Write the effects that a Diagnosis added as an ONNX file, and return what it holds.

    Return None, and write nothing, if no added effect acts on TDOAs. The diagnosis adds an effect
    only if it helps a flight that it was not fitted to.
    """
    from ..exporting.onnx_file import write_onnx  # onnx takes a second to import

    if not len(diagnosis.effects.where(lambda effect: "tdoa" in effect.channels)):
        return None
    return write_onnx(path, diagnosis.flights[0].anchors, diagnosis.effects)


def found_in_words(diagnosis: Diagnosis) -> list[str]:
    """Return what the residuals of TDOAs were traced to, with values and cause.

    Of several effects each has its worth; that of one is the whole gain.
    """
    found = [
        entry
        for entry in entries(diagnosis)
        if entry.added and "tdoa" in entry.findings[0].effect.channels
    ]
    worths = [f", worth {worth_in_words(entry)}" if len(found) > 1 else "" for entry in found]
    return [
        f"{entry.title}: {entry.values}{worth}: {entry.physics}"
        for entry, worth in zip(found, worths)
    ]


def recordings_in_words(flights: Sequence[Flight], seed: int) -> str:
    """Return what was recorded, and where its ground truth is from."""
    names = listed(flight.name for flight in flights)
    seconds = [round(flight.end - flight.start) for flight in flights]
    count = sum(len(flight.tdoa) for flight in flights)
    return (
        f"{names} in hall {seed}: {sum(seconds)} s, {count} TDOAs of "
        f"{len(flights[0].anchors)} anchors. The simulation gives their true path"
    )


def added_in_words(
    path: Path, correction: TracedCorrection | None, diagnosis: Diagnosis
) -> list[str]:
    """Return what was written, how it was validated, and what could not be written."""
    if correction is None:
        return ["nothing: no effect makes the error of a flight smaller that it was not fitted to"]
    before, after = (CM * side["pooled"]["rmse_3d"] for side in (diagnosis.before, diagnosis.after))
    return [
        f"{path}. Judged on each flight with values from the other, the position error falls from "
        f"{before:.1f} to {after:.1f} cm",
        *map(str, correction.left_out),
    ]


def truth_in_words(seed: int, flight: Flight) -> str:
    """Return the hidden effect of a hall with all its values."""
    effect = hidden_effect(seed, flight.anchors)
    values = ", ".join(f"{key} = {rounded(value)}" for key, value in effect.values.items())
    return f"{effect.label}: {values} ({effect.unit})"


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
        for ax, one, score in zip(axes[0], residuals, scores):
            one.draw(ax, residuals[0])
            ax.set_title(f"TDOAs {score.name}: {CM * one.size:.1f} cm off")
        ax.legend(title="pair of anchors", ncols=4, loc="lower center", handlelength=1.0)
        _path(axes[1, 0], flight, scores)
        _error(axes[1, 1], scores)
        write_filled(path, partial(figure.savefig, dpi=100))


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
