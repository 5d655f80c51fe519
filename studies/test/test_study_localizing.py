# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of how far trajectories are to be believed."""

import numpy as np
import pytest

from studies import calibrating, localizing
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

pytestmark = pytest.mark.slow  # runs a study


def test_verdicts_are_compared_with_what_is_true(tmp_path, monkeypatch):
    monkeypatch.setattr(
        localizing,
        "MISTAKES",
        {name: localizing.MISTAKES[name] for name in ("sign", "in_g", "another_room")},
    )
    flight = simulate(
        SimulationConfig(
            seed=1, duration=14.0, floor_time=1.0, imu_rate=100.0, bias=False, multipath=False
        )
    )
    write_bag(flight, tmp_path / "flight.bag")
    plain, sign, in_g = localizing.judge((tmp_path / "flight.bag", None), Reading(), mistakes=True)
    assert (plain["mistake"], plain["verdict"], plain["within"]) == (
        "nothing",
        "good",
        True,
    ) and plain["rmse"] < 0.2
    assert (sign["mistake"], sign["verdict"], sign["within"]) == ("sign", "bad", False)
    assert in_g["mistake"] == "in_g" and in_g["verdict"] == "bad"
    assert localizing.summary([plain, sign, in_g]).split(" | ")[:3] == ["1", "1", "2"]


def test_ratios_of_draws():
    draws = [
        {"offered": True, "before": 0.2, "after": 0.1, "had_it_been": 0.1},
        {"offered": False, "before": 0.2, "after": 0.2, "had_it_been": 0.3},
    ]
    assert calibrating.summary(draws) == "1 | 0.200 | 0.150 | 0.75 | 1.00 | 1.50"
    assert np.isfinite([len(some) for some in calibrating.SETS]).all()
