"""A flight through both nodes over topics, beside the same filter without ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight
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

SIMULATED = trial.Task(HALL, seed=1, yaw="unknown")  # place and yaw are not given, as to the nodes


@dataclass(frozen=True)
class DemoFlight:
    """What is flown. flight : Flight; effects_file, model : what corrects it, or None;
    became : what became of a flight that was simulated, in words.
    """

    flight: Flight
    effects_file: str | Path | None
    model: str | None
    outcome: str = ""

    def corrector(self) -> Corrector | None:
        """Corrector of the flight, or None if nothing corrects it. Raises InputError."""
        if not (self.effects_file or self.model):
            return None
        effects = EffectSet.from_yaml(self.effects_file) if self.effects_file else EffectSet()
        return Corrector(self.flight.anchors, effects, load_network(self.model))

    def correction(self) -> str:
        """What corrects the flight, from where and why, in words."""
        corrector = self.corrector()
        if corrector is None:
            return (
                "nothing: neither --effects nor --model is given, and what other flights needed "
                "may harm this one"
            )
        sources = [str(path) for path in (self.effects_file, self.model) if path]
        return f"{corrector.model} ({', '.join(sources)})"


def simulated(
    folder: str | Path, effects_file: str | Path | None = None, model: str | None = None
) -> DemoFlight:
    """DemoFlight by nothing but its estimate, among anchors that are late; corrected, if nothing
    else is given, with their true delays as a calibration would find them: an effects.yaml in the
    folder. Raises InputError.
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
    """DemoFlight of a recording, read by a Reading, corrected with what is given and nothing else.
    Raises InputError.
    """
    flight = reading.one(path)
    if flight.truth is None:
        raise InputError(
            f"{path}: holds no ground truth to compare with; take a flight that has it."
        )
    return DemoFlight(flight, effects_file, model)


@dataclass(frozen=True)
class DemoResult:
    """became : {what became of the messages: count}, see `accounts`; scores : [Score], of the
    filter without correction, of the nodes, and of the filter with correction; or, if nothing
    corrects, of the nodes and of the filter; nodes : RecordedOdometry;
    without_ros : Run of the filter with what the nodes correct with; raw : Odometry of the filter
        without correction, or None if nothing
    corrects.
    """

    outcome: dict[str, int]
    scores: list[Score]
    nodes: RecordedOdometry
    without_ros: Run
    raw: Odometry | None

    def show(self, path: Path, flight: Flight, sentences: Sequence[str]) -> None:
        """Write a file for Rerun: what the nodes said, and sentences."""
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
    """Write the flight of a DemoFlight as a bag, play it to both nodes, and run the filter without
    ROS beside them: DemoResult.

    The bags and the output of the nodes go to the folder. Raises InputError, LiveError. say(text) :
    called with what happens.
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
    """[command line] to copy after the demo: check a recording, localize it, calibrate the tag by
    it.
    """
    words = [recording, *(("--survey", survey) if survey else ())]
    lines = [("check",), ("localize", "--out", "localized/"), ("calibrate", "--out", "calibrated/")]
    return [command_lines.tool(name, *words, *more) for name, *more in lines]


def _absolute(path: str | Path | None) -> str:
    """For a node, which runs elsewhere; "" for none."""
    return str(Path(path).resolve()) if path else ""
