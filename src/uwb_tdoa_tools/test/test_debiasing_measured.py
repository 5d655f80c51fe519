import pytest

from uwb_tdoa_tools.studies.debiasing import measured
from uwb_tdoa_tools.debiasing.report import measured_tables
from uwb_tdoa_tools.studies.diagnosis.measured import SPLITS


def test_no_flight_is_fitted_to_and_judged():
    for name, (_, to_fit, to_judge) in measured.cases().items():
        assert to_fit and to_judge and not set(to_fit) & set(to_judge), name


@pytest.mark.slow
def test_a_map_of_some_flights_makes_others_better(shared_data, monkeypatch):
    to_fit, to_judge = SPLITS["0426 b"]
    monkeypatch.setattr(measured, "cases", lambda: {"0426": (None, to_fit[:3], to_judge[:2])})
    (case,) = measured.run(shared_data, jobs=1)
    before, after = (sum(row[name]["rmse"] for row in case["runs"]) for name in ("before", "thin plate"))
    assert after < 0.8 * before
    assert all(row["thin plate"]["rmse"] < row["before"]["rmse"] for row in case["runs"])
    assert "| 0426 | 2 |" in measured_tables([case])
