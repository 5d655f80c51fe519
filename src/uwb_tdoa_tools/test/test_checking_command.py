"""The executable: text, JSON and exit codes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.check import main
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

from checking_flights import QUICK


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A healthy bag, and one with flipped signs."""
    folder = tmp_path_factory.mktemp("bags")
    flight = simulate(SimulationConfig(seed=0, **{**QUICK, "imu_rate": 200.0}))
    write_bag(flight, folder / "good.bag")
    write_bag(replace(flight, tdoa=replace(flight.tdoa, d=-flight.tdoa.d)), folder / "flipped.bag")
    return folder


def test_a_healthy_bag_is_ok(bags, capsys):
    assert main([str(bags / "good.bag")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("good: OK  (TDOAs ") and "8 of 8 heard, TDoA2" in out


def test_errors_have_code_one_and_a_line_to_copy(bags, tmp_path, capsys):
    assert main([str(bags / "flipped.bag"), "--json", str(tmp_path / "out.json")]) == 1
    out = capsys.readouterr().out
    assert "ERROR: the sign of all TDOAs is wrong" in out
    assert "remedy: message.distance_difference = distance_to_b - distance_to_a" in out
    content = json.loads((tmp_path / "out.json").read_text())
    (finding,) = content["recordings"][0]["findings"]
    assert finding["rule"] == "tdoa_sign" and finding["severity"] == "error" and finding["value"] < 0.9
    assert content["together"] == []


def test_several_recordings_at_once(bags, capsys):
    assert main([str(bags)]) == 1
    out = capsys.readouterr().out
    assert "1 error" in out and ": OK" in out


@pytest.mark.parametrize("arguments, sentence", [(["nowhere.bag"], "does not exist"), ([], "usage")])
def test_bad_input_is_two(arguments, sentence, capsys):
    assert main(arguments) == 2
    assert sentence in capsys.readouterr().err


def test_another_survey_than_the_bag_brings(bags, tmp_path, capsys):
    rows = np.random.default_rng(0).uniform(0.0, 6.0, (8, 3))
    lines = "".join(f"{k},{x:.2f},{y:.2f},{z:.2f}\n" for k, (x, y, z) in enumerate(rows))
    (tmp_path / "wrong.csv").write_text("id,x,y,z\n" + lines)
    assert main([str(bags / "good.bag"), "--survey", str(tmp_path / "wrong.csv")]) == 1
    out = capsys.readouterr().out
    assert "the bag brings other anchors" in out and "survey" in out
