# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Choices of options: the names equal those in the code, and parsers import no heavy modules."""

import subprocess
import sys

import pytest
from test_executables import TOOLS

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_tools import choices
from uwb_tdoa_tools.bags.files import PLUGINS
from uwb_tdoa_tools.diagnosis.references import REFERENCES
from uwb_tdoa_tools.flying.sensors import SENSOR_NAMES
from uwb_tdoa_tools.flying.world import WORLDS
from uwb_tdoa_tools.planning.installation import PARTS
from uwb_tdoa_tools.simulation import SimulationConfig
from uwb_tdoa_tools.simulation.config import VEHICLE_DEFAULTS
from uwb_tdoa_tools.simulation.paths import TRAJECTORIES

# modules that a command imports only for its work; together they take half a second or more
HEAVY = """PIL apsw jinja2 joblib llvmlite matplotlib numba onnx onnxruntime pandas rclpy rosbags scipy sklearn
    tqdm""".split()


@pytest.mark.parametrize(
    "offered, known",
    [
        (choices.STORAGES, PLUGINS),
        (choices.REFERENCES, REFERENCES),
        (choices.TRAJECTORIES, TRAJECTORIES),
        (choices.CARRIERS, VEHICLE_DEFAULTS),
        (choices.WORLDS, WORLDS),
        (choices.PAIRINGS[:5], PARTS),
        (tuple(SENSORS), SENSOR_NAMES),
    ],
)
def test_options_offer_what_there_is(offered, known):
    assert offered == tuple(known)


def test_the_defaults_that_simulate_names_are_those_of_a_simulation():
    default = SimulationConfig()
    assert (default.vehicle, default.trajectory, default.duration) == ("quadrotor", "sines", 60.0)
    assert (default.noise_std, default.outlier_probability, default.seed) == (0.06, 0.01, 0)
    assert set(choices.OF_PROTOCOL.values()) <= set(choices.PAIRINGS)


def test_help_and_usage_errors_import_nothing_heavy():
    """One process tests all parsers: a module imported by one would be hidden for the next."""
    code = (
        "import contextlib, importlib, io, sys\n"
        f"for name in {TOOLS}:\n"
        "    main = importlib.import_module(f'uwb_tdoa_tools.commands.{name}').main\n"
        "    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):\n"
        "        assert main(['--help']) == 0 and main(['--no-such-option']) == 2, name\n"
        f"    print(name, *sorted({HEAVY} & sys.modules.keys()))\n"
    ).replace(str(HEAVY), f"set({HEAVY})")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == TOOLS
