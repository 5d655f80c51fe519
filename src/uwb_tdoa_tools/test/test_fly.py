# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable `fly`."""

import json

import pytest

from uwb_tdoa_tools.commands.fly import main
from uwb_tdoa_tools.readers import read_flight


@pytest.mark.slow
def test_a_flight_is_counted_drawn_and_recorded_for_the_other_tools(tmp_path, capsys):
    out, picture, record = tmp_path / "flown.json", tmp_path / "flown.png", tmp_path / "flown"
    options = ["--flights", "1", "--no-floor-effect", "--told", "place", "--sensor", "height"]
    written = ["--json", str(out), "--plot", str(picture), "--record", str(record)]
    code = main([*options, *written, "--at-least", "1"])
    content = json.loads(out.read_text())
    assert [one["seed"] for one in content["flights"]] == [1]
    landed = content["summary"]["landed"]
    assert landed == sum(one["landed"] for one in content["flights"])
    assert code == int(landed < 1)
    assert f"{landed} of 1 landed" in capsys.readouterr().out
    assert picture.read_bytes()[:4] == b"\x89PNG"
    flight = read_flight(record / "flown-1")
    assert len(flight.height) and len(flight.tdoa) > 5000 and flight.truth.p[:, 2].max() > 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "nonsense:=1"], "nonsense"),
        (["--silence", "noon:3"], "'noon:3' is not MOMENT:S"),
        (["--silence", "circle:x"], "'circle:x' is not MOMENT:S"),
        (["--inject", "gremlins", "1=2"], "'gremlins' needs the name of an effect"),
        (["--inject", "anchor_delay", "3=x"], "anchor_delay"),
        (["--model", "nowhere.onnx"], "nowhere.onnx"),
        (["--json", "nowhere/x.json"], "its directory does not exist"),
    ],
)
def test_an_unusable_option_is_named(options, message, capsys):
    assert main([*options, "--flights", "1"]) == 2
    assert message in capsys.readouterr().err
