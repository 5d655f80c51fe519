"""Faults that are put into flights, and what is counted of them."""

from known_effects import clean_flight
import numpy as np
import pytest

from studies.diagnosis import faults
from studies.diagnosis.faults import FAULTS

STREAMS = ("tdoa", "imu", "truth")


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 20.0)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_changes_the_stream_that_it_is_of_and_no_stamp_falls(flight, name):
    changed = FAULTS[name].put_in(flight, np.random.default_rng(2))
    again = FAULTS[name].put_in(flight, np.random.default_rng(2))
    touched = []
    for stream in STREAMS:
        before, after, twin = (vars(getattr(one, stream)) for one in (flight, changed, again))
        assert all(np.array_equal(after[key], twin[key]) for key in after)
        assert (np.diff(after["t"]) >= 0.0).all() and len({len(column) for column in after.values()}) == 1
        if not all(np.array_equal(after[key], before[key]) for key in after):
            touched.append(stream)
    assert touched == ["truth" if FAULTS[name].of_truth else "imu" if FAULTS[name].inertial else "tdoa"]


def test_faults_of_one_pair_leave_the_others(flight):
    changed = FAULTS["pair_clipped"].put_in(flight, np.random.default_rng(2)).tdoa
    hit = changed.d != flight.tdoa.d
    assert hit.any() and len(set(zip(changed.a[hit], changed.b[hit]))) == 1


def test_figures_count_what_costs_or_spoils_the_truth():
    rows = [("tdoa_sign", True, 2.0), ("tdoa_sign", False, 0.03), ("tdoa_sign", False, 0.01), ("truth_hole", True, None)]
    found = faults.figures([{"fault": name, "named": named, "cost": cost} for name, named, cost in rows])
    assert (found["draws"], found["that cost 2 cm, or are of the truth"]) == (4, 3)
    assert found["of these named"] == pytest.approx(2 / 3, abs=1e-3)
    assert found["by fault"]["tdoa_sign"] == "1 of 3, costly 1 of 2, cost 1.0 to 200.0 cm"
