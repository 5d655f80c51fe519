# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The first hour of a new user with ground truth: the documented commands and their results.

The commands are taken word for word from the documentation.
"""

from first_hour import (
    WALK,
    at_desk,
    measured,
    recorded,
    said_on_the_way,
    simulated,
    written,
)
import pytest
from walking import blocks, commands, main, run

from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import EffectSet

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("source", "name"),
    [("simulated", "z down, on another epoch"), ("measured", "late")],
)
def test_from_csv_and_tape_to_a_diagnosed_flight(
    tmp_path, monkeypatch, capsys, shared_data, source, name
):
    """docs/csv.md: convert, check, evaluate, diagnose, evaluate.

    test_connect.py covers a ground truth that is in time.
    """
    at_desk(tmp_path, monkeypatch)
    if source == "simulated":
        hall = simulated(read_survey(written("anchors.yaml", *blocks(WALK, "yaml"))))
    else:
        hall = measured(shared_data)
    script = recorded(hall, True, name)
    if "epoch" in name:  # convert refuses the recording and prints the option to add
        assert [main(*command) for command in commands(script)] == [2, 2]
        assert capsys.readouterr().err.count("on another clock than the TDOAs") == 2
        script = script.replace("--out", "--align time --out")
    run(script)
    capsys.readouterr()
    before = hall.error()
    # against this ground truth, until its frame is corrected
    diverged = (0, 1) if "z down" in name else (0,)
    for command, words in commands(blocks(WALK)[1]):
        assert main(command, words) in (diverged if command == "evaluate" else (0,)), (
            command,
            words,
        )
    printed = capsys.readouterr()
    after = hall.error("diagnosis")
    said_on_the_way(capsys, f"{source}, truth {name}", before, after)
    effects = EffectSet.from_yaml("diagnosis/effects.yaml")
    assert not any(effect.name.endswith("time_offset") for effect in effects.effects)
    if len(effects):
        assert after < before
    else:
        assert "nothing" in printed.out
    assert after <= before
    said = printed.out + printed.err
    if name == "late":
        assert "late" in said or "apart" in said
    if "z down" in name:
        assert "in another frame" in said or "the frame of the truth is turned" in said
