# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of faults in closed loop: what a fault changes, and that the vehicle obeys what the
status would be.
"""

import numpy as np
import pytest

from studies.faults.flown import BEGIN, END, FAULTS, FaultyFilter, flown, table
from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_tools.flying.trial import Task, Trial
from uwb_tdoa_tools.flying.world import world_of

SAMPLES = 20


def readings(t):
    """Streams of a tenth of a second that begins at t, s."""
    times = t + np.arange(SAMPLES) / 200.0
    rng = np.random.default_rng(0)
    tdoa = Tdoas(
        times, rng.integers(0, 4, SAMPLES), rng.integers(4, 8, SAMPLES), rng.normal(size=SAMPLES)
    )
    imu = Imu(times, np.zeros((SAMPLES, 3)), np.tile([0.0, 0.0, 9.81], (SAMPLES, 1)))
    return {"imu": imu, "tdoa": tdoa}


def taken(name, t):
    """The streams that the filter of a flight with such a fault takes, of `readings`."""
    source = FaultyFilter(Trial(Task(world_of("hall"), 1)).source, FAULTS[name])
    source._now = t
    return {stream: source._changed(stream, part) for stream, part in readings(t).items()}


@pytest.mark.parametrize(
    "name", [name for name in FAULTS if name != "nothing" and not FAULTS[name].sensors]
)
def test_a_fault_changes_its_stream_while_it_lasts_and_no_other(name):
    before, during = taken(name, BEGIN - 0.5), taken(name, BEGIN + 0.1)
    for stream in ("imu", "tdoa"):
        np.testing.assert_equal(vars(before[stream]), vars(readings(BEGIN - 0.5)[stream]))
        same = [
            np.array_equal(column, vars(readings(BEGIN + 0.1)[stream])[key])
            for key, column in vars(during[stream]).items()
        ]
        assert all(same) == (stream != FAULTS[name].stream)
    assert BEGIN < END


@pytest.mark.slow
def test_a_vehicle_lands_beside_one_wrong_stamp_and_sinks_where_the_status_says_so():
    lands, sinks = (
        flown(("tdoa: one stamp 5 s ahead", 5001)),
        flown(("tdoa: two ids exchanged", 5001)),
    )
    assert lands["landed"] and lands["safe"] and lands["said"] == ""
    assert (
        not sinks["landed"]
        and sinks["reported_lost"] is not None
        and "two anchors are exchanged" in sinks["said"]
    )
    assert "| tdoa: one stamp 5 s ahead | 1 | 1 | 1 | nothing |" in table([lands, sinks])
