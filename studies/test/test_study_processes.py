# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The second generator of effects: what it draws, and that the search has no part in it."""

import ast
from pathlib import Path

from known_effects import clean_flight
import numpy as np
import pytest

from studies.diagnosis import processes
from studies.diagnosis.claims import truth_of


@pytest.fixture(scope="module")
def flight():
    return clean_flight(1003, 30.0)


@pytest.fixture(scope="module")
def drawn(flight):
    return [processes.draw(seed, flight) for seed in range(60)]


@pytest.mark.slow
def test_a_seed_is_an_effect_and_all_kinds_are_drawn(flight, drawn):
    again = processes.draw(3, flight)
    assert again.name == drawn[3].name
    np.testing.assert_array_equal(again.inject(flight).tdoa.d, drawn[3].inject(flight).tdoa.d)
    assert {one.shape for one in drawn} == set(processes.KINDS)
    assert {one.stream for one in drawn} == set(processes.STREAMS)
    assert {len(one.covariates) for one in drawn} == {1, 2}


def test_an_effect_changes_its_own_part_alone(flight, drawn):
    for one in drawn:
        after = one.inject(flight)
        tdoa, gyro, accel = (
            after.tdoa.d - flight.tdoa.d,
            after.imu.gyro - flight.imu.gyro,
            after.imu.accel - flight.imu.accel,
        )
        changed = {
            name: np.any(part) for name, part in zip(("tdoa", "gyro", "accel"), (tdoa, gyro, accel))
        }
        assert {name for name, any_ in changed.items() if any_} <= {one.stream}
        if one.subset == "anchor":
            of_it = np.isin(flight.tdoa.a, one.who) | np.isin(flight.tdoa.b, one.who)
            assert not tdoa[~of_it].any()
        assert truth_of(one, flight).covariates == one.covariates


def test_the_size_of_a_function_is_its_power(flight, drawn):
    u = np.linspace(0.0, 1.0, 2000)[:, None]
    for one in drawn:
        if len(one.covariates) == 1:
            assert np.std(one.function(u)) == pytest.approx(1.0, abs=0.1)


def test_it_shares_no_code_with_the_search():
    imported = [
        node.module or ""
        for node in ast.walk(ast.parse(Path(processes.__file__).read_text()))
        if isinstance(node, ast.ImportFrom)
    ]
    assert not any("uwb_tdoa_tools" in module or "smooth_term" in module for module in imported)


def test_what_recurs_does_not_end_and_other_functions_are_held(drawn):
    later = np.linspace(1.0, 2.0, 500)
    for one in drawn:
        if len(one.covariates) == 1:
            low, high = one.limits
            course = one.course(low + (high - low) * later)
            assert (np.ptp(course) > one.size) == (one.shape in processes.RECURRING)
