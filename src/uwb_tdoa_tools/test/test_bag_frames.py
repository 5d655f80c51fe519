# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Frames in bags: sensors mounted away from the body frame, and the sources of anchors."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import small_flight
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from test_bag import write_topics

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.tag import TagLeverArm
from uwb_tdoa_ekf.frames import ImuMount
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.bags import bag
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.files import new_bag, open_bag
from uwb_tdoa_tools.bags.messages import STREAMS, anchor_transforms, header_of, pose_of, typestore
from uwb_tdoa_tools.checking import recording_rules
from uwb_tdoa_tools.checking.check import processed_streams
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.options import TOPICS
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

# --- frames ---

TURN, ARM, ANTENNA = (
    Rotation.from_euler("ZYX", [90.0, 10.0, 180.0], degrees=True),
    [0.1, 0.0, -0.05],
    [0.0, 0.1, 0.2],
)


@pytest.fixture(scope="module")
def flight():
    return simulate(
        SimulationConfig(seed=3, duration=12.0, imu_rate=200.0, truth_rate=50.0, start_in_air=True)
    )


def transforms(store, *rows):
    types = store.types
    time, made = types["builtin_interfaces/msg/Time"](0, 0), []
    for parent, child, p, q in rows:
        between = types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*map(float, p)),
            types["geometry_msgs/msg/Quaternion"](*map(float, q)),
        )
        header = types["std_msgs/msg/Header"](time, parent)
        made.append(types["geometry_msgs/msg/TransformStamped"](header, child, between))
    return types["tf2_msgs/msg/TFMessage"](made)


def mounted(flight, path, *static, robot=""):
    """Write the bag of a flight with an IMU and an antenna in separate frames.

    static : messages of /tf_static, each a list of rows
    """
    turned = Imu(
        flight.imu.t, TURN.inv().apply(flight.imu.gyro), TURN.inv().apply(flight.imu.accel)
    )
    bag.write_bag(replace(flight, imu=turned), path.with_name("plain.bag"))
    store, frames = typestore(), {"/imu/data": f"{robot}imu_link", "/uwb/tdoa": f"{robot}uwb"}
    with open_bag(path.with_name("plain.bag")) as reader, new_bag(path) as writer:
        to = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store)
            for c in reader.connections
        }
        for rows in static:
            message = store.serialize_cdr(transforms(store, *rows), "tf2_msgs/msg/TFMessage")
            writer.write(to["/tf_static"], 0, message)
        for connection, stamp, data in reader.messages():
            if connection.topic in frames:
                message = store.deserialize_cdr(data, connection.msgtype)
                message.header.frame_id = frames[connection.topic]
                data = store.serialize_cdr(message, connection.msgtype)
            writer.write(to[connection.topic], stamp, data)
    return path


def test_a_recording_that_is_played_again_is_moved_to_the_body_as_the_first_time():
    """The stamps fall by the length of the recording."""
    rng, t = np.random.default_rng(0), np.arange(200) / 100.0
    gyro, accel = rng.standard_normal((2, 200, 3))
    mount = ImuMount(TURN, ARM)
    first = mount.in_body(t, gyro, accel)
    np.testing.assert_array_equal(mount.in_body(t, gyro, accel), first)


@pytest.mark.parametrize("robot", ["", "tag1/"])
def test_sensors_are_taken_to_the_body(flight, tmp_path, robot):
    body, plate = f"{robot}base_link", f"{robot}plate"
    half = [
        (body, plate, [0.0, 0.0, -0.05], [0, 0, 0, 1]),
        (body, f"{robot}uwb", ANTENNA, [0, 0, 0, 1]),
    ]
    # from another broadcaster
    other = [(plate, f"{robot}imu_link", [0.1, 0.0, 0.0], TURN.as_quat())]
    path = mounted(flight, tmp_path / "m.bag", half, other, robot=robot)
    read = bag.read_bag(path)
    of_sensor = (TURN.inv().apply(samples) for samples in (flight.imu.gyro, flight.imu.accel))
    _, accel = ImuMount(TURN, ARM).in_body(flight.imu.t, *of_sensor)
    np.testing.assert_allclose(read.imu.gyro, flight.imu.gyro, atol=1e-9)
    np.testing.assert_allclose(read.imu.accel, accel, atol=1e-9)
    assert read.meta["antenna"] == pytest.approx(ANTENNA)
    assert [
        "(0.100, 0.000, -0.050) m" in read.meta["remarks"][0],
        "(0.000, 0.100, 0.200) m" in read.meta["remarks"][1],
    ] == [True, True]
    checked = read_recording(Reading(), path)
    np.testing.assert_allclose(checked.imu.accel, read.imu.accel, atol=1e-9)

    effects = EffectSet((TagLeverArm(values=dict(zip("xyz", ANTENNA))),))
    expected = run_offline(read, None, Corrector(read.anchors, effects)).odometry
    np.testing.assert_allclose(evaluate(read)[1].odometry.p, expected.p, atol=1e-9)
    given = EffectSet((TagLeverArm(values={"z": 0.01}),))  # overrides the bag
    expected = run_offline(read, None, Corrector(read.anchors, given)).odometry
    np.testing.assert_allclose(evaluate(read, effects=given)[1].odometry.p, expected.p, atol=1e-9)


def test_transforms_in_the_namespace_of_the_robot_are_used(flight, tmp_path):
    place = [("base_link", "imu_link", [0.0, 0.0, 0.0], TURN.as_quat())]
    plain, store = mounted(flight, tmp_path / "m.bag", place), typestore()
    with open_bag(plain) as reader, new_bag(tmp_path / "robot.bag") as writer:
        to = {
            one.topic: writer.add_connection(f"/robot1{one.topic}", one.msgtype, typestore=store)
            for one in reader.connections
        }
        for connection, stamp, data in reader.messages():
            writer.write(to[connection.topic], stamp, data)
    read = bag.read_bag(tmp_path / "robot.bag", namespace="robot1")
    np.testing.assert_allclose(read.imu.gyro, flight.imu.gyro, atol=1e-9)
    checked = read_recording(Reading(namespace="robot1"), tmp_path / "robot.bag")
    np.testing.assert_allclose(checked.imu.gyro, flight.imu.gyro, atol=1e-9)
    assert not any("tf_static: " in sentence for sentence in read.meta.get("unread", ()))


@pytest.mark.parametrize("every", [3, 1])
def test_samples_that_are_not_measured_are_left_out_as_in_the_node(flight, tmp_path, every):
    """A covariance of -1 means that (REP 145); the values are zeros."""
    bag.write_bag(flight, tmp_path / "plain.bag")
    store, path, count = typestore(), tmp_path / "some.bag", 0
    with open_bag(tmp_path / "plain.bag") as reader, new_bag(path) as writer:
        to = {
            one.topic: writer.add_connection(one.topic, one.msgtype, typestore=store)
            for one in reader.connections
        }
        for connection, stamp, data in reader.messages():
            if connection.topic == "/imu/data":
                count += 1
                message = store.deserialize_cdr(data, connection.msgtype)
                if count % every == 0:
                    message.angular_velocity_covariance = np.array([-1.0, *np.zeros(8)])
                    message.angular_velocity.x = 0.0
                data = store.serialize_cdr(message, connection.msgtype)
            writer.write(to[connection.topic], stamp, data)
    read, left = bag.read_bag(path), np.arange(1, count + 1) % every != 0
    said = f"/imu/data: {np.count_nonzero(~left)} messages left out"
    assert any(remark.startswith(said) for remark in read.meta["remarks"])
    checked = read_recording(Reading(), path)
    assert any(remark.startswith(said) for remark in checked.remarks)
    for imu in (read.imu, checked.imu):
        if every == 1:
            assert imu is None
        else:
            np.testing.assert_array_equal(imu.gyro, flight.imu.gyro[left])


def test_a_frame_that_is_not_connected_is_taken_as_the_body_and_said(flight, tmp_path):
    read = bag.read_bag(
        mounted(flight, tmp_path / "m.bag", [("map", "imu_link", ARM, [0, 0, 0, 0])])
    )
    np.testing.assert_allclose(TURN.apply(read.imu.gyro), flight.imu.gyro, atol=1e-9)
    assert [
        "frame 'imu_link'" in read.meta["remarks"][0],
        "frame 'uwb'" in read.meta["remarks"][1],
    ] == [True, True]
    assert "antenna" not in read.meta


def test_check_judges_the_samples_of_the_body(flight, tmp_path):
    place = [
        ("base_link", "imu_link", [0, 0, 0], TURN.as_quat()),
        ("base_link", "uwb", ANTENNA, [0, 0, 0, 1]),
    ]

    def rules(name, *static):
        (tmp_path / name).mkdir()
        recording = read_recording(Reading(), mounted(flight, tmp_path / name / "m.bag", *static))
        return {
            finding.rule
            for finding in (
                *processed_streams(recording).findings(),
                *recording_rules.frames(recording),
            )
        }

    assert rules("placed", place) == {"frame_turned"}
    assert {"imu_turned", "frame_unknown"} <= rules("untold")


MARKERS, TRANSFORMS = "visualization_msgs/msg/MarkerArray", "tf2_msgs/msg/TFMessage"
PLACES = [[0.0, 0.0, 1.0], [5.0, 0.0, 2.0], [5.0, 4.0, 1.5], [0.0, 4.0, 2.5], [2.0, 2.0, 3.0]]
ANCHORS = Anchors.from_positions(PLACES, [3, 4, 5, 8, 9], "room")
CUBE, TEXT, ADD, DELETE = 1, 9, 0, 2


def tdoas():
    return (
        "/uwb/tdoa",
        "uwb_tdoa_msgs/msg/Tdoa",
        list(STREAMS["tdoa"].messages(small_flight(0.05).tdoa, "base_link", typestore())),
    )


def marker(number, place, kind=CUBE, action=ADD, frame="hall", name="anchors"):
    store = typestore()
    Vector, Color = store.types["geometry_msgs/msg/Vector3"], store.types["std_msgs/msg/ColorRGBA"]
    Image, Mesh = (
        store.types["sensor_msgs/msg/CompressedImage"],
        store.types["visualization_msgs/msg/MeshFile"],
    )
    time, header = store.types["builtin_interfaces/msg/Duration"](0, 0), header_of(store, 5, frame)
    empty = np.zeros(0, np.uint8)
    return store.types["visualization_msgs/msg/Marker"](
        header,
        name,
        number,
        kind,
        action,
        pose_of(store, place),
        Vector(0.1, 0.1, 0.1),
        Color(1.0, 0.0, 0.0, 1.0),
        time,
        False,
        [],
        [],
        "",
        Image(header, "", empty),
        [],
        "",
        "",
        Mesh("", empty),
        False,
    )


def markers(*parts):
    return [(5, typestore().types[MARKERS](list(parts)))]


def test_frames_of_tf_static_are_anchors(tmp_path):
    write_topics(
        tmp_path / "bag",
        tdoas(),
        ("/tf_static", TRANSFORMS, [anchor_transforms(ANCHORS, 5, typestore())]),
    )
    back = read_bag(tmp_path / "bag")
    np.testing.assert_array_equal(back.anchors.ids, ANCHORS.ids)
    np.testing.assert_array_equal(back.anchors.positions, ANCHORS.positions)
    assert back.anchors.frame == ANCHORS.frame
    assert (
        f"there is no /uwb/anchors: the {len(ANCHORS)} anchors are those of /tf_static."
        in back.meta["remarks"]
    )


def test_markers_of_anchors_are_anchors(tmp_path):
    """The topic also has labels, deleted markers, and markers of other objects."""
    places = list(zip(ANCHORS.ids.tolist(), ANCHORS.positions.tolist()))
    cubes = [marker(number, place) for number, place in places]
    others = [marker(number, (9.0, 9.0, 9.0), TEXT) for number, _ in places]
    others += [
        marker(900, (8.0, 8.0, 8.0), action=DELETE),
        marker(901, (1.0, 1.0, 1.0), name="walls"),
    ]
    write_topics(tmp_path / "bag", tdoas(), ("/show", MARKERS, markers(*cubes, *others)))
    back = read_bag(tmp_path / "bag")
    np.testing.assert_array_equal(back.anchors.ids, ANCHORS.ids)
    np.testing.assert_array_equal(back.anchors.positions, ANCHORS.positions)
    assert back.anchors.frame == "hall" and "/show" in " ".join(back.meta["remarks"])


@pytest.mark.parametrize("name, count", [("robots", len(ANCHORS)), ("anchors", 3)])
def test_what_may_be_something_else_is_none(tmp_path, name, count):
    cubes = [
        marker(k, place, name=name) for k, place in enumerate(ANCHORS.positions.tolist()[:count])
    ]
    write_topics(tmp_path / "bag", tdoas(), ("/show", MARKERS, markers(*cubes)))
    with pytest.raises(InputError, match="no message on /uwb/anchors; give a survey file"):
        read_bag(tmp_path / "bag")


# --- odometry of wheels, under default and other names ---

VELOCITY, ODOMETRY = SENSORS["velocity"], "nav_msgs/msg/Odometry"
RENAMED = {"velocity/odometry": "/odom"}


@pytest.fixture(scope="module")
def driven():
    return simulate(SimulationConfig.of("rover", duration=12.0))


def halves(stream):
    return [type(stream)(*(column[k::2] for column in stream.columns)) for k in range(2)]


def bag_of(driven, folder, *topics):
    """Write a bag of a flight with velocities on other topics, (topic, type, Velocity)."""
    store = typestore()
    write_bag(driven.without("velocity"), folder / "rest")
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
    driven, tmp_path, names, renamed
):
    parts = halves(driven.velocity) if len(names) > 1 else [driven.velocity]
    path = bag_of(
        driven, tmp_path, *((topic, kind, part) for (topic, kind), part in zip(names, parts))
    )
    for column, expected in zip(
        read_bag(path, topics=renamed).velocity.columns, driven.velocity.columns
    ):
        # messages hold variances, flights hold standard deviations
        np.testing.assert_allclose(column, expected, rtol=1e-15)
    recording = read_recording(Reading(topics=renamed), path)
    np.testing.assert_array_equal(recording.sensors["velocity"].v, driven.velocity.v)
    assert not list(recording_rules.odometry_unread(recording))


@pytest.mark.parametrize("frame", ["camera", "unknown"])
def test_a_twist_is_turned_into_the_body_by_its_frame(driven, tmp_path, frame):
    """The frame is the child of Odometry, and optical: z forward, x right, y down."""
    turn, arm = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.2, 0.1, 0.3])
    path = bag_of(driven, tmp_path, ("/velocity/odometry", ODOMETRY, driven.velocity))
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
        for column, expected in zip(velocity.columns, driven.velocity.columns):
            same = np.allclose(column, expected, rtol=1e-6, atol=1e-9, equal_nan=True)
            assert same or (frame == "unknown" and len(column) == len(expected))
    for remarks in (read.meta["remarks"], recording.remarks):
        (said,) = (remark for remark in remarks if "velocity/odometry" in remark)
        assert ("taken as that" in said) == (frame == "unknown") and f"frame '{frame}'" in said
    if frame == "unknown":
        assert np.abs(read.velocity.v - driven.velocity.v).max() > 0.1


def test_odometry_that_nothing_reads_is_named(driven, tmp_path):
    path = bag_of(driven, tmp_path, ("/odom", ODOMETRY, driven.velocity))
    assert read_bag(path).velocity is None
    (found,) = recording_rules.odometry_unread(read_recording(Reading(), path))
    assert "/odom" in found.cause and "velocity/odometry:=/odom" in found.remedy


def test_each_topic_of_a_sensor_can_be_named():
    assert {topic for sensor in SENSORS.values() for topic, _ in sensor.topics} <= set(TOPICS)
