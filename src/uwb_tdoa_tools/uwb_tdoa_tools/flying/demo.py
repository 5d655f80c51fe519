# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run flights through both nodes over topics, with and without a correction.

`close_loop` does so in a simulated hall with one effect that a seed draws. `record` puts it into the
recordings. Everything after that reads the recordings only: no file, no argument and no stream
declares the effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
import os
from pathlib import Path
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.files import write_picture
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.base import listed, rounded
from uwb_tdoa_ekf.offline import run_offline

from .. import command_lines
from ..bags.bag import RecordedOdometry, read_odometry, write_bag
from ..cli import Progress, as_json
from ..diagnosis import diagnose
from ..diagnosis.report.entries import entries, worth_in_words
from ..diagnosis.result import Diagnosis
from ..readers.inputs import Reading
from ..scoring.metrics import Estimate, Score, change_in_words, position_at
from ..scoring.pairs import CM, PairResiduals, residuals_of
from ..simulation import SimulationConfig, simulate
from ..simulation.inject import hidden_effect

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..exporting.tracing import TracedCorrection


# Effects of `simulate` are off: what the residuals show is the drawn effect, noise and outliers.
HALL = SimulationConfig(
    duration=40.0, speed=1.2, imu_rate=200.0, truth_rate=100.0, bias=False, multipath=False
)
YAWS = ("along_track", "rotating", "along_track")  # of the flights
COLOURS = ("tab:red", "tab:blue")  # of a flight without and with the correction
SIZE = 14  # points: legible if the picture is shrunk to 700 pixels
SET_UP = sum(os.times()[2:4])  # s of processor time that `./dev` spent before, in the same process
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
    bags = [folder / f"flight-{number}_bag" for number in range(1, len(YAWS) + 1)]
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
    seconds = sum(round(flight.duration) for flight in flights)
    count = sum(len(flight.tdoa) for flight in flights)
    return (
        f"{listed(flight.name for flight in flights)} in hall {seed}: {seconds} s, {count} TDOAs of "
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
        write_picture(path, figure, 100)


def _path(ax: Axes, flight: Flight, scores: Sequence[Score]) -> None:
    truth = flight.known_truth
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
    ax.set(
        xlabel="time in the air [s]",
        ylabel="3D position error [cm]",
        ylim=(0.0, ROOM * highest),
        title=f"Position: {listed(sizes)} cm off",
    )
    ax.legend(loc="upper right", ncols=2)
    ax.grid(alpha=0.3)


CORRECTION = "bias.onnx"  # file of the correction of a simulated hall
# outcomes of messages that change the result
MISSING = "lost", "late", "early", "imu_late", "imu_lost", "sensors_late", "odometry_lost"
SLOW = 0.5  # times as fast as flown: the rate that is suggested first


def corrector_of(
    flight: Flight, effects: str | Path | None, model: str | Path | None
) -> Corrector | None:
    """Return the Corrector of a Flight by two files, or None if neither is given.

    Raises
    ------
    InputError
        If a file cannot be used.
    """
    known = EffectSet.from_yaml(effects) if effects else EffectSet()
    return Corrector(flight.anchors, known, load_network(model)) if effects or model else None


def correction_in_words(corrector: Corrector | None, *files: str | Path | None) -> str:
    """Return what corrects a flight, and by which files."""
    if corrector is None:
        return (
            "nothing: neither --effects nor --model is given, and corrections of other flights "
            "may harm this one"
        )
    return f"{corrector.model_name} ({', '.join(str(file) for file in files if file)})"


@dataclass(frozen=True)
class LivePass:
    """Hold what both nodes made of a flight.

    Parameters
    ----------
    outcome : dict
        Number of messages by outcome, see `accounts`.
    odometry : RecordedOdometry
    """

    outcome: dict[str, int]
    odometry: RecordedOdometry

    @property
    def missing(self) -> int:
        """Return how many messages were lost or late."""
        return sum(self.outcome[name] for name in MISSING)


def through_nodes(
    flight: Flight,
    bag: Path,
    folder: Path,
    rate: float,
    files: Mapping[str, str | Path | None],
    say: Callable[[str], object],
) -> LivePass:
    """Play the bag of a flight to both nodes.

    Parameters
    ----------
    flight : Flight
    bag : Path
    folder : Path
        For the output of the nodes.
    rate : float
        Speed of the replay.
    files : dict
        {parameter of bias_node: file or None}.
    say : callable
        Called with lines of progress.

    Returns
    -------
    LivePass

    Raises
    ------
    InputError, LiveError
        If the flight cannot be played.
    """
    from ..live.session import accounts, run_live

    folder.mkdir(parents=True, exist_ok=True)
    # a node runs in another directory
    bias = {name: str(Path(file).resolve()) for name, file in files.items() if file}
    live = run_live(bag, folder, rate, bias, {"use_imu": flight.imu is not None}, say)
    odometry = read_odometry(live.recorded)
    return LivePass(accounts(live.bias, live.ekf, flight, len(odometry.t)), odometry)


def fly(
    flight: Flight,
    correction: Corrector | None,
    files: Mapping[str, str | Path | None],
    folder: Path,
    rate: float,
    say: Callable[[str], object] = print,
) -> tuple[LivePass, list[Score]]:
    """Play a flight to both nodes, and run the filter without ROS.

    Parameters
    ----------
    flight : Flight
        With ground truth.
    correction : Corrector or None
    files : dict
        {parameter of bias_node: file or None} of the same correction.
    folder : Path
        For the bag and the output of the nodes.
    rate : float
        Speed of the replay.
    say : callable
        Called with lines of progress.

    Returns
    -------
    LivePass
    list of Score
        With a correction: filter without it, nodes, filter with it. Without: nodes and filter.
        Empty if messages were lost or late: such an error is that of the machine.

    Raises
    ------
    InputError, LiveError
        If the flight cannot be played.
    """
    bag = folder / "flight_bag"
    write_bag(flight, bag, force=True)
    live = through_nodes(flight, bag, folder, rate, files, say)
    if live.missing:
        return live, []
    raw = run_offline(flight).odometry
    estimates: dict[str, Estimate] = {"nodes": live.odometry, "without ROS": raw}
    if correction is not None:
        estimates = {
            "raw": raw,
            "corrected": live.odometry,
            "corrected, without ROS": run_offline(flight, corrector=correction).odometry,
        }
    scores = [Score(name, one, flight.known_truth) for name, one in estimates.items()]
    return live, scores


def processor_time() -> float:
    """Return the processor time of this process and of those that it ran, s."""
    return sum(os.times()[:4]) - SET_UP


def times_in_words(laps: Mapping[str, float]) -> str:
    """Return the time of all parts and of each, s, and the processor time of all processes."""
    parts = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in laps.items())
    return f"{sum(laps.values()):.0f} s: {parts}; {processor_time():.0f} s of processor time"


@dataclass(frozen=True)
class LoopResult:
    """Hold the third flight of a closed loop.

    Parameters
    ----------
    flight : Flight
    passes : list of LivePass
        Without the model, and with it. Only the first if there is no model, or if it lost messages.
    scores : list of Score
        Of each pass without lost or late messages.
    residuals : list of PairResiduals
        Of the TDOAs of these passes.
    """

    flight: Flight
    passes: list[LivePass]
    scores: list[Score]
    residuals: list[PairResiduals]

    @property
    def missing(self) -> int:
        """Return how many messages were lost or late."""
        return sum(one.missing for one in self.passes)

    @property
    def failed(self) -> bool:
        """Return whether the last pass diverged, or messages were lost or late."""
        return bool(self.missing or self.scores[-1].row()["diverged"])

    def arrived_in_words(self) -> str:
        """Return how many messages went through both nodes, and how many did not."""
        times = "without bias.onnx, then with it" if len(self.passes) > 1 else "without a model"
        lost = f"{self.missing} messages" if self.missing else "no message"
        return (
            f"{self.flight.name} through both nodes, {times}: {len(self.flight.tdoa)} TDOAs, "
            f"{lost} lost or late"
        )

    def error_in_words(self) -> str:
        """Return the position error of each pass."""
        before, *more = (CM * score.rmse_3d for score in self.scores)
        if not more:
            return f"3D RMSE {before:.1f} cm: nothing is corrected"
        (after,) = more
        return (
            f"3D RMSE {before:.1f} cm without bias.onnx, {after:.1f} cm with it: it "
            f"{change_in_words(before, after)}"
        )

    def figures(self, seed: int, diagnosis: Diagnosis, laps: Mapping[str, float]) -> dict[str, Any]:
        """Return all figures for JSON; those of the third flight are None if it lost messages."""
        residuals, errors = (
            (None, None)
            if self.missing
            else ([one.size for one in self.residuals], [score.row() for score in self.scores])
        )
        return as_json(
            {
                "seed": seed,
                "residual_rms": residuals,
                "found": found_in_words(diagnosis),
                "errors": errors,
                "outcomes": [one.outcome for one in self.passes],
                "really": truth_in_words(seed, self.flight),
                "seconds": laps,
                "processor_time": processor_time(),
            }
        )


def fly_both(
    bag: Path, model: Path | None, rate: float, say: Callable[[str], object]
) -> LoopResult:
    """Play a recording to both nodes without a model file, then with it.

    Parameters
    ----------
    bag : Path
        The output of the nodes goes beside it.
    model : Path or None
    rate : float
        Speed of the replay.
    say : callable
        Called with lines of progress.

    Returns
    -------
    LoopResult

    Raises
    ------
    InputError, LiveError
        If the flight cannot be played.
    """
    (flight,) = read([bag])
    models = {"without": None, "with": model} if model else {"without": None}
    passes, scores, residuals = [], [], []
    for name, file in models.items():
        title = f"{name} {CORRECTION}"
        files = {"model_file": file}
        live = through_nodes(
            flight,
            bag,
            bag.parent / name,
            rate,
            files,
            lambda text: say(f"{title}: {text}"),
        )
        passes.append(live)
        if live.missing:
            break
        scores.append(Score(title, live.odometry, flight.known_truth))
        residuals.append(residuals_of(flight, corrector_of(flight, None, file)))
    return LoopResult(flight, passes, scores, residuals)


def close_loop(
    seed: int,
    folder: Path,
    rate: float,
    show: Callable[[str, Sequence[str]], object],
    say: Callable[[str], object],
) -> tuple[LoopResult, dict[str, Any]]:
    """Trace the hidden effect of a simulated hall, and fly with its correction.

    Parameters
    ----------
    seed : int
        Of the hall.
    folder : Path
        For all files.
    rate : float
        Speed of the replay.
    show : callable
        Called with a title and sentences, for each result.
    say : callable
        Called with lines of progress.

    Returns
    -------
    LoopResult
    dict
        All figures, for JSON.

    Raises
    ------
    InputError, LiveError
        If the third flight cannot be played.
    """
    laps: dict[str, float] = {}
    ends = [time.monotonic()]

    def lap(name: str) -> None:
        ends.append(time.monotonic())
        laps[name] = ends[-1] - ends[-2]

    onnx, picture = folder / CORRECTION, folder / "demo.png"
    with Progress("demo", what="flying") as progress:
        bags = record(seed, folder)
        flights = read(bags[:2])
        show("recorded", [recordings_in_words(flights, seed)])
        show("residual", residuals_of(flights[0]).sentences())
        lap("flying")
        progress("tracing residuals to effects")
        diagnosis = diagnose(flights, progress=progress)
        show("traced to", found_in_words(diagnosis) or ["nothing that helps"])
        lap("tracing")
        correction = write_correction(onnx, diagnosis)
        show("added", added_in_words(onnx, correction, diagnosis))
    result = fly_both(bags[2], onnx if correction else None, rate, say)
    lap("both nodes, twice" if correction else "both nodes")
    show("flown", [result.arrived_in_words()])
    if result.missing:
        show("error", [too_slow_in_words(result.missing, rate)])
    else:
        show("error", [result.error_in_words()])
        draw(picture, result.flight, result.residuals, result.scores)
        show("picture", [str(picture)])
    lap("picture")
    show("really", [truth_in_words(seed, result.flight)])
    show("took", [times_in_words(laps)])
    return result, result.figures(seed, diagnosis, laps)


def too_slow_in_words(missing: int, rate: float) -> str:
    """Return why a flight has no error: lost or late messages, and what to do."""
    return (
        f"none: the machine is too slow: {missing} messages were lost or late; try --rate "
        f"{min(SLOW, rate / 2.0):g}"
    )


def change_of_scores(scores: Sequence[Score]) -> str:
    """Return how a correction changes the error of a measured flight, from the scores of `fly`."""
    before, after = (score.row()["rmse_3d"] for score in scores[:2])
    if len(scores) == 2:
        return (
            f"3D RMSE {before:.3f} m, with nothing corrected: diagnose finds what is wrong with "
            "this flight, and what that is worth on others"
        )
    change = (
        f"3D RMSE raw {before:.3f} m, corrected {after:.3f} m: "
        f"{round(100.0 * (after - before) / before):+d} %"
    )
    worse = (
        "; this correction does not fit this flight: other anchors, another day, another IMU. Do "
        "not fly with it; diagnose finds one that fits"
    )
    return change + (worse if after > before else "")


def arrivals_in_words(flight: Flight, outcome: dict[str, int]) -> list[str]:
    """Return what became of all messages of a flight.

    Parameters
    ----------
    flight : Flight
    outcome : dict
        As of `accounts`.

    Returns
    -------
    list of str
    """
    counts = ", ".join(f"{count} {name}" for name, count in outcome.items() if "_" not in name)
    samples = 0 if flight.imu is None else len(flight.imu)
    return [
        f"TDOAs {len(flight.tdoa)}: {counts}",
        f"IMU samples {samples}: {outcome['imu_late']} late, {outcome['imu_lost']} lost",
        f"other sensors: {outcome['sensors_late']} late; odometry: {outcome['odometry_lost']} lost",
    ]


def next_steps(recording: str | Path, survey: str | Path | None = None) -> list[str]:
    """Return commands to copy after the demo: check, localize and calibrate."""
    words = [recording, *(("--survey", survey) if survey else ())]
    lines = [("check",), ("localize", "--out", "localized/"), ("calibrate", "--out", "calibrated/")]
    return [command_lines.tool(name, *words, *more) for name, *more in lines]
