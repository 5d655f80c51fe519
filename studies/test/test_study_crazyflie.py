# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measured logs over the link of a Crazyflie."""

from dataclasses import replace

import pytest

from studies.crazyflie import table
from uwb_tdoa_tools.readers import inputs

pytestmark = pytest.mark.slow


def test_measured_logs_lose_little(shared_data):
    flights = inputs.Reading(shared_data / "surveys").flights([shared_data / "flights" / "0426"])
    tdoa2 = [f for f in flights if f.meta["protocol"] == "tdoa2"][:2]
    lines = list(table([replace(f, extra={}) for f in tdoa2]))[2:]
    direct, *others, naive = (float(line.split("|")[4]) for line in lines)
    assert all(error < direct + 0.02 for error in others) and naive > min(others)
