# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import json

import numpy as np
import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import train
from uwb_tdoa_tools.training import structured
from uwb_tdoa_tools.training.labels import labels


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write two flights with attitude and two without. One anchor is late."""
    out = tmp_path_factory.mktemp("flights")
    late = [EFFECTS["anchor_delay"]({"3": 0.4}).inject(flight(seed)) for seed in range(4)]
    for one in (*late[:2], *map(without_attitude, late[2:])):
        write_bag(one, out / f"{one.name}.bag")
    return out


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(structured, "SITE_WEIGHTS", 320)


def files(out):
    return sorted(path.name for path in out.iterdir())


@pytest.mark.slow
def test_trains_on_flights_with_and_without_attitude_in_one_command(folder, tmp_path, capsys):
    out = tmp_path / "model"
    arguments = [
        str(folder),
        "--model",
        "physics+structured",
        "--out",
        str(out),
        "--seed",
        "3",
        "--name",
        "hall",
        "--jobs",
        "1",
    ]
    assert train.main(arguments) == 0
    assert files(out) == ["effects.yaml", "model.onnx", "training.json", "training.png"]
    printed = capsys.readouterr().out
    assert "training on" in printed and "validating on" in printed and "after correction" in printed

    network, effects = Network(out / "model.onnx"), EffectSet.from_yaml(out / "effects.yaml")
    assert network.name == "hall"
    meta = {key: json.loads(value) for key, value in network.meta.items()}
    assert meta["kind"] == "physics+structured" and meta["seed"] == 3 and meta["clip"] == 1.0
    assert len(meta["trained_on"]) == 3 and len(meta["validated_on"]) == 1
    (layout,) = meta["constellations"]
    assert set(layout) == {str(i) for i in range(8)} and len(meta["data"]) == 16
    assert set(meta["validity"]) >= {"forward_x", "up_x"} and meta["fade_std"] > 0.0
    assert (
        meta["features"][:3] == ["x", "y", "z"] and "largest_yaw_std" not in meta
    )  # maps of positions only
    assert len(meta["offset"]) == len(meta["scale"]) == len(meta["features"])

    told = json.loads((out / "training.json").read_text())
    assert told["curve"]["training flights"] == [1, 2, 3] and len(told["curve"]["validation"]) == 3
    ((before, after),) = told["validation"].values()
    assert after < 0.8 * before
    assert next(e for e in effects.effects if e.name == "anchor_delay").values[
        "3"
    ] == pytest.approx(0.4, abs=0.06)
    held = labels(flight(9))
    assert np.isfinite(network.predict(held.samples)[0]).all()


@pytest.mark.slow
def test_physics_alone_is_no_network_and_leaves_none_behind(folder, tmp_path):
    (tmp_path / "model.onnx").write_text("of an earlier training")
    assert (
        train.main([str(folder), "--model", "physics", "--out", str(tmp_path), "--jobs", "1"]) == 0
    )
    assert files(tmp_path) == ["effects.yaml", "training.json", "training.png"]


@pytest.mark.parametrize(
    ("flights", "model", "message"),
    [
        (["corners-0.bag"], "structured", "1 is too few"),
        (
            ["corners-0.bag", "corners-1.bag", "--validation", "nobody"],
            "structured",
            "nobody is not one of",
        ),
    ],
)
def test_says_what_is_missing(folder, tmp_path, capsys, flights, model, message):
    paths = [str(folder / name) if name.endswith(".bag") else name for name in flights]
    assert train.main([*paths, "--model", model, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
