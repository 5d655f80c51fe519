"""Run a flight through both nodes over topics, and compare with the same filter without ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_ekf.offline import Run, run_offline
from uwb_tdoa_ekf.results import Odometry

from .. import command_lines
from ..bags.bag import read_odometry, write_bag
from ..live.run import accounts, run_live
from ..localizing.pictures import write_rerun
from ..scoring.metrics import Score
from . import trial
from .sensors import Radio
from .verdict import sentence, verdict_of
from .world import HALL

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..bags.bag import RecordedOdometry
    from ..readers.inputs import Reading
    from ..scoring.metrics import Estimate

SIMULATED = trial.Task(HALL, seed=1, yaw="unknown")  # the nodes get no place and no yaw either


@dataclass(frozen=True)
class DemoFlight:
    """Describe the flight of a demo.

    Parameters
    ----------
    flight : Flight
    effects_file, model : str or None
        Corrections.
    outcome : str
        Verdict of a simulated flight as a sentence, or "".
    """

    flight: Flight
    effects_file: str | Path | None
    model: str | None
    outcome: str = ""

    def corrector(self) -> Corrector | None:
        """Return the Corrector of the flight, or None without corrections.

        Raises
        ------
        InputError
            If a file cannot be used.
        """
        if not (self.effects_file or self.model):
            return None
        effects = EffectSet.from_yaml(self.effects_file) if self.effects_file else EffectSet()
        return Corrector(self.flight.anchors, effects, load_network(self.model))

    def correction(self) -> str:
        """Return the corrections of the flight as text."""
        corrector = self.corrector()
        if corrector is None:
            return (
                "nothing: neither --effects nor --model is given, and corrections of other flights "
                "may harm this one"
            )
        sources = [str(path) for path in (self.effects_file, self.model) if path]
        return f"{corrector.model} ({', '.join(sources)})"


def simulated(
    folder: str | Path, effects_file: str | Path | None = None, model: str | None = None
) -> DemoFlight:
    """Fly among anchors with delays, by the estimate alone.

    Without `effects_file` and `model` the true delays are corrected. They are written to an effects.yaml
    in the folder, as a calibration writes them.

    Parameters
    ----------
    folder : str or Path
    effects_file : str or Path, optional
    model : str, optional

    Returns
    -------
    DemoFlight

    Raises
    ------
    InputError
        If a file cannot be used.
    """
    if not (effects_file or model):
        delays = Radio(SIMULATED.world, SIMULATED.seed, 1.0).constants[:, 0]
        values = dict(zip(SIMULATED.world.anchors.ids.tolist(), delays.round(4).tolist()))
        effects_file = Path(folder) / "effects.yaml"
        EffectSet((AnchorDelay(values, source="the simulation's own values"),)).to_yaml(
            effects_file
        )
    effects = EffectSet.from_yaml(effects_file) if effects_file else None
    flown = trial.fly(replace(SIMULATED, effects=effects))
    return DemoFlight(flown.flight, effects_file, model, sentence(verdict_of(flown)))


def measured(
    path: str | Path,
    reading: Reading,
    effects_file: str | Path | None = None,
    model: str | None = None,
) -> DemoFlight:
    """Read a recording with the given corrections.

    Parameters
    ----------
    path : str or Path
    reading : Reading
    effects_file : str or Path, optional
    model : str, optional

    Returns
    -------
    DemoFlight

    Raises
    ------
    InputError
        If the recording has no ground truth or a file cannot be used.
    """
    flight = reading.one(path)
    if flight.truth is None:
        raise InputError(
            f"{path}: holds no ground truth to compare with; take a flight that has it."
        )
    return DemoFlight(flight, effects_file, model)


@dataclass(frozen=True)
class DemoResult:
    """Hold the results of a demo.

    Parameters
    ----------
    outcome : dict
        Number of messages by outcome, see `accounts`.
    scores : list of Score
        With corrections: filter without correction, nodes, filter with correction. Without corrections:
        nodes and filter.
    nodes : RecordedOdometry
        Output of the nodes.
    without_ros : Run
        Filter with the corrections of the nodes.
    raw : Odometry or None
        Filter without correction, if there are corrections.
    """

    outcome: dict[str, int]
    scores: list[Score]
    nodes: RecordedOdometry
    without_ros: Run
    raw: Odometry | None

    def show(self, path: Path, flight: Flight, sentences: Sequence[str]) -> None:
        """Write a file for Rerun with the output of the nodes and sentences."""
        write_rerun(
            path,
            flight,
            self.nodes,
            self.without_ros.residuals,
            list(sentences),
            flight.truth,
            self.raw,
        )


def fly(
    planned: DemoFlight, folder: Path, rate: float = 1.0, say: Callable[[str], object] = print
) -> DemoResult:
    """Play a flight to both nodes, and run the filter without ROS.

    Parameters
    ----------
    planned : DemoFlight
    folder : Path
        For the bag and the output of the nodes.
    rate : float
        Speed of the replay.
    say : callable
        Called with lines of progress.

    Returns
    -------
    DemoResult

    Raises
    ------
    InputError, LiveError
        If the flight cannot be played.
    """
    flight, bag, correction = planned.flight, folder / "flight.bag", planned.corrector()
    assert flight.truth is not None
    write_bag(flight, bag, force=True)
    bias = {
        "effects_file": _absolute(planned.effects_file),
        "model_file": _absolute(planned.model),
    }
    ekf = {"use_imu": flight.imu is not None}
    live = run_live(bag, folder, rate, bias, ekf, say)
    nodes, raw = read_odometry(live.recorded), run_offline(flight)
    estimates: dict[str, Estimate] = {"nodes": nodes, "without ROS": raw.odometry}
    if correction:
        corrected = run_offline(flight, corrector=correction)
        estimates = {
            "raw": raw.odometry,
            "corrected": nodes,
            "corrected, without ROS": corrected.odometry,
        }
    scores = [Score(name, one, flight.truth) for name, one in estimates.items()]
    without_ros, before = (corrected, raw.odometry) if correction else (raw, None)
    return DemoResult(accounts(live.bias, live.ekf, flight), scores, nodes, without_ros, before)


def next_steps(recording: str | Path, survey: str | Path | None = None) -> list[str]:
    """Return commands to copy after the demo: check, localize and calibrate."""
    words = [recording, *(("--survey", survey) if survey else ())]
    lines = [("check",), ("localize", "--out", "localized/"), ("calibrate", "--out", "calibrated/")]
    return [command_lines.tool(name, *words, *more) for name, *more in lines]


def _absolute(path: str | Path | None) -> str:
    """Return an absolute path, or "" for None: a node runs in another directory."""
    return str(Path(path).resolve()) if path else ""
