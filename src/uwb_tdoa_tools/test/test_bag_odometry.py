# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Wheel odometry in bags: nav_msgs/Odometry and twists, under default and other topic names.

Tools read it like the node.
"""

from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.files import new_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.bags.messages import sensor_messages
from uwb_tdoa_tools.checking import recording_rules
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.options import TOPICS
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

VELOCITY, ODOMETRY = SENSORS["velocity"], "nav_msgs/msg/Odometry"
RENAMED = {"velocity/odometry": "/odom"}


@pytest.fixture(scope="module")
def flight():
    return simulate(SimulationConfig.of("rover", duration=12.0))


def halves(stream):
    return [type(stream)(*(column[k::2] for column in stream.columns)) for k in range(2)]


def bag_of(flight, folder, *topics):
    """Write a bag of the flight with velocities on other topics, (topic, type, Velocity)."""
    store = typestore()
    write_bag(flight.without("velocity"), folder / "rest")
    with AnyReader([folder / "rest"]) as reader, new_bag(folder / "bag", "mcap", False) as writer:
        copies = {}
        for one in reader.connections:
            copies[one.topic] = writer.add_connection(one.topic, one.msgtype, typestore=store)
        for connection, stamp, data in reader.messages():
            writer.write(copies[connection.topic], stamp, data)
        for topic, kind, velocity in topics:
            connection = writer.add_connection(topic, kind, typestore=store)
            for stamp, message in sensor_messages(replace(VELOCITY, message=kind), velocity, store):
                writer.write(connection, stamp, store.serialize_cdr(message, kind))
    return folder / "bag"


@pytest.mark.parametrize(
    ("names", "renamed"),
    [
        ([("/velocity", VELOCITY.message)], {}),
        ([("/velocity/odometry", ODOMETRY)], {}),
        ([("/odom", ODOMETRY)], RENAMED),
        ([("/velocity", VELOCITY.message), ("/velocity/odometry", ODOMETRY)], {}),
    ],
)
def test_velocities_are_the_same_on_each_topic_that_the_node_hears(
    flight, tmp_path, names, renamed
):
    parts = halves(flight.velocity) if len(names) > 1 else [flight.velocity]
    path = bag_of(
        flight, tmp_path, *((topic, kind, part) for (topic, kind), part in zip(names, parts))
    )
    for column, expected in zip(
        read_bag(path, topics=renamed).velocity.columns, flight.velocity.columns
    ):
        # messages hold variances, flights hold standard deviations
        np.testing.assert_allclose(column, expected, rtol=1e-15)
    recording = read_recording(Reading(topics=renamed), path)
    np.testing.assert_array_equal(recording.sensors["velocity"].v, flight.velocity.v)
    assert not list(recording_rules.odometry_unread(recording))


def test_odometry_that_nothing_reads_is_named(flight, tmp_path):
    path = bag_of(flight, tmp_path, ("/odom", ODOMETRY, flight.velocity))
    assert read_bag(path).velocity is None
    (found,) = recording_rules.odometry_unread(read_recording(Reading(), path))
    assert "/odom" in found.cause and "velocity/odometry:=/odom" in found.remedy


def test_each_topic_of_a_sensor_can_be_named():
    assert {topic for sensor in SENSORS.values() for topic, _ in sensor.topics} <= set(TOPICS)
