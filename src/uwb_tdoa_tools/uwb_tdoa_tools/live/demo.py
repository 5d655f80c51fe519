"""A flight through both nodes over topics, beside the same filter without ROS."""

from dataclasses import dataclass
from pathlib import Path
import shlex
import shutil

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.network import SHIPPED, load_network, unasked
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight
from uwb_tdoa_ekf.offline import run_offline

from ..bags.bag import read_odometry, write_bag
from ..scoring.metrics import Score, airborne
from ..simulation import SimulationConfig, simulate
from .run import accounts, run_live

SIMULATED = SimulationConfig(anchor_delay_std=0.1, duration=40.0, seed=1)


@dataclass(frozen=True)
class Case:
    """What is flown. flight : Flight; effects_file, model : what corrects it, or None; SHIPPED is a model."""

    flight: Flight
    effects_file: Path | None
    model: str | None

    def corrector(self):
        """Corrector of the flight. Raises InputError."""
        effects = EffectSet.from_yaml(self.effects_file) if self.effects_file else EffectSet()
        return Corrector(self.flight.anchors, effects, load_network(self.model))

    @property
    def sources(self):
        """Where the correction comes from: list of texts."""
        paths = [path for path in (self.effects_file, self.model) if path]
        return ["shipped with bias_node" if path == SHIPPED else str(path) for path in paths]


def simulated(folder, effects_file=None, model=None):
    """Case of a flight whose anchors are late, corrected, if nothing else is given, with their true delays as a
    calibration would find them: an effects.yaml in the folder."""
    flight = simulate(SIMULATED)
    if not (effects_file or model):
        true_delays = AnchorDelay(flight.meta["parameters"]["anchor_delays"], source="the simulation's own values")
        effects_file = Path(folder) / "effects.yaml"
        EffectSet((true_delays,)).to_yaml(effects_file)
    return Case(flight, effects_file, model)


def measured(path, reading, effects_file=None, model=None):
    """Case of a recording, read by a Reading, corrected, if nothing else is given, with the model that bias_node ships.
    Raises InputError."""
    flight = reading.one(path)
    if flight.truth is None:
        raise InputError(f"{path}: holds no ground truth to compare with; take a flight that has it.")
    airborne(flight.truth)
    return Case(flight, effects_file, model or unasked(effects_file))


def fly(case, folder, rate=1.0, say=print):
    """Write the flight of a Case as a bag, play it to both nodes, and run the filter without ROS beside them.

    Returns ({what became of the messages: count}, see `accounts`, [Score of the filter without correction, of the
    nodes, of the filter with correction]). The bags and the output of the nodes go to the folder. Raises InputError,
    LiveError. say(text) : told what happens.
    """
    flight, bag, correction = case.flight, folder / "flight.bag", case.corrector()
    write_bag(flight, bag, force=True)
    model = SHIPPED if case.model == SHIPPED else _absolute(case.model)
    bias, ekf = {"effects_file": _absolute(case.effects_file), "model_file": model}, {"use_imu": flight.imu is not None}
    live = run_live(bag, folder, rate, bias, ekf, say)
    estimates = {
        "raw": run_offline(flight).odometry,
        "corrected": read_odometry(live.recorded),
        "corrected, without ROS": run_offline(flight, corrector=correction).odometry,
    }
    return accounts(live.bias, live.ekf, flight), [Score(name, one, flight.truth) for name, one in estimates.items()]


def next_steps(recording=None, survey=None):
    """[command] to type after the demo: check a recording, then diagnose it. Default: one that the user has yet to make."""
    run = "ros2 run uwb_tdoa_tools" if shutil.which("ros2") else "./dev run uwb_tdoa_tools"
    words = shlex.join([str(recording), *(("--survey", str(survey)) if survey else ())]) if recording else ""
    words = words or "RECORDING --survey SURVEY"
    return [f"{run} check {words}", f"{run} diagnose {words} --out diagnosis/"]


def _absolute(path):
    """For a node, which runs elsewhere; "" for none."""
    return str(Path(path).resolve()) if path else ""
