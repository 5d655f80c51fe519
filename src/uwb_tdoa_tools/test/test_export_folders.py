# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The folders that export writes in C, and the effects that it leaves out."""

from dataclasses import replace

import c_programs as c
from c_programs import ANCHORS, GCC, cases, chosen, on_host
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.commands import export
from uwb_tdoa_tools.exporting.c_code import write_c, write_crazyflie
from uwb_tdoa_tools.exporting.tracing import trace

SMALL_IDS = Anchors(np.arange(8), ANCHORS.positions, ANCHORS.orientations)


def texts(folder):
    """Return {path: text} of a folder."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in found}


def test_the_build_for_a_crazyflie_names_what_its_filter_does_not_estimate(tmp_path):
    traced = trace(SMALL_IDS, chosen("anchor_delay", "turning", "accelerating"))
    left = write_crazyflie(tmp_path / "app", traced, 0.4)
    assert ["turning_rate" in str(one) for one in left] == [True, False]
    assert all("estimates no acceleration and no rate" in str(one) for one in left)
    assert all(one.worth > 0.01 for one in left)
    made = texts(tmp_path / "app")
    assert "#define UWB_BIAS_READS_RATES 0" in made["src/uwb_bias.h"]
    paths = "Makefile Kbuild config README.md anchors.yaml overrides/estimator_kalman.h src/Kbuild"
    assert set(paths.split()) <= set(made)


def test_ids_that_the_firmware_does_not_have_are_refused(tmp_path):
    with pytest.raises(InputError, match="ids up to 255, and one is 300"):
        write_crazyflie(tmp_path / "app", trace(ANCHORS, chosen("anchor_delay")), 0.4)
    assert not (tmp_path / "app").exists()


def test_a_network_that_is_no_chain_of_layers_is_refused(tmp_path, monkeypatch):
    network = c.network(tmp_path)
    traced = trace(ANCHORS, None, network)
    monkeypatch.setattr("uwb_tdoa_tools.exporting.c_code.CHAIN", "Gemm")
    with pytest.raises(InputError, match="has the operators Gemm Relu Gemm .*; train"):
        write_c(tmp_path / "c", traced)
    monkeypatch.undo()
    monkeypatch.setattr("uwb_tdoa_tools.exporting.c_code.Dense.run", lambda self, x: np.ones(2))
    with pytest.raises(InputError, match="its layers alone give other numbers; train"):
        write_c(tmp_path / "c", traced)


def test_names_in_a_file_do_not_end_its_comment(tmp_path):
    network = c.network(tmp_path)
    network.name = "*/ int x; /*"
    write_c(tmp_path / "c", trace(ANCHORS, None, network))
    assert "*/ int x" not in texts(tmp_path / "c")["uwb_bias.h"]


@pytest.mark.skipif(GCC is None, reason="no C compiler (gcc)")
def test_one_command_writes_all_targets(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    SMALL_IDS.to_yaml("anchors.yaml")
    held = chosen("anchor_delay", "turning", "range_bias")
    EffectSet((*held, EFFECTS["gyro_bias"]({"z": 0.01}))).to_yaml("effects.yaml")
    options = "--survey anchors.yaml --effects effects.yaml --onnx bias.onnx --c c --crazyflie app"
    assert export.main(options.split()) == 0
    out, err = capsys.readouterr()
    assert [line.rpartition(" ")[2] for line in out.splitlines()] == ["bias.onnx", "c", "app"]
    assert "gyro_bias is left out" in err and "app: " in err and "turning_rate" in err
    some = cases(50)
    some["a"], some["b"] = (ANCHORS.index(some[end]) for end in "ab")
    results = on_host(tmp_path / "c", some)
    samples = c.samples_of(_with_ids(some))
    expected = EffectSet.from_yaml("effects.yaml").where(lambda one: "tdoa" in one.channels)
    samples = replace(samples, anchors=SMALL_IDS)
    np.testing.assert_allclose(results["bias"], expected.bias(samples), atol=1e-5)


def _with_ids(some):
    """Return the cases with ids of ANCHORS instead of rows."""
    out = some.copy()
    for end in "ab":
        out[end] = ANCHORS.ids[some[end]]
    return out
