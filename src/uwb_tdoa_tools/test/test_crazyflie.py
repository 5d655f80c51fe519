"""Log variables of a Crazyflie to streams; studies/test/test_study_radio_link.py runs the example
node around that.
"""

import subprocess
import sys

from documented import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_tools.crazyflie import FORCES, GRAVITY, PERIOD, RATES, LogBlock, VehicleClock


def test_a_value_is_a_measurement_once():
    block = LogBlock(["stateEstimate.z", "tdoa2.d7-0", "tdoa2.d0-1"])
    first = [(pytest.approx(1.0 - PERIOD / 2), 0, 1, 0.5)]  # the other is 0: never received
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
    assert LogBlock(RATES).take(0, [1.0, 2.0, 3.0]) == ([], None)  # half an IMU is none


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.0, 0.05), min_size=2, max_size=60), st.floats(-1e4, 1e9))
def test_the_clock_is_off_by_the_least_delay_and_never_runs_back_far(delays, offset):
    clock = VehicleClock()
    for k, delay in enumerate(delays):
        t = PERIOD * k
        stamped = clock.stamp(t, t + offset + delay)
        assert stamped <= t + offset + delay + 1e-6
        assert stamped >= t + offset - 1e-6


def test_the_example_says_what_is_missing():
    pytest.importorskip("rclpy")
    pytest.importorskip("uwb_tdoa_msgs.msg")
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "connect" / "crazyflie_node.py"],
        capture_output=True,
        text=True,
        timeout=180,
    )
    if "crazyflie_interfaces" not in done.stderr:
        pytest.skip("crazyswarm2 is installed")
    assert (
        done.returncode == 1
        and done.stderr.count("\n") == 1
        and "install crazyswarm2" in done.stderr
    )
