# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Log variables of a Crazyflie become streams.

studies/test/test_study_crazyflie.py runs the example node.
"""

from importlib.util import find_spec
import runpy

from documented import ROOT
from hypothesis import assume, given, settings, strategies as st
import numpy as np
import pytest

from uwb_tdoa_tools.crazyflie import (
    FORCES,
    GRAVITY,
    HEIGHT,
    PERIOD,
    PRESSURE,
    RATES,
    WRAP,
    LogBlock,
    VehicleClock,
)


def test_a_value_is_a_measurement_once():
    block = LogBlock(["stateEstimate.z", "tdoa2.d7-0", "tdoa2.d0-1"])
    first = [(pytest.approx(1.0 - PERIOD / 2), 0, 1, 0.5)]  # tdoa2.d7-0 is 0: never received
    assert block.take(1000, [1.0, 0.0, 0.5]) == (first, None)
    assert block.take(1010, [1.0, -2.0, 0.5]) == (
        [(pytest.approx(1.01 - PERIOD / 2), 7, 0, -2.0)],
        None,
    )
    assert block.take(1020, [1.0, -2.0, 0.5]) == ([], None)
    assert block.take(1030, [1.0, float("nan"), 0.25])[0][0][3] == 0.25


def test_inertial_samples_are_in_si_units_whatever_their_order():
    names = [*FORCES, "pm.vbat", *RATES]
    tdoas, (t, gyro, accel) = LogBlock(names).take(2500, [0.0, 0.5, 1.0, 3.9, 180.0, 0.0, -90.0])
    assert tdoas == [] and t == 2.5
    np.testing.assert_allclose(gyro, [np.pi, 0.0, -np.pi / 2])
    np.testing.assert_allclose(accel, [0.0, 0.5 * GRAVITY, GRAVITY])
    assert LogBlock(RATES).take(0, [1.0, 2.0, 3.0]) == ([], None)  # half an IMU sample is not used


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.0, 0.05), min_size=2, max_size=60), st.floats(-1e4, 1e9))
def test_the_clock_is_off_by_the_least_delay_and_never_runs_back_far(delays, offset):
    clock = VehicleClock()
    for k, delay in enumerate(delays):
        t = PERIOD * k
        stamped = clock.stamp(t, t + offset + delay)
        assert stamped <= t + offset + delay + 1e-6
        assert stamped >= t + offset - 1e-6


@given(st.floats(0.0, 0.05), st.floats(-1e3, 1e9), st.integers(1, 3))
def test_the_clock_goes_on_when_the_time_of_the_vehicle_wraps(delay, offset, wraps):
    """The time has 24 bits, in ms: it wraps after 4.7 hours."""
    clock = VehicleClock()
    for t in np.linspace(0.0, wraps * WRAP, 200):
        assert clock.stamp(t % WRAP, t + offset + delay) == pytest.approx(
            t + offset + delay, abs=1e-5
        )


@given(st.floats(10.0, WRAP - 1.0), st.floats(5.0, 60.0))
def test_the_clock_begins_anew_with_a_vehicle_that_was_switched_on_again(before, off):
    """After the first message at the latest, stamps equal arrival times."""
    # A longer pause is indistinguishable from a wrap while switched off. A new link starts a new
    # clock.
    assume(before + off + 1.0 < WRAP)
    clock, now = VehicleClock(), 1e9
    for t in (before - 0.02, before - 0.01, before):
        clock.stamp(t, now + t)
    back = now + before + off
    for t in (0.5, 0.51, 0.52):
        assert clock.stamp(t, back + t) == pytest.approx(back + t, abs=1e-5)


def test_a_stalled_link_does_not_move_the_clock():
    clock = VehicleClock()
    for t in np.arange(0.0, 2.0, PERIOD):
        clock.stamp(t, 100.0 + t)
    stalled = [clock.stamp(t, 105.0) for t in np.arange(2.0, 5.0, PERIOD)]  # all arrive at once
    np.testing.assert_allclose(stalled, 100.0 + np.arange(2.0, 5.0, PERIOD), atol=0.01)


@pytest.mark.parametrize("no_target", [32000, 32767, 65535])
def test_heights_and_pressures_are_in_si_units_and_come_once(no_target):
    block = LogBlock([PRESSURE, "pm.vbat", HEIGHT], 2 * PERIOD)
    t = pytest.approx(1.0 - PERIOD)
    first = [("height", t, pytest.approx(1.25)), ("pressure", t, pytest.approx(95012.5))]
    assert block.take_sensors(1000, [950.125, 3.9, 1250]) == first
    assert block.take_sensors(1020, [950.125, 3.9, 1250]) == []
    ((stream, _, height),) = block.take_sensors(1040, [950.125, 3.9, no_target])
    assert stream == "height" and np.isinf(height)


@pytest.mark.slow
def test_the_example_says_what_is_missing():
    pytest.importorskip("rclpy")
    pytest.importorskip("uwb_tdoa_msgs.msg")
    if find_spec("crazyflie_interfaces"):
        pytest.skip("crazyswarm2 is installed")
    with pytest.raises(SystemExit, match="install crazyswarm2"):
        runpy.run_path(str(ROOT / "docs" / "connect" / "crazyflie_node.py"), run_name="__main__")
