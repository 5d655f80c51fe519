# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""bias_node with the exported file alone, over topics, against effects and network offline."""

import numpy as np
import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")
pytest.importorskip("onnx")

from exported_states import network_of, term  # noqa: E402
from rig import make_rig, recording  # noqa: E402, F401

from uwb_tdoa_bias.correction.corrector import Corrector  # noqa: E402
from uwb_tdoa_bias.effects import EFFECTS, EffectSet  # noqa: E402
from uwb_tdoa_ekf.offline import run_offline  # noqa: E402
from uwb_tdoa_tools.exporting.onnx_file import write_onnx  # noqa: E402
from uwb_tdoa_tools.training.models import WITHOUT  # noqa: E402

pytestmark = pytest.mark.slow  # starts nodes

EQUAL = 1e-4  # m


def test_bias_node_corrects_as_with_effects_and_network(make_rig, tmp_path):  # noqa: F811
    """The filter is in the loop: the corrections influence where the next TDOA is corrected."""
    flight = recording()
    values = {
        "anchor_delay": {"10": 0.1, "14": -0.05},
        "tag_lever_arm": {"x": 0.05, "z": 0.1},
        "range_bias": {"quadratic": 0.002},
    }
    declared = (EFFECTS[name](value) for name, value in values.items())
    effects = EffectSet((*declared, term(flight.anchors, "climb_rate", "common")))
    network, path = network_of(tmp_path, WITHOUT), tmp_path / "bias.onnx"
    write_onnx(path, flight.anchors, effects, network)
    rig = make_rig()
    rig.start("localization_node", localization_node=["-p", f"model_file:={path}"])
    rig.send_anchors(flight.anchors)
    rig.play(flight)
    rig.counts("bias_node", received=len(flight.tdoa), published=len(flight.tdoa))
    rig.wait(lambda: len(rig.corrected) == len(flight.tdoa), "all corrected TDOAs")

    expected = run_offline(flight, None, Corrector(flight.anchors, effects, network))
    np.testing.assert_allclose([m.bias for m in rig.corrected], expected.bias, rtol=0, atol=EQUAL)
    assert {m.status for m in rig.corrected} == {1, 2}  # before the first pose, and after it
    names = {m.status: m.model for m in rig.corrected}
    assert names == {1: effects.name, 2: f"{effects.name}+random"}
    assert np.ptp(expected.bias) > 0.1
    assert np.max([np.abs(m.bias_slope) for m in rig.corrected]) > 0.01


def test_bias_node_names_the_anchors_that_its_file_does_not_know(make_rig, tmp_path):  # noqa: F811
    anchors = recording().anchors
    moved = anchors.positions.copy()
    moved[anchors.index([10])[0]] += 0.5
    path = tmp_path / "bias.onnx"
    write_onnx(path, anchors.at(moved), EffectSet((EFFECTS["anchor_delay"]({"11": 0.1}),)))
    rig = make_rig()
    rig.start("bias_node", bias_node=["-p", f"model_file:={path}"])
    rig.send_anchors(anchors)
    rig.send_tdoa(0.1, 10, 11, 1.0)
    rig.send_tdoa(0.2, 11, 12, 1.0)
    rig.wait(lambda: len(rig.corrected) == 2, "both TDOAs")
    assert [m.bias for m in rig.corrected] == pytest.approx([0.0, -0.1])
    assert [m.model for m in rig.corrected] == ["none", "anchor_delay"]
    said = "model_file was exported without anchor 10, or for another place"
    assert rig.fresh_status("bias_node").message.startswith(said)
