# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Each tool that estimates reports an impossible survey, like `check`."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools import diagnosis
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.checking.check import survey_remarks
from uwb_tdoa_tools.commands import diagnose, evaluate, inject
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import constellation


def flown(seed):
    return simulate(
        SimulationConfig(
            seed=seed, duration=20.0, imu_rate=100.0, truth_rate=50.0, start_in_air=True
        )
    )


@pytest.fixture(scope="module")
def flight():
    return flown(0)


def renamed(flight, ids):
    """Return the flight with other anchor ids in its survey."""
    anchors = flight.anchors
    return replace(
        flight,
        anchors=Anchors(ids, anchors.positions[: len(ids)], anchors.orientations[: len(ids)]),
    )


def test_a_right_survey_has_no_remark(flight):
    assert list(survey_remarks(flight)) == []


def test_missing_anchors_are_named(flight):
    (remark,) = survey_remarks(renamed(flight, [0, 1, 2, 3, 4, 5, 6]))
    assert "no anchor 7: " in remark and "% of the TDOAs" in remark


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "said"), [(0, "does not fit"), (2, "of another room")])
def test_the_survey_of_another_room_is_blamed_and_no_sign(seed, said):
    """With wrong anchors, some pairs seem to have a wrong sign, and some ids seem exchanged."""
    (remark,) = survey_remarks(replace(flown(seed), anchors=constellation("staircase")))
    assert said in remark


def test_no_common_anchor_is_an_error(flight):
    with pytest.raises(
        InputError,
        match="hears anchors 0, 1, .* the survey has 100, .* give the survey of that room",
    ):
        list(survey_remarks(renamed(flight, np.arange(8) + 100)))


@pytest.mark.slow
def test_measured_flights_have_no_remark(shared_data):
    folders = [shared_data / "flights" / "0426", shared_data / "util"]
    for pair in inputs.find_flights(folders, shared_data / "surveys")[::4]:
        assert list(survey_remarks(inputs.Reading().read(pair))) == []


@pytest.mark.slow
def test_evaluate_prints_remarks(flight, tmp_path, capsys):
    write_bag(renamed(flight, [0, 1, 2, 3, 4, 5, 6]), tmp_path / "f.bag")
    assert evaluate.main([str(tmp_path / "f.bag"), "--jobs", "1"]) == 0
    assert "the survey has no anchor 7" in capsys.readouterr().err
    write_bag(renamed(flight, np.arange(8) + 100), tmp_path / "g.bag")
    assert evaluate.main([str(tmp_path / "g.bag"), "--jobs", "1"]) == 2
    assert "give the survey of that room" in capsys.readouterr().err


@pytest.mark.slow
def test_diagnose_prints_remarks_first(flight, tmp_path, capsys, monkeypatch):
    write_bag(flight, tmp_path / "f.bag")
    other = replace(
        flight,
        name="other",
        anchors=Anchors.from_positions(flight.anchors.positions + [0.0, 1.0, 0.0]),
    )
    write_bag(other, tmp_path / "g.bag")

    def stop(*args):
        raise InputError("far enough.")

    monkeypatch.setattr(diagnosis, "diagnose", stop)
    assert (
        diagnose.main(
            [str(tmp_path / "f.bag"), str(tmp_path / "g.bag"), "--out", str(tmp_path / "out")]
        )
        == 2
    )
    assert "have different surveys: the same ids are up to 1.00 m apart" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name, key", [("anchor_delay", "33"), ("pair_offset", "0-33"), ("nlos", "33.delay")]
)
def test_inject_refuses_an_anchor_that_is_not_there(flight, tmp_path, name, key, capsys):
    write_bag(flight, tmp_path / "f.bag")
    value = f"{key}=0.4" if name != "nlos" else "33.delay=0.4 33.start=1 33.end=5"
    words = [
        str(tmp_path / "f.bag"),
        "--effect",
        name,
        "--value",
        *value.split(),
        "--out",
        str(tmp_path / "late.bag"),
    ]
    assert inject.main(words) == 2
    assert "has no anchor 33; it has 0, 1, 2" in capsys.readouterr().err
    assert not (tmp_path / "late.bag").exists()
