# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages that the definition of a sensor names: their types and fields."""

import numpy as np
import pytest

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_tools.bags.messages import STREAMS, typestore
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

TOPICS = [(name, kind) for name, sensor in SENSORS.items() for _, kind in sensor.topics]


@pytest.fixture(scope="module")
def flight():
    return simulate(SimulationConfig(duration=16.0, **{f"{name}_noise": 0.1 for name in SENSORS}))


@pytest.mark.parametrize("name, kind", TOPICS)
def test_messages_of_a_sensor_hold_what_is_read_from_them(name, kind, flight):
    sensor, stream = SENSORS[name], getattr(flight, name)
    assert kind in typestore().types, "`message` or `others`: check the spelling"
    of = STREAMS[name]._replace(message=kind)
    rows = np.array([of.row(it) for _, it in of.messages(stream, "base_link", typestore())])[:, 1:]
    assert rows.shape[1] == sum(sensor.fields.values()), "`fields`: another count of numbers"
    assert of.valid(rows).all(), "`sound` refuses what `simulated` returns"
    for one, other in zip(of.make(stream.t, rows).columns, stream.columns, strict=True):
        np.testing.assert_allclose(
            one, other, err_msg="`columns` reads something else than `content` writes"
        )
