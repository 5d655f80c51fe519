# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The first hour of a new user without ground truth, and the steps of guide.md.

The commands are taken word for word from the documentation.
"""

from pathlib import Path
import re
import shlex

from first_hour import (
    WALK,
    at_desk,
    measured,
    recorded,
    said_on_the_way,
    simulated,
    written,
)
import numpy as np
import pytest
from recordings import log_bytes
from walking import blocks, commands, main, run, section

from uwb_tdoa_bias.common.survey import read_survey

pytestmark = pytest.mark.slow


def ended(name, words):
    """Return the exit code of a step: 0, or 1 if its result is not to be used."""
    code = main(name, words)
    assert code in (0, 1), (name, words)
    return code


@pytest.mark.parametrize("source", ["simulated", "measured"])
def test_from_tape_to_calibrated_without_ground_truth(
    tmp_path, monkeypatch, capsys, shared_data, source
):
    """docs/calibration.md in one command, then docs/localizing.md or step by step."""
    at_desk(tmp_path, monkeypatch)
    survey = read_survey(written("anchors.yaml", *blocks(WALK, "yaml")))
    hall = simulated(survey, (0, 6)) if source == "simulated" else measured(shared_data)
    run(recorded(hall, False))
    for day, name in (("monday", "first"), ("tuesday", "second")):
        Path(f"{day}.bag").rename(f"{name}.bag")
    Path("flight.bag").symlink_to("first.bag")
    before = hall.error()
    (quick, whole), *_ = [
        commands(text) for text in blocks(section("calibration.md", "In one command"))
    ]
    if source == "simulated":
        assert main(*quick) == 0
    capsys.readouterr()
    code = ended(*whole)
    printed = capsys.readouterr()
    after = hall.error("calibrated")
    said_on_the_way(capsys, f"{source}, calibrate", before, after)
    if code:
        assert "nothing to use is written" in printed.err and after == before
    else:
        assert after < before
        _lines_run(printed.out)
    if source == "simulated":
        (located, *_) = commands(blocks(section("localizing.md", "Where the tag was"))[0])
        assert main(*located) in (0, 1) and Path("localized/flight.tum").exists()
    else:
        _step_by_step(hall, before, capsys)


def _step_by_step(hall, before, capsys):
    """Run check and survey, the steps of calibrate."""
    (checked,), (surveyed,) = (
        commands(blocks(section("calibration.md", heading))[0])
        for heading in ("2. Fly, and check", "3. Survey")
    )
    assert main(*checked) in (0, 1)
    capsys.readouterr()
    code = ended(*surveyed)
    printed = capsys.readouterr()
    after = hall.error("surveyed")
    said_on_the_way(capsys, "measured, survey", before, after)
    assert "nothing is applied" in printed.out if code else after < before


def _lines_run(text):
    """Check that printed commands run unchanged. For nodes, check that their files exist."""
    lines = re.findall(r"\./dev run uwb_tdoa_\w+ .*$", text, re.MULTILINE)
    assert len(lines) == 3
    for line in lines:
        _, _, _, name, *words = shlex.split(line)
        if name.endswith("_node"):
            files = [word.partition(":=")[2] or word for word in words if ".yaml" in word]
            assert files and all(Path(file).is_file() for file in files)
        else:
            assert main(name, words) in (0, 1), line


# --- guide.md, from a log ---


def write_log(flight, path):
    """Write a Flight as a micro-SD log: deg/s and g."""
    rows = [
        ("estTDOA", t, (int(a), int(b), d))
        for t, a, b, d in zip(flight.tdoa.t, flight.tdoa.a, flight.tdoa.b, flight.tdoa.d)
    ]
    for name, values in (
        ("estGyroscope", np.rad2deg(flight.imu.gyro)),
        ("estAcceleration", flight.imu.accel / 9.81),
    ):
        rows += [(name, t, tuple(value)) for t, value in zip(flight.imu.t, values)]
    rows += [
        ("estPose", t, (*p, *q)) for t, p, q in zip(flight.truth.t, flight.truth.p, flight.truth.q)
    ]
    rows.sort(key=lambda row: row[1])
    Path(path).write_bytes(log_bytes([(name, round(1e6 * t), values) for name, t, values in rows]))


def test_the_four_steps_of_the_guide(tmp_path, monkeypatch, capsys):
    """check, calibrate, diagnose, survey, localize: guide.md, from a log and a survey."""
    at_desk(tmp_path, monkeypatch)
    hall = simulated(read_survey(written("anchors.yaml", *blocks(WALK, "yaml"))))
    write_log(hall.flights[0], "FLIGHT.log")
    rows = [
        f"{i},{x:.3f},{y:.3f},{z:.3f}" for i, (x, y, z) in zip(hall.tape.ids, hall.tape.positions)
    ]
    written("SURVEY.txt", "\n".join(["id,x,y,z", *rows, ""]))
    steps = [
        command for text in blocks(section("guide.md", "Four steps")) for command in commands(text)
    ]
    steps = [
        (name, words)
        for name, words in steps
        if words and "--live" not in words and not name.endswith("_node")
    ]
    assert [name for name, _ in steps] == [
        "check",
        "calibrate",
        "calibrate",
        "diagnose",
        "survey",
        "localize",
    ]
    before = hall.error()
    for name, words in steps:
        code = ended(name, words)
        printed = capsys.readouterr()
        if "--out" not in words or name == "localize":
            continue
        after = hall.error(words[words.index("--out") + 1])
        said_on_the_way(capsys, f"guide, {name}", before, after)
        assert (
            after < before
            if code == 0
            else "nothing" in printed.out + printed.err and after == before
        )
    assert Path("localized/FLIGHT.tum").exists()
