# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Ranges against the bound of one round."""

import numpy as np
import pytest

from studies import ranges, survey_ranges
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.scoring.evaluation import evaluate


@pytest.fixture(scope="module")
def flight():
    return ranges.flown(1)


def test_the_bound_of_ranges_is_that_of_their_geometry(flight):
    """At a place, it is the inverse of the information in the directions to all anchors."""
    place = flight.truth.p[len(flight.truth) // 2]
    away = place - flight.anchors.positions
    unit = away / np.linalg.norm(away, axis=1, keepdims=True)
    of_place = np.sqrt(np.trace(np.linalg.inv(unit.T @ unit / ranges.STD**2)))
    assert ranges.bound_of(flight) == pytest.approx(of_place, rel=0.2)


@pytest.mark.parametrize("what", ranges.SETS)
def test_no_set_is_worse_than_the_bound_of_one_round(flight, what):
    row = evaluate(ranges.SETS[what](flight), FilterConfig())[0].row()
    assert row["rmse_3d"] < 1.2 * ranges.bound_of(flight)


def test_told_the_noise_both_are_better_than_each(flight):
    error = {
        what: evaluate(taken(flight), ranges.KNOWN)[0].row()["rmse_3d"]
        for what, taken in ranges.SETS.items()
    }
    assert error["both"] < 1.02 * min(error["ranges"], error["TDOAs"])


@pytest.mark.parametrize("name", [name for name in ranges.FAULTS if name != "sound"])
def test_faulty_ranges_do_no_harm_beside_tdoas(flight, name):
    wrong = ranges.spoiled(flight, ranges.FAULTS[name], 0)
    assert not all(np.array_equal(*both) for both in zip(wrong.range.columns, flight.range.columns))
    assert ranges.rmse(wrong) < 1.1 * ranges.rmse(flight.without("range")) + 0.005


def test_a_row_has_means_and_the_largest_ratio():
    rows = [{"rmse_3d": 0.1, "nees_mean": 1.0}, {"rmse_3d": 0.3, "nees_mean": 2.0}]
    assert (
        ranges.line("ranges", "defaults", rows, [0.2, 0.2])
        == "| ranges | defaults | 0.200 m | 0.200 m | 1.50 | 1.50 |"
    )


def test_late_errors_of_ranges_are_never_too_short(flight):
    for words, puts in survey_ranges.ERRORS.items():
        changed = flight
        for put in puts:
            changed = put(changed, 1)
        added = changed.range.d - flight.range.d
        assert bool(added.any()) == bool(puts)
        if "late" in words:
            assert (added >= 0.0).all() and added.max() < 0.8
    again = survey_ranges.of_place(0.1)
    np.testing.assert_array_equal(again(flight, 2).range.d, again(flight, 2).range.d)
