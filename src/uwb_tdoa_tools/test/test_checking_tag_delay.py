"""Ranges that are all too long or too short: the antenna delay of the tag."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.checking.recording_rules import tag_delay, window_offsets
from uwb_tdoa_tools.simulation import SimulationConfig, simulate


@pytest.fixture(scope="module", params=["sines", "circle"])
def ranged(request):
    """A Flight of ranges alone, without systematic errors."""
    config = SimulationConfig(
        seed=7,
        trajectory=request.param,
        duration=20.0,
        imu_rate=100.0,
        truth_rate=20.0,
        range_noise=0.1,
        bias=False,
        multipath=False,
    )
    return replace(simulate(config), tdoa=Tdoas(*np.empty((4, 0))))


def longer(flight, by):
    return replace(flight, range=replace(flight.range, d=flight.range.d + by))


@pytest.mark.parametrize("by", [0.25, -0.2])
def test_what_all_ranges_are_wrong_by_is_told(ranged, by):
    (found,) = tag_delay(of_flight(longer(ranged, by)))
    assert found.severity == "note" and found.value == pytest.approx(by, abs=0.03)
    assert ("too long" if by > 0.0 else "too short") in found.cause
    report = check(of_flight(longer(ranged, by)))
    assert not report.faulty and "tag_delay" in {finding.rule for finding in report.findings}


def test_nothing_is_said_of_sound_ranges_nor_of_a_tape_of_ten_centimetres(ranged):
    assert not [*tag_delay(of_flight(ranged))]
    shaken = ranged.anchors.positions + 0.1 * np.random.default_rng(3).standard_normal(
        ranged.anchors.positions.shape
    )
    assert not [*tag_delay(of_flight(replace(ranged, anchors=ranged.anchors.at(shaken))))]


def test_outliers_and_what_is_no_range_tell_nothing(ranged):
    rng, d = np.random.default_rng(0), longer(ranged, 0.25).range.d
    d = np.where(rng.random(len(d)) < 0.1, d + rng.exponential(2.0, len(d)), d)
    d[::50] = np.nan
    (found,) = tag_delay(of_flight(replace(ranged, range=replace(ranged.range, d=d))))
    assert found.value == pytest.approx(0.25, abs=0.08)


def test_where_nothing_tells_nothing_is_said(ranged):
    offsets = window_offsets(ranged.range, ranged.anchors.only(np.arange(4)))  # as many as unknowns
    assert len(offsets) == 0
    flat = ranged.anchors.at(ranged.anchors.positions * [1.0, 1.0, 0.0])
    assert np.isfinite(window_offsets(ranged.range, flat)).all()
    assert not [*tag_delay(of_flight(replace(ranged, range=None)))]
    millimetres = replace(ranged.range, d=1000.0 * ranged.range.d)
    assert not [*tag_delay(of_flight(replace(ranged, range=millimetres)))]
