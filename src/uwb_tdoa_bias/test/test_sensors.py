# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Properties that every sensor of the registry has. Other tests check each sensor in detail."""

from collections import Counter
from dataclasses import Field, fields
import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight, Tdoas
from uwb_tdoa_bias.common.sensors import (
    LISTED,
    SENSORS,
    STREAM_OF,
    Height,
    Ranges,
    Velocity,
)
from uwb_tdoa_bias.common.sensors.sensor import Stream

N = 5
T = np.arange(N) / 25.0
# Topics that the nodes use for other data.
TAKEN_TOPICS = {
    "imu/data",
    "initialpose",
    "odometry",
    "status",
    "uwb/anchors",
    "uwb/residual",
    "uwb/tdoa",
    "uwb/tdoa_corrected",
}
ROW_WIDTHS = {"value": 4, "std": 4, "anchor": 1}  # the most numbers of fields of a SENSOR_ROW
ANCHORS = Anchors([2, 7], [[0.0, 0.0, 0.0], [6.0, 8.0, 0.0]], [[np.nan] * 4] * 2)


def simulated(sensor):
    """Simulate a sensor on a motion, without noise, and return its Stream."""
    motion = SimpleNamespace(p=np.linspace([1.0, 2.0, 0.5], [2.0, 1.0, 2.0], N), v=np.ones((N, 3)))
    config = SimpleNamespace(anchors=ANCHORS, tag_lever_arm=np.zeros(3))
    for name in SENSORS:
        setattr(config, f"{name}_noise", 0.1)
    turn = Rotation.from_euler("xyz", np.full((N, 3), 0.1))
    room = SimpleNamespace(lower=np.zeros(3))
    columns = sensor.simulated(config, room, motion, turn, lambda *shape: np.zeros((N, *shape)))
    return sensor.stream(T, *columns)


STREAMS = {name: simulated(sensor) for name, sensor in SENSORS.items()} | {
    "height": Height(T, np.linspace(0.5, 2.0, N)),
    "pressure": SENSORS["pressure"].stream(T, np.linspace(98e3, 99e3, N)),
    "velocity": Velocity(
        T, np.ones((N, 3)), np.full((N, 3), 0.5), np.linspace(-1.0, 1.0, N), np.full(N, 0.25)
    ),
    "range": Ranges(T, np.array([7, 2, 7, 2, 7]), np.linspace(1.0, 4.0, N), np.full(N, 0.01)),
}


def of_message(sensor, stream):
    """Return {field: values} of the messages of a stream. Fields without a value are 0."""
    content = sensor.content(stream)
    return {
        name: np.broadcast_to(content.get(name, 0.0), (N, k) if k > 1 else (N,))
        for name, k in sensor.fields.items()
    }


def test_a_flight_has_a_stream_of_each():
    flight = Flight("f", None, Tdoas(T, T, T, T), **STREAMS)
    assert SENSOR_NAMES == tuple(SENSORS)
    assert all(
        getattr(flight, name) is stream and getattr(flight.without(name), name) is None
        for name, stream in STREAMS.items()
    )


def test_names_topics_and_parameters_are_used_once():
    other_fields = {each.name for each in fields(Flight)} - SENSORS.keys()
    names = Counter([*other_fields, *(sensor.name for sensor in LISTED)])
    topics = Counter([*TAKEN_TOPICS, *(topic for of in LISTED for topic, _ in of.topics)])
    parameters = Counter(parameter for sensor in LISTED for parameter in sensor.parameters)
    for counts in (names, topics, parameters):
        assert [name for name, count in counts.items() if count > 1] == []


@pytest.mark.parametrize("name", SENSORS)
def test_a_definition_has_the_form_that_all_code_expects(name):
    sensor = SENSORS[name]
    assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name), "small letters, and _ between words"
    assert all(re.fullmatch(r"\w+/msg/\w+", message) for _, message in sensor.topics)
    unit, words, size = sensor.noise
    assert isinstance(unit, str) and isinstance(words, str) and size > 0.0 and sensor.rate > 0.0
    stream = sensor.stream
    assert next(iter(stream.__annotations__)) == "t", "the first array must be t"
    assert stream.__dataclass_params__.frozen and "__dataclass_fields__" in vars(stream)


@pytest.mark.parametrize("name", SENSORS)
def test_parameters_have_the_form_that_the_filter_expects(name):
    parameters = SENSORS[name].parameters
    assert next(iter(parameters)) == f"use_{name}", "use_<name> is the first parameter"
    for key, made in parameters.items():
        assert isinstance(made, Field) and "text" in made.metadata, f"make {key} with `parameter`"
        if not isinstance(made.default, bool | str):
            low, high, with_low = (made.metadata[part] for part in ("low", "high", "with_low"))
            assert made.default > low or (with_low and made.default == low), key
            assert high is None or made.default <= high, key


@pytest.mark.parametrize("name", SENSORS)
def test_what_is_written_is_read(name):
    sensor, stream = SENSORS[name], STREAMS[name]
    assert (
        sensor.name == name
        and isinstance(stream, sensor.stream)
        and issubclass(sensor.stream, Stream)
    )
    fields = of_message(sensor, stream)
    read = sensor.read(T, fields)
    for one, other in zip(read.columns, stream.columns):
        np.testing.assert_array_equal(
            one, other, err_msg="`columns` reads something else than `content` writes"
        )
    table = np.column_stack(list(fields.values()))  # format of a table of a bag
    for one, other in zip(sensor.read(T, sensor.split(table)).columns, stream.columns):
        np.testing.assert_array_equal(one, other)
    assert all(values.all() for values in sensor.sound(fields).values())


@pytest.mark.parametrize("name", SENSORS)
def test_values_that_effects_change(name):
    stream = STREAMS[name]
    assert stream.values.shape in ((N, 1), (N, 3)), "effects and channels expect 1 or 3 `values`"
    assert len(stream) == N
    assert isinstance(stream.with_values(stream.values), type(stream)), (
        "return `replace(self, ...)`"
    )
    np.testing.assert_allclose(stream.with_values(stream.values + 0.1).values, stream.values + 0.1)
    assert stream.sensed(stream.values).t is stream.t


@pytest.mark.parametrize("name", SENSORS)
def test_what_the_filter_gets(name):
    sensor = SENSORS[name]
    rows, usable = sensor.measured(STREAMS[name])
    assert rows.keys() <= ROW_WIDTHS.keys() and "value" in rows, "fields of a SENSOR_ROW"
    for field, numbers in rows.items():
        width = ROW_WIDTHS[field]
        assert numbers.shape == (N,) if width == 1 else numbers.shape[1:] <= (width,), field
    _, simulated_usable = sensor.measured(simulated(sensor))
    assert usable.shape == (N,) and usable.dtype == bool
    assert simulated_usable.all(), "`measured` refuses what `simulated` returns: units differ"
    assert usable.all() and np.isfinite(rows["value"]).all()
    # NaN is not a measurement, in any column.
    if name != "velocity":
        missing = np.full_like(STREAMS[name].values, np.nan)
        *_, broken = SENSORS[name].measured(STREAMS[name].with_values(missing))
        assert not broken.any(), "`measured` takes NaN for a measurement"


def test_the_yaw_rate_is_a_part_of_the_velocity_stream():
    assert STREAM_OF == {**dict(zip(SENSORS, SENSORS)), "yaw_rate": "velocity"}


# --- velocities and yaw rates ---


def of_twist(linear, rate, variances):
    """Return the Velocity of one message: linear velocity (3,), yaw rate and variances (4,)."""
    covariance = np.zeros((1, 36))
    covariance[0, [0, 7, 14, 35]] = variances
    angular = np.array([[np.nan, 5.0, rate]])  # rates about x and y are ignored
    return SENSORS["velocity"].read(
        T[:1],
        {
            "twist.twist.linear": np.array([linear]),
            "twist.twist.angular": angular,
            "twist.covariance": covariance,
        },
    )


@pytest.mark.parametrize(
    "rate, variances, yaw_rate, yaw_rate_std",
    [
        (0.5, (0.01, 0.01, 1e6, 0.04), 0.5, 0.2),
        (0.5, (0.0, 0.0, 0.0, 0.0), 0.5, 0.0),  # most drivers of wheels
        (0.0, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0),
        (0.5, (0.01, 0.01, 0.01, 0.0), 0.5, 0.0),
        (0.0, (0.01, 0.01, 1e6, 0.0), np.nan, np.inf),  # optical flow: no yaw rate
        (0.5, (0.01, 0.01, 0.01, 1e6), np.nan, np.inf),
        (0.5, (0.01, 0.01, 0.01, -1.0), np.nan, np.inf),
    ],
)
def test_what_a_message_says_of_the_yaw_rate(rate, variances, yaw_rate, yaw_rate_std):
    read = of_twist([1.0, 0.0, 0.0], rate, variances)
    np.testing.assert_array_equal(read.yaw_rate, [yaw_rate])
    np.testing.assert_array_equal(read.yaw_rate_std, [yaw_rate_std])
    rows, usable = SENSORS["velocity"].measured(read)
    assert usable.all() and np.isfinite(rows["value"]).all()
    assert rows["value"][0, 3] == (yaw_rate if np.isfinite(yaw_rate) else 0.0)


@pytest.mark.parametrize(
    "linear, rate, variances, usable",
    [
        ([1.0, 0.0, 0.0], np.nan, (0.01, 0.01, 0.01, 0.01), False),
        ([1.0, np.inf, 0.0], 0.0, (0.01, 0.01, 0.01, 0.01), False),
        ([1.0, 0.0, 0.0], 200.0, (0.01, 0.01, 0.01, 0.01), False),
        ([1.0, 0.0, 0.0], 0.5, (1e6, 1e6, 1e6, 1e6), False),
        ([1.0, 0.0, 0.0], 0.5, (1e6, 1e6, 1e6, 0.01), True),  # a gyroscope in a twist
    ],
)
def test_which_velocities_are_measurements(linear, rate, variances, usable):
    assert SENSORS["velocity"].measured(of_twist(linear, rate, variances))[1].tolist() == [usable]


@pytest.mark.parametrize(
    "rate, variances, names",
    [
        (0.5, (0.0, 0.0, 0.0, 0.0), ("velocity_std", "yaw_rate_std")),
        (0.5, (0.01, 0.01, 0.01, 0.0), ("yaw_rate_std",)),
        (0.0, (0.01, 0.01, 1e6, 0.0), ()),
    ],
)
def test_which_parameters_stand_in_for_deviations(rate, variances, names):
    assert SENSORS["velocity"].assumed(of_twist([1.0, 0.0, 0.0], rate, variances)) == names


def test_a_stream_without_yaw_rates_is_what_it_was():
    old, sensor = Velocity(T, np.ones((N, 3)), np.full((N, 3), 0.5)), SENSORS["velocity"]
    assert np.isnan(old.yaw_rate).all() and np.isinf(old.yaw_rate_std).all()
    written = of_message(sensor, old)
    np.testing.assert_array_equal(written["twist.twist.angular"], 0.0)
    np.testing.assert_array_equal(written["twist.covariance"].reshape(N, 6, 6)[:, 5, 5], 1e6)
    for one, other in zip(sensor.read(T, written).columns, old.columns):
        np.testing.assert_array_equal(one, other)


# --- two-way ranging ---


@pytest.mark.parametrize(
    "d, variance, usable",
    [
        (0.0, 0.0, True),
        (-0.1, 0.0, False),
        (1e4, 0.0, False),
        (1.0, -1.0, False),
        (1.0, np.inf, False),
    ],
)
def test_which_ranges_are_measurements(d, variance, usable):
    one = Ranges(np.zeros(1), np.zeros(1, int), np.array([d]), np.array([variance]))
    assert SENSORS["range"].measured(one)[1].tolist() == [usable]


def found(ranges):
    return [mistake[0] for rule in SENSORS["range"].rules if (mistake := rule(ranges, ANCHORS))]


def test_rules_name_what_is_wrong_with_ranges_and_nothing_else():
    sound = STREAMS["range"]
    assert found(sound) == []
    assert found(Ranges(T, np.array([7, 2, 7, 3, 7]), sound.d, sound.variance)) == ["range_unknown"]
    assert found(sound.with_values(1000.0 * sound.values)) == ["range_unit", "range_invalid"]
    assert found(sound.with_values(sound.values / 299792458.0)) == ["range_unit"]
    assert found(sound.with_values(-sound.values)) == ["range_unit", "range_invalid"]
