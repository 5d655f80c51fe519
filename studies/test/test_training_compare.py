# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study that compares trained bias models."""

import json

import pytest

from studies import __main__ as study
from studies.training import simulated
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_tools.training import structured


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(structured, "SITE_WEIGHTS", 320)
    monkeypatch.setattr(simulated, "DURATION", 18.0)
    monkeypatch.setattr(simulated, "TRAINING", ("corners", "wall_middles"))
    monkeypatch.setattr(simulated, "UNSEEN", ("low_ceiling",))


@pytest.mark.slow
def test_compares_on_constellations_never_seen(tmp_path, capsys):
    arguments = [
        "compare-models",
        "--simulated",
        "2",
        "--models",
        "structured",
        "physics",
        "--bound",
        "--out",
        str(tmp_path),
    ]
    assert study.main(arguments) == 0
    report = json.loads((tmp_path / "comparison.json").read_text())
    assert [row["flight"] for row in report["runs"]] == ["low_ceiling-0", "low_ceiling-1"]
    means = report["groups"]["low_ceiling"]
    assert means["structured"] < 0.9 * means["none"] and means["oracle 0.5 s"] < means["none"]
    assert report["tdoa_rms"]["structured"] < report["tdoa_rms"]["none"]
    assert 0.3 < report["normalised_variance"]["structured"] < 3.0
    assert (tmp_path / "structured" / "model.onnx").exists() and (
        tmp_path / "physics" / "effects.yaml"
    ).exists()
    assert Network(tmp_path / "structured" / "model.onnx").meta["largest_yaw_std"] == "1.0"
    assert {"table.md", "histograms.png", "rmse.png"} <= {path.name for path in tmp_path.iterdir()}
    printed = capsys.readouterr().out
    assert (
        "**mean**" in printed
        and "repeat" not in printed.lower()
        and (tmp_path / "table.md").read_text() in printed
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "both are needed"),
        (["--simulated", "0"], "a number above 0"),
        (["--simulated", "1", "--train", "a"], "neither --train nor --test"),
        (["--train", "a", "--test", "lonely"], "lonely names no flight"),
    ],
)
def test_says_what_is_missing(tmp_path, capsys, arguments, message):
    assert study.main(["compare-models", *arguments, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
