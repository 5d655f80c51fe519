"""What `check` says of recordings with distances to anchors, beside TDOAs or without them."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.checking.check import check, sensors
from uwb_tdoa_tools.checking.recording import of_flight, read_recording
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

NONE = Tdoas(*(np.empty(0, kind) for kind in (float, int, int, float)))


@pytest.fixture(scope="module")
def ranged():
    """A Flight of ranges alone."""
    config = SimulationConfig(
        duration=20.0, imu_rate=200.0, truth_rate=20.0, start_in_air=True, range_noise=0.1
    )
    return replace(simulate(config), tdoa=NONE)


def test_sound_ranges_without_tdoas_are_no_mistake(ranged):
    report = check(of_flight(ranged))
    assert not report.faulty and report.facts["range"] == "ranges 100 Hz"


def test_millimetres_are_named(ranged):
    wrong = replace(ranged, range=replace(ranged.range, d=1000.0 * ranged.range.d))
    assert "range_unit" in {finding.rule for finding in check(of_flight(wrong)).findings}
    assert [finding.rule for finding in sensors(of_flight(wrong))][:1] == ["range_unit"]


def test_a_bag_of_ranges_alone_is_read_and_checked(ranged, tmp_path):
    write_bag(ranged, tmp_path / "ranged.bag")
    back = read_bag(tmp_path / "ranged.bag")
    assert len(back.tdoa) == 0
    for one, other in zip(back.range.columns, ranged.range.columns):
        np.testing.assert_array_equal(one, other)
    made = read_recording(Reading(), tmp_path / "ranged.bag")
    assert len(made.sensors["range"]) == len(ranged.range) and not check(made).faulty
