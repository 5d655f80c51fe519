# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Wheel odometry in bags: nav_msgs/Odometry and twists, under default and other topic names.

Tools read it like the node.
"""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from test_bag_frames import transforms

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.files import new_bag
from uwb_tdoa_tools.bags.messages import typestore
from uwb_tdoa_tools.bags.topics import STREAMS
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
            of = STREAMS["velocity"]._replace(message=kind)
            for stamp, message in of.messages(velocity, "base_link", store):
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


@pytest.mark.parametrize("frame", ["camera", "unknown"])
def test_a_twist_is_turned_into_the_body_by_its_frame(flight, tmp_path, frame):
    """The frame is the child of Odometry, and optical: z forward, x right, y down."""
    turn, arm = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.2, 0.1, 0.3])
    path = bag_of(flight, tmp_path, ("/velocity/odometry", ODOMETRY, flight.velocity))
    store, moved = typestore(), tmp_path / "moved"
    with AnyReader([path]) as reader, new_bag(moved, "mcap", False) as writer:
        to = {
            one.topic: writer.add_connection(one.topic, one.msgtype, typestore=store)
            for one in reader.connections
        }
        rows = transforms(store, ("base_link", "camera", arm, turn.as_quat()))
        writer.write(to["/tf_static"], 0, store.serialize_cdr(rows, "tf2_msgs/msg/TFMessage"))
        for connection, stamp, data in reader.messages():
            if connection.topic == "/velocity/odometry":
                message = store.deserialize_cdr(data, ODOMETRY)
                message.header.frame_id, message.child_frame_id = "odom", frame
                linear, angular = message.twist.twist.linear, message.twist.twist.angular
                of_body = np.array([linear.x, linear.y, linear.z]), np.array([0.0, 0.0, angular.z])
                v = turn.inv().apply(of_body[0] + np.cross(of_body[1], arm))
                linear.x, linear.y, linear.z = v
                angular.x, angular.y, angular.z = turn.inv().apply(of_body[1])
                both = np.kron(np.eye(2), turn.as_matrix().T)
                covariance = both @ message.twist.covariance.reshape(6, 6) @ both.T
                message.twist.covariance = covariance.ravel()
                data = store.serialize_cdr(message, ODOMETRY)
            writer.write(to[connection.topic], stamp, data)
    read, recording = read_bag(moved), read_recording(Reading(), moved)
    for velocity in (read.velocity, recording.sensors["velocity"]):
        for column, expected in zip(velocity.columns, flight.velocity.columns):
            same = np.allclose(column, expected, rtol=1e-6, atol=1e-9, equal_nan=True)
            assert same or (frame == "unknown" and len(column) == len(expected))
    for remarks in (read.meta["remarks"], recording.remarks):
        (said,) = (remark for remark in remarks if "velocity/odometry" in remark)
        assert ("taken as that" in said) == (frame == "unknown") and f"frame '{frame}'" in said
    if frame == "unknown":
        assert np.abs(read.velocity.v - flight.velocity.v).max() > 0.1


def test_odometry_that_nothing_reads_is_named(flight, tmp_path):
    path = bag_of(flight, tmp_path, ("/odom", ODOMETRY, flight.velocity))
    assert read_bag(path).velocity is None
    (found,) = recording_rules.odometry_unread(read_recording(Reading(), path))
    assert "/odom" in found.cause and "velocity/odometry:=/odom" in found.remedy


def test_each_topic_of_a_sensor_can_be_named():
    assert {topic for sensor in SENSORS.values() for topic, _ in sensor.topics} <= set(TOPICS)
