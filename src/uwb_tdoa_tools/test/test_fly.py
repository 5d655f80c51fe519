"""The executable `fly`."""

import json

import pytest
from test_flying_verdict import made_up

from uwb_tdoa_tools.commands.fly import main
from uwb_tdoa_tools.flying import fleet
from uwb_tdoa_tools.flying.verdict import verdict_of
from uwb_tdoa_tools.readers import read_flight


def test_flights_are_counted_told_and_drawn(tmp_path, capsys):
    out, picture = tmp_path / "flown.json", tmp_path / "flown.png"
    options = [
        "--flights",
        "1",
        "--no-floor-effect",
        "--told",
        "place",
        "--json",
        str(out),
        "--plot",
        str(picture),
    ]
    code = main([*options, "--at-least", "1"])
    content = json.loads(out.read_text())
    assert [one["seed"] for one in content["flights"]] == [1]
    assert content["summary"]["landed"] == sum(one["landed"] for one in content["flights"])
    assert code == int(content["summary"]["landed"] < 1)
    assert f"{content['summary']['landed']} of 1 landed" in capsys.readouterr().out
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_a_parameter_that_is_none_is_told(capsys):
    assert main(["--set", "nonsense:=1"]) == 2
    assert "nonsense" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--silence", "noon:3"], "'noon:3' is not MOMENT:S"),
        (["--silence", "circle:x"], "'circle:x' is not MOMENT:S"),
        (["--inject", "gremlins", "1=2"], "'gremlins' needs the name of an effect"),
        (["--inject", "anchor_delay", "3=x"], "anchor_delay"),
        (["--resume", "kept.jsonl", "--plot", "x.png"], "--resume: keeps verdicts alone"),
        (["--model", "nowhere.onnx"], "nowhere.onnx"),
        (["--peer", "nowhere.so"], "nowhere.so cannot be loaded"),
        (["--json", "nowhere/x.json"], "its directory does not exist"),
    ],
)
def test_what_cannot_be_is_told(options, said, capsys):
    assert main([*options, "--flights", "1"]) == 2
    assert said in capsys.readouterr().err


def test_it_goes_on_from_what_is_there(tmp_path, capsys, monkeypatch):
    kept, out = tmp_path / "kept.jsonl", tmp_path / "flown.json"
    options = [
        "--no-floor-effect",
        "--flights",
        "2",
        "--jobs",
        "1",
        "--resume",
        str(kept),
        "--json",
        str(out),
    ]
    flown = []

    def one(task):
        flown.append(task.seed)
        return task.seed

    verdict = verdict_of(made_up())
    monkeypatch.setattr(fleet, "fly", one)
    monkeypatch.setattr(fleet, "verdict_of", lambda seed: {**verdict, "seed": seed})
    main(options)
    assert flown == [1, 2]
    main(["--no-floor-effect", "--flights", "3", *options[3:]])
    assert flown == [1, 2, 3] and [
        one["seed"] for one in json.loads(out.read_text())["flights"]
    ] == [1, 2, 3]
    assert main(["--flights", "3", *options[3:]]) == 2
    assert "another floor_effect" in capsys.readouterr().err
    kept.write_text(
        kept.read_text().splitlines()[0] + '\n{"key": "1", "result": {"landed": true}}\n'
    )
    assert main(["--no-floor-effect", "--flights", "1", *options[3:]]) == 2
    assert "holds something else than results" in capsys.readouterr().err


def test_a_flight_is_recorded_for_the_other_tools(tmp_path):
    assert (
        main(
            [
                "--no-floor-effect",
                "--flights",
                "1",
                "--aid",
                "height",
                "--record",
                str(tmp_path / "flown"),
            ]
        )
        == 0
    )
    flight = read_flight(tmp_path / "flown" / "flown-1")
    assert len(flight.height) and len(flight.tdoa) > 5000 and flight.truth.p[:, 2].max() > 1.0
