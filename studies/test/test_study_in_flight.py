# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of the nodes' reports in flight: its table, and the part of a flight that is played."""

from checking_flights import recording
import numpy as np
import pytest

from studies.checking.in_flight import BOOT, EVERY, line, middle


def test_a_row_says_what_was_found_or_what_was_said():
    sign = {
        "mistake": "sign",
        "texts": {"running": 2, "z: y": 3},
        "rules": {"tdoa_sign": 3, "gap": 1},
    }
    assert line(sign) == "| sign of all TDOAs | `tdoa_sign` | `gap`, `tdoa_sign` |"
    assert line({**sign, "rules": {}}).endswith("| z |")
    assert (
        line({"mistake": "nothing", "texts": {"running": 9}, "rules": {}})
        == "| nothing |  | running |"
    )


def test_the_middle_of_a_flight():
    whole = recording()
    part = middle(whole, 10.0)
    assert part.tdoa.t[0] >= BOOT and np.ptp(part.tdoa.t) == pytest.approx(10.0, abs=0.1)
    assert (
        len(part.imu) == pytest.approx(10.0 * 400.0 / EVERY, abs=2)
        and np.isin(part.imu.gyro, whole.imu.gyro).all()
    )
