# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Innovations that a filter leaves unexplained.

Feeding in blocks gives the same result. It is left out once it certainly exceeds the limit.
"""

from flights import fly, without_tdoas
import numpy as np
import pytest

from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import TDOA, imu_rows, structured
from uwb_tdoa_ekf.monitoring.explain import Unexplained, unexplained
from uwb_tdoa_ekf.offline import run_offline

FLIGHT = fly(0, 14.0)


def rows_of(flight, sign=1.0):
    tdoa, anchors = flight.tdoa, flight.anchors
    return structured(TDOA, tdoa.t, anchors.index(tdoa.a), anchors.index(tdoa.b), sign * tdoa.d)


@pytest.mark.parametrize("use_imu", [False, True])
def test_it_is_what_a_run_leaves_to_the_bit(use_imu):
    config = FilterConfig(use_imu=use_imu)
    samples, usable = imu_rows(FLIGHT.imu.t, FLIGHT.imu.gyro, FLIGHT.imu.accel)
    given = (samples[usable], config) if use_imu else ()
    run = run_offline(FLIGHT, config).residuals
    found = unexplained(rows_of(FLIGHT), FLIGHT.anchors.positions, *given)
    assert found == Unexplained.of(run.t, run.innovation) and len(found.blocks) == 6


def test_nothing_is_left_out_up_to_the_limit():
    rows, positions = rows_of(FLIGHT, -1.0), FLIGHT.anchors.positions
    whole = unexplained(rows, positions)
    assert unexplained(rows, positions, limit=whole.mean) == whole
    assert unexplained(rows, positions, limit=0.999 * whole.mean) == Unexplained({})


def test_no_tdoas_and_few_leave_no_block():
    few = rows_of(FLIGHT)[:: len(FLIGHT.tdoa) // 20]
    for rows in (rows_of(without_tdoas(FLIGHT)), few):
        for limit in (0.0, np.inf, np.nan):
            assert unexplained(rows, FLIGHT.anchors.positions, limit=limit) == Unexplained({})
