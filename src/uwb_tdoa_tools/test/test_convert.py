# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import json

import pytest
from recordings import SURVEY, csv_text, differences, log_bytes

from uwb_tdoa_tools.commands.convert import main
from uwb_tdoa_tools.readers import read_flight


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flight.log").write_bytes(log_bytes())
    (tmp_path / "survey.csv").write_text(SURVEY)
    return tmp_path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bag_is_the_flight(files, capsys, storage):
    argv = [
        "flight.log",
        "--survey",
        "survey.csv",
        "--out",
        "made/flight.bag",
        "--storage",
        storage,
        "--json",
    ]
    assert main(argv) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["messages"] == {
        "/uwb/anchors": 1,
        "/tf_static": 1,
        "/imu/data": 3,
        "/height": 2,
        "/pressure": 2,
        "/uwb/tdoa": 2,
        "/ground_truth/pose": 1,
    }
    assert summary["left_out"] == {"estTemperature": 2} and summary["tdoa_unknown_anchor"] == 0
    assert (summary["start"], summary["end"]) == (1.0, 1.0025)
    assert (
        differences(read_flight("flight.log", "survey.csv"), read_flight("made/flight.bag")) == []
    )


def test_says_what_it_did(files, capsys):
    (files / "two.csv").write_text("id,x,y,z\n0,0,0,0\n1,4,0,3\n")
    assert main(["flight.log", "--survey", "two.csv", "--out", "flight.bag"]) == 0
    out = capsys.readouterr().out
    assert "  tdoa: 2, 1.0 to 1.0 s" in out and "  imu: 3, 1.0 to 1.0 s" in out
    assert "/uwb/tdoa: 2" in out and "estTemperature: 2 events left out" in out
    assert "1 measurements name an anchor that the survey does not have" in out


def test_existing_output_is_refused_before_the_work(files, capsys):
    argv = ["flight.log", "--survey", "survey.csv", "--out", "flight.bag"]
    assert main(argv) == 0
    assert main(argv) == 2
    assert capsys.readouterr().err == (
        "convert: error: flight.bag: exists already; choose another name, or --force to "
        "replace it.\n"
    )
    assert main([*argv, "--force"]) == 0


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"hello",
        log_bytes()[:-1],
        log_bytes()[:40],
        log_bytes()[:90] + b"\x55" + log_bytes()[91:],
        csv_text()[:-3].encode(),
    ],
)
def test_bad_input_leaves_no_bag(files, capsys, content):
    (files / "bad").write_bytes(content)
    before = sorted(files.iterdir())
    assert main(["bad", "--survey", "survey.csv", "--out", "flight.bag"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("convert: error: bad: ") and err.count("\n") == 1
    assert sorted(files.iterdir()) == before


def test_missing_survey(files, capsys):
    assert main(["flight.log", "--out", "flight.bag"]) == 2
    assert "give a survey file (--survey FILE)" in capsys.readouterr().err
    assert main(["flight.log", "--survey", "nothing.txt", "--out", "flight.bag"]) == 2
    assert "nothing.txt: cannot be read" in capsys.readouterr().err
    assert not (files / "flight.bag").exists()


def test_what_a_moved_clock_puts_before_zero_is_left_out_and_said(tmp_path, monkeypatch, capsys):
    """The clock of some tools starts with the recording."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "survey.csv").write_text(SURVEY)
    rows = [f"{0.1 * k:.1f},0,1,0.25,,,," for k in range(20)] + [
        f",,,,{0.1 * k:.1f},1,2,3" for k in range(20)
    ]
    (tmp_path / "a.csv").write_text("\n".join(["t,a,b,d,tp,x,y,z", *rows, ""]))
    columns = "tdoa_time=t,anchor_a=a,anchor_b=b,tdoa=d,pose_time=tp,pose_x=x,pose_y=y,pose_z=z"
    words = ["a.csv", "--columns", columns, "--survey", "survey.csv", "--out", "new.bag"]
    assert main([*words, "--time-offset", "truth=-0.45"]) == 0
    assert (
        "truth: 5 samples before 0 s, which a bag has no place for, are left out"
        in capsys.readouterr().out
    )
    truth = read_flight("new.bag").truth
    assert len(truth) == 15 and truth.t[0] == pytest.approx(0.05)
    assert main([*words[:-1], "other.bag", "--time-offset", "tdoa=-0.45"]) == 2
