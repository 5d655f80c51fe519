# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""After compile_nodes, the nodes have nothing to compile when they start."""

import os

from programs import python
import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from rig import make_rig  # noqa: E402, F401

from uwb_tdoa_ekf import compile_nodes  # noqa: E402

pytestmark = pytest.mark.slow

IN_FLIGHT = """
import sys
from flights import fly
import numpy as np
from uwb_tdoa_ekf import compile_nodes, estimator

def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("uwb_tdoa_")]
    return {each.py_func: len(each.signatures) for module in modules for each in vars(module).values() if hasattr(each, "signatures")}

compile_nodes.warm_up()
before, flight = compiled(), fly(duration=20.0)
tag, imu, tdoa = estimator.Estimator(flight.anchors), flight.imu, flight.tdoa
for t in np.arange(0.0, 20.0, 0.02):
    some = (imu.t >= t) & (imu.t < t + 0.02)
    tag.add_imu(imu.t[some], imu.gyro[some], imu.accel[some])
    some = (tdoa.t >= t) & (tdoa.t < t + 0.02)
    tag.add_tdoa(tdoa.t[some], tdoa.a[some], tdoa.b[some], tdoa.d[some])
    tag.advance()
    if t > 19.0:
        tag.distrust()
assert tag.running
print([function.__name__ for function, count in compiled().items() if count > before.get(function, 0)])
"""


IN_A_CORRECTION = """
import sys
import numpy as np
from uwb_tdoa_bias.common import compiled
from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, ImuCorrector, SmoothTerm
from uwb_tdoa_bias.effects.anchor import AnchorDelay
from uwb_tdoa_bias.effects.tag import TagLeverArm
from uwb_tdoa_ekf import compile_nodes

def signatures():
    return {each.py_func.__qualname__: len(each.signatures) for each in compiled._FUNCTIONS}

assert compile_nodes.main([]) == 0
before, line = signatures(), {"shape": "line", "knots": (0.0, 3.0), "values": {"c0": 0.1, "c1": 0.4}}
smooth = [SmoothTerm(form="common", covariate=name, **line) for name in ("x", "speed", "tilt", "time")]
effects = EffectSet([AnchorDelay({"1": 0.1}), TagLeverArm({"z": 0.1}), *smooth])
t = 0.01 * np.arange(100)
corrector = Corrector(Anchors.from_positions(np.eye(3)), effects)
corrector.add_pose(t, np.zeros((100, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (100, 1)), np.ones((100, 3)))
corrector.correct(t, np.zeros(100, int), np.ones(100, int), np.zeros(100))
accel = SmoothTerm(channel="accel.y", covariate="vibration", **line)
ImuCorrector([accel]).correct(t, np.zeros((100, 3)), np.zeros((100, 3)))
print([name for name, count in signatures().items() if count > before.get(name, 0)])
"""


def test_after_it_no_node_compiles_anything(make_rig, monkeypatch, capsys):
    assert compile_nodes.main([]) == 0
    assert capsys.readouterr().out.startswith("ekf_node and bias_node are compiled; ")
    monkeypatch.setitem(os.environ, "NUMBA_DEBUG_CACHE", "1")
    rig = make_rig()
    processes = rig.start("bias_node", "ekf_node")
    for process in processes:
        said = "".join(process.lines)
        assert "data loaded from" in said and "data saved to" not in said


@pytest.mark.parametrize("code", [IN_FLIGHT, IN_A_CORRECTION])
def test_nothing_is_compiled_in_flight(code):
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(
            [os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")]
        ),
    }
    ended = python("-c", code, env=environment, timeout=300.0)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[-1] == "[]"
