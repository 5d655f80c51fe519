"""Sensors in frames of their own: what a bag says of them, and what becomes of their samples."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.tag_lever_arm import TagLeverArm
from uwb_tdoa_bias.foundation.flight import Imu
from uwb_tdoa_ekf.imu_mount import ImuMount
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.bags import bag
from uwb_tdoa_tools.bags.files import messages, new_bag, open_bag
from uwb_tdoa_tools.bags.message_types import typestore
from uwb_tdoa_tools.checking import recording_rules
from uwb_tdoa_tools.checking.check import processed_streams
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

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
    """The bag of a flight whose IMU and antenna are in frames of their own. static : messages of
    /tf_static, rows each.
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
        for connection, stamp, data in messages(path, reader, reader.connections):
            if connection.topic in frames:
                message = store.deserialize_cdr(data, connection.msgtype)
                message.header.frame_id = frames[connection.topic]
                data = store.serialize_cdr(message, connection.msgtype)
            writer.write(to[connection.topic], stamp, data)
    return path


@pytest.mark.parametrize("robot", ["", "tag1/"])
def test_sensors_are_taken_to_the_body(flight, tmp_path, robot):
    body, plate = f"{robot}base_link", f"{robot}plate"
    half = [
        (body, plate, [0.0, 0.0, -0.05], [0, 0, 0, 1]),
        (body, f"{robot}uwb", ANTENNA, [0, 0, 0, 1]),
    ]
    other = [
        (plate, f"{robot}imu_link", [0.1, 0.0, 0.0], TURN.as_quat())
    ]  # from another broadcaster
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
    given = EffectSet((TagLeverArm(values={"z": 0.01}),))  # counts more than the bag
    expected = run_offline(read, None, Corrector(read.anchors, given)).odometry
    np.testing.assert_allclose(evaluate(read, effects=given)[1].odometry.p, expected.p, atol=1e-9)


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
