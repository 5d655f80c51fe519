# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages that the definition of a sensor names: their types and fields."""

from dataclasses import replace
import re

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS, Pressure
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.bags.messages import check_messages, sensor_messages
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

OLD = SENSORS["pressure"]
STREAM = Pressure(np.arange(3.0), np.full(3, 1e5))
TWIST = "geometry_msgs/msg/TwistStamped"


@pytest.mark.parametrize("name", SENSORS)
def test_the_messages_of_every_sensor_have_its_fields(name):
    check_messages(SENSORS[name], typestore())


@pytest.mark.parametrize(
    "message, field, count, text",
    [
        ("sensor_msgs/msg/FluidPresure", "x", 1, "`message`: there is no type sensor_msgs/msg/Fl"),
        ("std_msgs/msg/Float64", "data", 1, "`message`: std_msgs/msg/Float64 has no header"),
        (TWIST, "twist.linear.w", 1, f"`fields`: {TWIST} has no field twist.linear.w: 'w' is none"),
        (TWIST, "twist.linaer.x", 1, "'linaer' is none of linear, angular"),
        (TWIST, "twist.linear.x.y", 1, "no field is before 'y'"),
        (
            TWIST,
            "twist.linear",
            1,
            "twist.linear of geometry_msgs/msg/TwistStamped holds 3 numbers",
        ),
        (TWIST, "twist.linear.x", 3, "holds 1 numbers, not 3"),
        (TWIST, "twist", 2, "twist of geometry_msgs/msg/TwistStamped does not hold numbers alone"),
        (TWIST, "header.frame_id", 1, "does not hold numbers alone"),
    ],
)
def test_a_wrong_type_or_field_of_messages_is_named(message, field, count, text):
    wrong = replace(OLD, message=message, fields={field: count})
    with pytest.raises(InputError, match=re.escape(text)):
        check_messages(wrong, typestore())


def test_a_bag_is_not_written_with_a_wrong_field(tmp_path, monkeypatch):
    flight = simulate(SimulationConfig(duration=16.0, pressure_noise=0.1))
    wrong = replace(OLD, fields={"fluid_presure": 1})
    monkeypatch.setitem(SENSORS, "pressure", wrong)
    with pytest.raises(
        InputError, match="sensor pressure, `fields`: .* has no field fluid_presure"
    ):
        write_bag(flight, tmp_path / "sim.bag")
    assert not (tmp_path / "sim.bag").exists()


def test_a_bag_is_not_read_with_a_wrong_field(tmp_path, monkeypatch):
    write_bag(simulate(SimulationConfig(duration=16.0, pressure_noise=0.1)), tmp_path / "sim.bag")
    monkeypatch.setitem(SENSORS, "pressure", replace(OLD, fields={"fluid_presure": 1}))
    with pytest.raises(
        InputError, match="sensor pressure, `fields`: .* has no field fluid_presure"
    ):
        read_bag(tmp_path / "sim.bag")


def test_a_field_that_is_written_but_not_read_is_named_by_the_simulation(monkeypatch):
    wrong = replace(OLD, content=lambda of: {"variance": of.pressure})
    monkeypatch.setitem(SENSORS, "pressure", wrong)
    with pytest.raises(InputError, match="sensor pressure, `content`: it writes variance"):
        simulate(SimulationConfig(duration=16.0, pressure_noise=0.1))


def test_a_field_that_is_written_wrongly_is_named():
    wrong = replace(OLD, content=lambda of: {"fluid_presure": of.pressure})
    with pytest.raises(
        InputError, match="sensor pressure, `content`: .* has no field fluid_presure"
    ):
        next(sensor_messages(wrong, STREAM, typestore()))
    wide = replace(OLD, content=lambda of: {"fluid_pressure": np.ones((3, 2))})
    with pytest.raises(InputError, match="`content`: .* holds 1 numbers, not 2"):
        next(sensor_messages(wide, STREAM, typestore()))
