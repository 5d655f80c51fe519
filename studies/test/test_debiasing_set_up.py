# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of maps of the bias in a simulated set-up."""

import numpy as np
import pytest

from studies.debiasing import set_up
from studies.debiasing.report import set_up_tables
from uwb_tdoa_tools.simulation import SimulationConfig


def stay(place, seed=0, number=0, **fields):
    return set_up.measure(
        (number, {"trajectory": "hover", "place": place, "duration": 5.0, **fields}), seed
    )


def test_grids_are_those_of_the_paper():
    calibration, validation = set_up.grid(-2.0, 2.0, 0.5), set_up.grid(-1.75, 1.75, 0.5)
    assert (
        len(calibration) == 81 - 4 and len(validation) == 64 - 4
    )  # none within half a metre of the four anchors
    nearest = np.linalg.norm(calibration[:, None] - validation, axis=2).min(axis=0)
    np.testing.assert_allclose(nearest[[0, 30, -1]], 0.25 * np.sqrt(2.0))


def test_the_height_is_known_and_nothing_else_is_disturbed(monkeypatch):
    monkeypatch.setattr(SimulationConfig, "anchor_delay_std", 0.0)
    measured = stay((0.5, -1.0), bias=False, outlier_probability=0.0)
    error = (measured.p - measured.true).mean(axis=0)
    np.testing.assert_allclose(
        measured.true, np.tile([0.5, -1.0, 0.2], (len(measured.t), 1)), atol=1e-9
    )
    assert np.abs(error).max() < 0.03


def test_delays_belong_to_the_seed_and_noise_to_the_run():
    first, again, other = stay((1.0, 1.0)), stay((1.0, 1.0), number=1), stay((1.0, 1.0), seed=1)
    bias = [(one.p - one.true).mean(axis=0) for one in (first, again, other)]
    assert not np.array_equal(first.p, again.p)
    assert np.linalg.norm(bias[0] - bias[1]) < 0.02 < np.linalg.norm(bias[0] - bias[2])


@pytest.mark.slow
def test_all_of_it_on_a_coarser_grid(monkeypatch):
    for name, value in {"STEP": 1.0, "STAY": 2.0, "PASSES": 1, "RAILS": set_up.RAILS[::3]}.items():
        monkeypatch.setattr(set_up, name, value)
    figures, found, maps = set_up.copied(seed=3, jobs=1)
    validation = figures["static"]["validation"]
    assert validation["static, thin_plate"]["both"] < 0.3 * validation["before"]["both"]
    for row in figures["square"].values():
        assert row["static, thin_plate"] < row["before"]
    assert set_up_tables(figures).count("\n") > 20
