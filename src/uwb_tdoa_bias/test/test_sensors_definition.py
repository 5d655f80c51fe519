# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mistakes in the definition of a new sensor: each is an error with sensor, attribute and remedy."""

from dataclasses import dataclass, fields, replace
import re
import sys
from types import ModuleType

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import SENSORS, Pressure, Stream
from uwb_tdoa_bias.common.sensors.definition import TAKEN, check, load
from uwb_tdoa_bias.common.sensors.sensor import check_rows, check_values, parameter

OLD = SENSORS["pressure"]
FLAG = parameter(True, "use it", fixed=True)
NEW = replace(OLD, name="sonar", parameters={"use_sonar": FLAG})
T = np.arange(3.0)


@dataclass(frozen=True)
class Empty(Stream):
    t: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class Mute(Empty):
    t: np.ndarray

    @property
    def values(self):
        return self.depth[:, None]


@dataclass(frozen=True)
class Pair(Mute):
    @property
    def values(self):
        return np.column_stack([self.depth, self.depth])

    def with_values(self, values):
        return replace(self, depth=values[:, 0])


@dataclass(frozen=True)
class Forgetful(Pressure):
    def with_values(self, values):
        replace(self, pressure=values[:, 0])


@dataclass(frozen=True)
class Late(Pressure):
    depth: np.ndarray
    t: np.ndarray


class Undecorated(Pressure):
    pass


@pytest.fixture
def registry(monkeypatch):
    """Return a function that makes modules of sensors, and returns what `load` does with them."""

    def module(name, **content):
        made = ModuleType(name)
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, name, made)

    def make(*sensors):
        for k, sensor in enumerate(sensors):
            module(f"trial_sensors.m{k}", **({"SENSOR": sensor} if sensor else {}))
        return load("trial_sensors", [f"m{k}" for k in range(len(sensors))])

    module("trial_sensors", __path__=[])
    return make


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"name": "wheel-speed"}, "`name`: use small letters"),
        ({"name": "tdoa"}, "`name`: a Flight has another field tdoa"),
        ({"topic": "imu/data"}, "`topic`: imu/data is in use"),
        (
            {"message": "sensor_msgs/FluidPressure"},
            "`message`: 'sensor_msgs/FluidPressure' has not",
        ),
        ({"fields": ["fluid_pressure"]}, "`fields`: give {field of the message: count"),
        ({"fields": {"fluid_pressure": 0}}, "`fields`: give {field of the message: count"),
        ({"measured": None}, "`measured`: this is no function"),
        ({"noise": 0.1}, "`noise`: give (unit, words, standard deviation)"),
        ({"noise": (0.1, "M", "write depths")}, "`noise`: give (unit, words, standard deviation)"),
        ({"rate": 0.0}, "`rate`: 0.0 is no rate. Give Hz, above 0"),
        ({"rate": None}, "`rate`: None is no rate"),
        ({"stream": dict}, "`stream`: give a class that inherits from Stream"),
        ({"stream": Undecorated}, "`stream`: put @dataclass(frozen=True) before Undecorated"),
        ({"stream": Late}, "`stream`: the first array of Late must be t"),
        ({"stream": Empty}, "`stream`: Empty has no `values`"),
        ({"stream": Mute}, "`stream`: Mute has no `with_values`"),
        ({"parameters": {}}, "`parameters`: the first parameter must be use_"),
        (
            {"parameters": {"sonar_std": FLAG}},
            "`parameters`: the first parameter must be use_sonar",
        ),
        ({"parameters": {"use_sonar": True}}, "`parameters`: make use_sonar with `parameter`"),
        (
            {"parameters": {"use_sonar": FLAG, "sonar_std": parameter(0.0, "m")}},
            "`parameters`: the default of sonar_std is outside of its limits",
        ),
        (
            {"parameters": {"use_sonar": FLAG, "sonar_std": parameter(2.0, "m", high=1.0)}},
            "`parameters`: the default of sonar_std is outside of its limits",
        ),
    ],
)
def test_a_wrong_attribute_is_named(changes, text):
    wrong = replace(NEW, **changes)
    with pytest.raises(InputError, match=re.escape(f"sensor {wrong.name}, {text}")):
        check(wrong)


def test_every_sensor_of_the_registry_is_well_defined():
    for sensor in (*SENSORS.values(), NEW):
        check(sensor)


def test_no_sensor_has_the_name_of_another_field_of_a_flight():
    assert set(TAKEN) == {each.name for each in fields(Flight)} - SENSORS.keys()


def test_names_that_exist_already_are_named(registry):
    other = replace(NEW, topic="sonar")
    assert list(registry(OLD, NEW)) == ["pressure", "sonar"]
    with pytest.raises(InputError, match="sensor pressure, `name`: pressure exists already"):
        registry(OLD, OLD)
    taken = replace(NEW, parameters=NEW.parameters | {"pressure_std": parameter(0.1, "m")})
    with pytest.raises(InputError, match="sensor sonar, `parameters`: pressure_std exists already"):
        registry(OLD, taken)
    with pytest.raises(InputError, match="sensor sonar, `topic`: pressure exists already"):
        registry(OLD, replace(other, topic="pressure"))


def test_a_module_that_is_missing_or_empty_is_named(registry):
    with pytest.raises(InputError, match="there is no file sonr.py in common/sensors"):
        load("trial_sensors", ["sonr"])
    with pytest.raises(InputError, match=r"trial_sensors\.m1 has no SENSOR"):
        registry(OLD, None)


@pytest.mark.parametrize(
    "columns, text",
    [
        (T, "it returns no tuple. Return a tuple with the arrays of Pressure without t: pressure"),
        ((T, T), "it returns 2 columns"),
        ((), "it returns 0 columns"),
        ((T[:2],), "pressure has the shape (2,), not one entry for each of 3 stamps"),
        ((1.0,), "pressure has the shape ()"),
    ],
)
def test_columns_of_another_form_are_named(columns, text):
    with pytest.raises(InputError, match=re.escape(f"sensor sonar, `simulated`: {text}")):
        NEW.stream_of("simulated", T, columns)
    with pytest.raises(InputError, match=re.escape(f"sensor sonar, `columns`: {text}")):
        replace(NEW, columns=lambda fields: columns).read(T, {})


def test_a_column_of_a_field_that_is_not_read_is_named():
    wrong = replace(NEW, columns=lambda fields: (fields["pressure"],))
    with pytest.raises(
        InputError, match="`columns`: 'pressure' is none of `fields`: fluid_pressure"
    ):
        wrong.read(T, {"fluid_pressure": T})


def test_columns_with_a_default_may_be_missing():
    sensor = SENSORS["velocity"]
    of_sensor = np.ones((3, 3))
    assert len(sensor.stream_of("simulated", T, (of_sensor, of_sensor))) == 3
    assert len(sensor.stream_of("simulated", T, (of_sensor, of_sensor, T, T))) == 3


def test_values_of_another_form_are_named():
    check_values(NEW.name, Pressure(T, T))
    with pytest.raises(InputError, match=re.escape("`values` has the shape (3, 1, 1), not (n, k)")):
        check_values(NEW.name, Pressure(T, T[:, None]))
    with pytest.raises(InputError, match="`values` has 2 columns. Effects change 1 value, or 3"):
        check_values(NEW.name, Pair(T, T))
    with pytest.raises(InputError, match="`with_values` returns NoneType. Return `replace"):
        check_values(NEW.name, Forgetful(T, T))


@pytest.mark.parametrize(
    "changes, text",
    [
        (
            {"content": lambda of: {"variance": of.pressure}},
            "`content`: it writes variance. From fluid_pressure, `columns` then reads another "
            "`pressure`. Check the names in `fields`, and write these fields in the unit that is read",
        ),
        ({"content": lambda of: {}}, "`content`: it writes nothing. From fluid_pressure"),
        (
            {"content": lambda of: {"fluid_pressure": 0.01 * of.pressure}},
            "`content`: it writes fluid_pressure. From fluid_pressure, `columns` then reads another",
        ),
        ({"content": lambda of: None}, "`content`: it returns NoneType. Return {field of the"),
        (
            {"content": lambda of: {"fluid_pressure": of.pressure[:, None]}},
            "`content`: fluid_pressure has the shape (3, 1), not (3,)",
        ),
        ({"columns": lambda fields: None}, "`columns`: it returns no tuple"),
        ({"sound": lambda fields: None}, "`sound`: return {field: bool} for fluid_pressure"),
        ({"sound": lambda fields: {}}, "`sound`: return {field: bool} for fluid_pressure"),
        (
            {"sound": lambda fields: {"fluid_pressure": True}},
            "`sound`: fluid_pressure has the shape (), not (3,), as its numbers",
        ),
        (
            {"sound": lambda fields: {"fluid_pressure": np.zeros(3, dtype=bool)}},
            "`simulated`: `sound` refuses some numbers of fluid_pressure. Return finite ones",
        ),
        (
            {"measured": lambda of: ({"value": of.values}, np.zeros(3, dtype=bool))},
            "`measured`: it takes none of the simulated measurements. Compare units",
        ),
        (
            {"measured": lambda of: ({"value": np.nan * of.values}, np.ones(3, dtype=bool))},
            "`measured`: a usable `value` is not finite. Refuse it in usable",
        ),
        ({"measured": lambda of: None}, "`measured`: return two things"),
    ],
)
def test_a_simulated_stream_that_cannot_be_written_read_or_measured_is_named(changes, text):
    NEW.check_simulated(Pressure(T, np.full(3, 1e5)))
    with pytest.raises(InputError, match=re.escape(f"sensor sonar, {text}")):
        replace(NEW, **changes).check_simulated(Pressure(T, np.full(3, 1e5)))


@pytest.mark.parametrize(
    "returned, text",
    [
        ({"value": T[:, None]}, "return two things"),
        ((T, T), "return two things"),
        (({"values": T[:, None]}, T > 0), "a SENSOR_ROW has no field 'values'. Use value, std"),
        (({"value": T}, T > 0), "value has the shape (3,), not (n, k) with k <= 4"),
        (({"std": np.ones((3, 5))}, T > 0), "std has the shape (3, 5), not (n, k) with k <= 4"),
        (({"anchor": T[:, None]}, T > 0), "anchor has the shape (3, 1), not (n,)"),
        (({"value": T[:, None]}, T[:, None] > 0), "usable has the shape (3, 1), not (n,)"),
        (({"value": T[:, None]}, T), "return {'value': numbers, ...}, and usable (n,) bool"),
        (({"std": T[:, None]}, T > 0), "return {'value': numbers, ...}, and usable (n,) bool"),
    ],
)
def test_measured_rows_of_another_form_are_named(returned, text):
    with pytest.raises(InputError, match=re.escape(f"sensor sonar, `measured`: {text}")):
        check_rows(NEW.name, returned, 3)
    with pytest.raises(InputError, match=re.escape(text)):
        replace(NEW, measured=lambda stream: returned).rows(Pressure(T, T))
