# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable: text, JSON and exit codes."""

import contextlib
from dataclasses import replace
import io
import json

from checking_flights import QUICK
import numpy as np
import pytest

from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.check import main
from uwb_tdoa_tools.simulation import SimulationConfig, simulate


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """Check a folder with a healthy bag and a bag with flipped signs.

    Returns the folder, the exit code and the JSON.
    """
    folder = tmp_path_factory.mktemp("bags")
    flight = simulate(SimulationConfig(seed=0, **{**QUICK, "imu_rate": 200.0}))
    write_bag(flight, folder / "good.bag")
    write_bag(replace(flight, tdoa=replace(flight.tdoa, d=-flight.tdoa.d)), folder / "flipped.bag")
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = main([str(folder), "--json", str(folder / "out.json")])
    return folder, code, out.getvalue(), json.loads((folder / "out.json").read_text())


@pytest.mark.slow
def test_a_healthy_bag_is_ok(checked):
    _, _, out, content = checked
    (good,) = (line for line in out.splitlines() if line.startswith("good"))
    assert good.startswith("good: OK  (TDOAs ") and "8 of 8 heard, TDoA2" in good
    assert content["recordings"][1]["findings"] == [] and content["together"] == []


@pytest.mark.slow
def test_errors_have_code_one_and_a_line_to_copy(checked):
    _, code, out, content = checked
    assert code == 1 and "flipped: 1 error" in out
    assert "ERROR: the sign of all TDOAs is wrong" in out
    assert "remedy: message.distance_difference = distance_to_b - distance_to_a" in out
    (finding,) = content["recordings"][0]["findings"]
    assert (
        finding["rule"] == "tdoa_sign" and finding["severity"] == "error" and finding["value"] < 0.9
    )


@pytest.mark.slow
def test_without_errors_the_code_is_zero(checked):
    assert main([str(checked[0] / "good.bag")]) == 0


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["nowhere.bag"], "does not exist"),
        ([], "give recordings, or --live"),
        (["x.bag", "--live", "3"], "not both"),
        (["--live", "-1"], "above 0"),
    ],
)
def test_bad_input_is_two(arguments, sentence, capsys):
    assert main(arguments) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.slow
def test_a_survey_that_differs_from_the_bag_is_named(checked, tmp_path, capsys):
    rows = np.random.default_rng(0).uniform(0.0, 6.0, (8, 3))
    lines = "".join(f"{k},{x:.2f},{y:.2f},{z:.2f}\n" for k, (x, y, z) in enumerate(rows))
    (tmp_path / "wrong.csv").write_text("id,x,y,z\n" + lines)
    assert main([str(checked[0] / "good.bag"), "--survey", str(tmp_path / "wrong.csv")]) == 1
    out = capsys.readouterr().out
    assert "the bag holds other anchors than the survey" in out and "survey" in out
