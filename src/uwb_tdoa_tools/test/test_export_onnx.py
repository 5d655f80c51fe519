"""A correction in one ONNX file is that of effects and network: each effect, all together."""

from dataclasses import replace

from exported_states import anchors_of, exportable, network_of, states
import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from uwb_tdoa_bias.correction.corrector import Corrector  # noqa: E402
from uwb_tdoa_bias.correction.exported import INPUTS, ExportedCorrection  # noqa: E402
from uwb_tdoa_bias.correction.session import Session  # noqa: E402
from uwb_tdoa_bias.effects import EffectSet  # noqa: E402
from uwb_tdoa_bias.effects.effect_set import REACH  # noqa: E402
from uwb_tdoa_tools.exporting.onnx_file import write_onnx  # noqa: E402
from uwb_tdoa_tools.training.network import FEATURES, WITHOUT  # noqa: E402

EQUAL = 1e-4  # m
ANCHORS = anchors_of()
EFFECTS = exportable(ANCHORS)


def exported(path, effects, network=None):
    """The ExportedCorrection of a file that is written for ANCHORS."""
    write_onnx(path, ANCHORS, effects, network)
    return ExportedCorrection(path, Session(path.read_bytes()))


def assert_equal(effects, network, model, samples):
    """The file says the same as effects and network, within EQUAL."""
    expected = Corrector(ANCHORS, effects, network).prediction(samples)
    found = Corrector(ANCHORS, None, model).prediction(samples)
    scale = {"bias": EQUAL, "std": EQUAL, "slope": EQUAL / REACH, "status": 0.0, "state": 0.0}
    for name, most in scale.items():
        one, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(one, other, rtol=0.0, atol=most, err_msg=name)


@pytest.mark.parametrize("name", EFFECTS)
def test_each_effect(tmp_path, name):
    effects = EffectSet((EFFECTS[name],))
    model = exported(tmp_path / "bias.onnx", effects)
    samples = states(ANCHORS)
    assert_equal(effects, None, model, samples)
    prediction = Corrector(ANCHORS, effects).prediction(samples)
    assert max(np.abs(prediction.bias).max(), prediction.std.max()) > 0.01  # it is tested
