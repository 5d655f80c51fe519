# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import json

import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.correction.model import Network
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import train
from uwb_tdoa_tools.exporting.c_code import write_c
from uwb_tdoa_tools.exporting.onnx_file import write_onnx
from uwb_tdoa_tools.exporting.tracing import trace


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write two flights with attitude and two without. One anchor is late."""
    out = tmp_path_factory.mktemp("flights")
    late = [EFFECTS["anchor_delay"]({"3": 0.4}).inject(flight(seed)) for seed in range(4)]
    for one in (*late[:2], *map(without_attitude, late[2:])):
        write_bag(one, out / f"{one.name}.bag")
    return out


@pytest.mark.slow
def test_trains_on_flights_with_and_without_attitude_in_one_command(folder, tmp_path, capsys):
    options = ["--seed", "3", "--name", "hall", "--jobs", "1"]
    anchors = flight(0).anchors
    files = {
        "physics": {"effects.yaml", "training.json", "training.png"},
        "paper": {"model.onnx", "training.json", "training.png"},  # nothing of the other is left
    }
    for model, expected in files.items():
        arguments = [str(folder), "--model", model, "--out", str(tmp_path), *options]
        assert train.main(arguments) == 0
        assert {path.name for path in tmp_path.iterdir()} == expected
        printed = capsys.readouterr().out
        for text in ("training on", "validating on", "after correction", "expected of flights"):
            assert text in printed
        told = json.loads((tmp_path / "training.json").read_text())
        assert told["kind"] == model and told["seed"] == 3 and told["clip"] == 1.0
        assert len(told["trained_on"]) == 3 and len(told["validated_on"]) == 1
        (layout,) = told["constellations"]
        assert set(layout) == set("01234567") and len(told["data"]) == 16
        ((before, after),) = told["validation"].values()
        if model == "physics":
            assert told["curve"]["training flights"] == [1, 2, 3] and after < 0.8 * before
            effects = EffectSet.from_yaml(tmp_path / "effects.yaml")
            (delay,) = (effect for effect in effects if effect.name == "anchor_delay")
            assert delay.values["3"] == pytest.approx(0.4, abs=0.06)
            exported = anchors, effects, None
        else:
            exported = anchors, None, Network(tmp_path / "model.onnx")
            assert "by a larger deviation alone it" in printed
        write_c(tmp_path.parent / f"{model} in C", trace(*exported))
        write_onnx(tmp_path.parent / f"{model}.onnx", *exported)
    network = Network(tmp_path / "model.onnx")
    meta = {key: json.loads(value) for key, value in network.meta.items()}
    assert network.name == "hall" and meta["fade_std"] > 0.0 and 0.0 <= meta["share"] <= 1.0
    assert set(meta["validity"]) >= {"forward_x", "up_x", "dx_a"}
    assert len(meta["offset"]) == len(meta["scale"]) == len(meta["features"])


@pytest.mark.parametrize(
    ("more", "message"),
    [([], "1 is too few"), (["corners-1.bag", "--validation", "nobody"], "nobody is not one of")],
)
def test_says_what_is_missing(folder, tmp_path, capsys, monkeypatch, more, message):
    monkeypatch.chdir(folder)
    options = ["--model", "paper", "--out", str(tmp_path / "out")]
    assert train.main(["corners-0.bag", *more, *options]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
