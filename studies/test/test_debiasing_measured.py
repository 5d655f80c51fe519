# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of maps of the bias on measured flights."""

import pytest

from studies import __main__ as study
from studies.debiasing import measured
from studies.debiasing.report import measured_tables
from studies.diagnosis.measured import SPLITS
from uwb_tdoa_tools.readers import inputs


def test_no_flight_is_fitted_to_and_judged():
    for name, (_, to_fit, to_judge) in measured.cases().items():
        assert to_fit and to_judge and not set(to_fit) & set(to_judge), name


def test_height_and_pressure_are_left_out(shared_data):
    path = SPLITS["0425 a"][0][0]
    (flight,) = inputs.Reading(shared_data / "surveys").flights([shared_data / path])
    assert flight.height is not None and flight.pressure is not None
    flown = measured.flown(shared_data, path, None)[0]
    assert flown.height is None and flown.pressure is None


@pytest.mark.slow
def test_a_map_of_some_flights_makes_others_better(shared_data, monkeypatch):
    to_fit, to_judge = SPLITS["0426 b"]
    monkeypatch.setattr(measured, "cases", lambda: {"0426": (None, to_fit[:3], to_judge[:2])})
    (case,) = measured.judged(shared_data, jobs=1)
    before, after = (
        sum(row[name]["rmse"] for row in case["runs"]) for name in ("before", "thin plate")
    )
    assert after < 0.8 * before
    assert all(row["thin plate"]["rmse"] < row["before"]["rmse"] for row in case["runs"])
    assert "| 0426 | 2 |" in measured_tables([case])


def test_without_diagnosed_effects_it_says_where_they_come_from(tmp_path, capsys):
    arguments = [
        "--data",
        str(tmp_path),
        "--diagnosed",
        str(tmp_path),
        "--out",
        str(tmp_path / "out"),
    ]
    assert study.main(["debias-measured", *arguments]) == 2
    assert "no */effects.yaml; run `study diagnosis measured --out" in capsys.readouterr().err
