# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import dataclasses
import os
from pathlib import Path
import tempfile

from hypothesis import assume, given, settings, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from recordings import ANCHORS, differences, small_flight
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader, Writer

from uwb_tdoa_bias.common.anchors import Anchors, survey_fault
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import SENSORS, Height, Pressure, Velocity
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag
from uwb_tdoa_tools.bags.files import new_bag, open_bag
from uwb_tdoa_tools.bags.messages import STREAMS, of_sensor, typestore
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.readers.streams import LARGEST_NUMBER

BOTH = pytest.mark.parametrize("storage", ["mcap", "sqlite3"])


def content(path):
    """Return all messages of a bag, by topic."""
    with AnyReader([path]) as reader:
        found = {}
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(data, connection.msgtype))
            )
        return found


def test_a_sensor_may_have_a_quaternion_in_its_messages():
    q = np.linspace(-1.0, 1.0, 12).reshape(3, 4)
    compass = dataclasses.replace(
        SENSORS["pressure"],
        message="sensor_msgs/msg/Imu",
        fields={"orientation": 4, "orientation_covariance": 9, "angular_velocity": 3},
        content=lambda _: {"orientation": q, "orientation_covariance": np.full((3, 9), 0.5)},
    )
    stream, kind = Pressure(np.arange(3.0), np.zeros(3)), of_sensor(compass)
    for k, (stamp, message) in enumerate(kind.messages(stream, "base_link", typestore())):
        assert kind.row(message) == (stamp, *q[k], *[0.5] * 9, 0.0, 0.0, 0.0)


@BOTH
def test_round_trip(tmp_path, storage):
    flight = small_flight(0.2)
    counts = write_bag(flight, tmp_path / "flight", storage)
    assert counts == {
        "/imu/data": 200,
        "/uwb/tdoa": 100,
        "/ground_truth/pose": 50,
        "/uwb/anchors": 1,
        "/tf_static": 1,
    }
    back = read_bag(tmp_path / "flight")
    assert differences(flight, back) == []
    assert (
        back.name == "small" and back.meta["protocol"] == "tdoa3" and "reordered" not in back.meta
    )
    (file,) = (tmp_path / "flight").glob("flight.*")  # the data file alone is enough
    assert differences(flight, read_bag(file)) == []


@BOTH
def test_a_file_that_was_read_is_closed(tmp_path, storage):
    """A process can open at most 1024 files, and there may be more bags."""
    write_bag(small_flight(0.1), tmp_path / "flight", storage)
    (file,) = (tmp_path / "flight").glob("flight.*")

    def opened():
        return [
            name
            for name in map(os.path.realpath, Path("/proc/self/fd").iterdir())
            if name == str(file)
        ]

    for path in (tmp_path / "flight", file):
        read_bag(path)
        with open_bag(path) as outer, open_bag(path) as inner:
            assert len(list(outer.messages())) == len(list(inner.messages()))
        assert opened() == []


@st.composite
def flights(draw):
    def stamps(smallest):
        ticks = draw(st.lists(st.integers(0, 10**12), min_size=smallest, max_size=5))
        return np.sort(np.array(ticks, dtype=np.int64)) / 1e6

    def values(*shape):
        return draw(arrays(float, shape, elements=st.floats(-LARGEST_NUMBER, LARGEST_NUMBER)))

    ids = draw(st.lists(st.integers(0, 65535), min_size=1, max_size=4, unique=True))
    unit = st.sampled_from([[0.0, 0.0, 0.0, 1.0], [0.6, 0.0, -0.8, 0.0], [np.nan] * 4])
    n = len(ids)
    positions = draw(arrays(float, (n, 3), elements=st.floats(-100.0, 100.0)))
    anchors = Anchors(ids, positions, draw(st.lists(unit, min_size=n, max_size=n)))
    assume(not survey_fault(anchors))  # or the bag is refused
    t = stamps(1)
    a, variance = (
        draw(arrays(np.int64, len(t), elements=st.sampled_from(ids))),
        np.abs(values(len(t))),
    )
    tdoas = Tdoas(t, a, np.full(len(t), 65535), values(len(t)), variance)
    t = stamps(1)
    imu = draw(st.sampled_from([None, Imu(t, values(len(t), 3), values(len(t), 3))]))
    t = stamps(1)
    q = np.array(draw(st.lists(unit, min_size=len(t), max_size=len(t))))
    truth = draw(st.sampled_from([None, Truth(t, values(len(t), 3), q)]))
    name = draw(
        st.text(st.characters(codec="utf-8", exclude_characters="/\0\n\r"), min_size=1, max_size=5)
    )
    t, ranges = stamps(1), st.sampled_from([0.0, 1.25, 1000.0, np.inf, np.nan])
    height = draw(st.sampled_from([None, Height(t, draw(arrays(float, len(t), elements=ranges)))]))
    t = stamps(1)
    pressure = draw(st.sampled_from([None, Pressure(t, values(len(t)))]))
    t = stamps(1)
    std = draw(arrays(float, (len(t), 3), elements=st.sampled_from([0.5, 2.0, np.inf])))
    turns = draw(st.sampled_from([(), (values(len(t)), np.full(len(t), 0.5))]))
    velocity = draw(st.sampled_from([None, Velocity(t, values(len(t), 3), std, *turns)]))
    sensors = dict(height=height, pressure=pressure, velocity=velocity)
    return Flight(name, anchors, tdoas, imu, truth, **sensors)


@settings(deadline=None, max_examples=15)
@given(flight=flights(), storage=st.sampled_from(["mcap", "sqlite3"]))
def test_any_flight_comes_back_exactly(flight, storage):
    with tempfile.TemporaryDirectory() as folder:
        write_bag(flight, Path(folder) / "flight", storage)
        back = read_bag(Path(folder) / "flight")
    assert differences(flight, back) == []
    assert back.name == (flight.name if flight.name not in (".", "..") else "flight")


def test_what_the_messages_say(tmp_path):
    flight = small_flight(0.05)
    write_bag(flight, tmp_path / "flight")
    messages = content(tmp_path / "flight")
    stamp, imu = messages["/imu/data"][3]
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec) == (
        10,
        3_000_000,
    ) and stamp == 10_003_000_000
    assert imu.header.frame_id == "base_link"
    assert imu.orientation_covariance.tolist() == [-1] + [0] * 8
    assert (
        not imu.angular_velocity_covariance.any() and not imu.linear_acceleration_covariance.any()
    )
    ((stamp, array),) = messages["/uwb/anchors"]
    assert stamp == 10_000_000_000 and array.header.frame_id == "map"
    unknown = array.anchors[2].pose.orientation
    assert (unknown.x, unknown.y, unknown.z, unknown.w) == (0, 0, 0, 0)
    ((_, tf),) = messages["/tf_static"]
    assert [transform.child_frame_id for transform in tf.transforms] == [
        "anchor_0",
        "anchor_1",
        "anchor_5",
    ]
    assert {transform.header.frame_id for transform in tf.transforms} == {"map"}
    assert (
        tf.transforms[2].transform.rotation.w == 1
        and tf.transforms[1].transform.translation.z == 3.0
    )
    pose = messages["/ground_truth/pose"][0][1]
    assert pose.header.frame_id == "map" and pose.pose.orientation.w == 0


def test_stamps_never_fall_and_latched_topics_come_first(tmp_path):
    write_bag(small_flight(0.2), tmp_path / "flight")
    with Reader(tmp_path / "flight") as reader:
        order = [(stamp, connection.topic) for connection, stamp, _ in reader.messages()]
    stamps = [stamp for stamp, _ in order]
    assert stamps == sorted(stamps)
    assert {topic for _, topic in order[:2]} == {"/uwb/anchors", "/tf_static"}


@BOTH
def test_qos_and_type_hashes_are_recorded(tmp_path, storage):
    write_bag(small_flight(0.05), tmp_path / "flight", storage)
    store = typestore()
    with Reader(tmp_path / "flight") as reader:
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            latched = connection.topic in ("/uwb/anchors", "/tf_static")
            assert qos.durability == (
                QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
            )
            assert qos.reliability == QosReliability.RELIABLE
            assert connection.digest == store.hash_rihs01(connection.msgtype)
            assert connection.digest.startswith("RIHS01_") and len(connection.digest) == 71


def test_existing_output(tmp_path):
    out = tmp_path / "flight"
    write_bag(small_flight(0.05), out)
    with pytest.raises(InputError, match="exists already"):
        write_bag(small_flight(0.05), out)
    write_bag(small_flight(0.1), out, "sqlite3", force=True)
    assert len(read_bag(out).imu) == 100
    assert [path.name for path in tmp_path.iterdir()] == ["flight"]
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("all of it")
    with pytest.raises(InputError, match="is not a bag, so --force does not replace it"):
        write_bag(small_flight(0.05), precious, force=True)
    assert (precious / "thesis.txt").exists()


def test_failure_half_way_leaves_nothing(tmp_path):
    flight = small_flight(0.1)
    t = flight.truth.t.copy()
    t[-1] = np.nan  # detected when the last stream is serialized
    with pytest.raises(InputError, match="ground_truth/pose: stamp 24 is nan"):
        write_bag(
            dataclasses.replace(flight, truth=Truth(t, flight.truth.p, flight.truth.q)),
            tmp_path / "flight",
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stamp", [-1e-3, 2.0**31, np.inf])
def test_stamps_that_ros_cannot_hold(tmp_path, stamp):
    tdoas = Tdoas(np.array([stamp]), np.array([0]), np.array([1]), np.array([0.5]))
    with pytest.raises(InputError, match="tdoa: stamp 0 is"):
        write_bag(Flight("bad", ANCHORS, tdoas), tmp_path / "flight")
    assert list(tmp_path.iterdir()) == []


def test_unknown_storage_and_empty_flight(tmp_path):
    with pytest.raises(InputError, match="'zip' is not one of mcap, sqlite3"):
        write_bag(small_flight(0.05), tmp_path / "flight", "zip")
    none = np.empty(0)
    with pytest.raises(InputError, match="holds no message"):
        write_bag(Flight("empty", ANCHORS, Tdoas(none, none, none, none)), tmp_path / "flight")


def write_topics(path, *topics):
    """Write a bag of (topic, msgtype, [(stamp ns, message)])."""
    store = typestore()
    with Writer(path, version=9) as writer:
        for topic, msgtype, written in topics:
            connection = writer.add_connection(topic, msgtype, typestore=store)
            for stamp, message in written:
                writer.write(connection, stamp, store.serialize_cdr(message, msgtype))


def test_namespace_other_topics_and_order_of_stamps(tmp_path):
    store = typestore()
    tdoa = small_flight(0.05).tdoa
    late = list(STREAMS["tdoa"].messages(tdoa, "base_link", store))
    # two messages arrive in the wrong order
    late[3], late[4] = ((late[3][0], late[4][1]), (late[4][0], late[3][1]))
    text = store.types["std_msgs/msg/String"]("hello")
    write_topics(
        tmp_path / "bag",
        ("/tag1/uwb/tdoa", "uwb_tdoa_msgs/msg/Tdoa", late),
        ("/chatter", "std_msgs/msg/String", [(5, text)]),
    )
    with pytest.raises(
        InputError, match="no message on /uwb/tdoa; give the namespace it was recorded in: /tag1"
    ):
        read_bag(tmp_path / "bag", anchors=ANCHORS)
    with pytest.raises(InputError, match="no message on /tag1/uwb/anchors; give a survey"):
        read_bag(tmp_path / "bag", namespace="/tag1")
    back = read_bag(tmp_path / "bag", namespace="tag1", anchors=ANCHORS)
    np.testing.assert_array_equal(back.tdoa.t, tdoa.t)
    np.testing.assert_array_equal(back.tdoa.d, tdoa.d)
    assert back.meta["reordered"] == {"uwb/tdoa": 1}
    assert back.imu is None and back.truth is None and back.name == "bag"
    assert back.meta["unread"] == [
        "/chatter: 1 messages of std_msgs/msg/String, which no stream takes"
    ]


@pytest.mark.parametrize(
    "read", [read_bag, read_odometry, lambda path: read_recording(Reading(), path)]
)
def test_the_remedy_for_an_empty_topic_does_not_map_it_to_itself(tmp_path, read):
    text = typestore().types["std_msgs/msg/String"]("hello")
    write_topics(
        tmp_path / "bag",
        ("/uwb/tdoa", "uwb_tdoa_msgs/msg/Tdoa", []),
        ("/odometry", "nav_msgs/msg/Odometry", []),
        ("/chatter", "std_msgs/msg/String", [(5, text)]),
    )
    with pytest.raises(InputError, match="has no message on /") as refused:
        read(tmp_path / "bag")
    assert "--topic" not in str(refused.value)


def test_wrong_type_on_a_topic(tmp_path):
    text = typestore().types["std_msgs/msg/String"]("hello")
    write_topics(tmp_path / "bag", ("/uwb/tdoa", "std_msgs/msg/String", [(5, text)]))
    with pytest.raises(
        InputError, match="/uwb/tdoa is std_msgs/msg/String; uwb_tdoa_msgs/msg/Tdoa is needed"
    ):
        read_bag(tmp_path / "bag", anchors=ANCHORS)


def test_other_version_of_a_type(tmp_path):
    with Writer(tmp_path / "bag", version=9) as writer:
        definition, rihs01 = "uint16 anchor_a", "RIHS01_" + 64 * "0"
        connection = writer.add_connection(
            "/uwb/tdoa", "uwb_tdoa_msgs/msg/Tdoa", msgdef=definition, rihs01=rihs01
        )
        writer.write(connection, 5, b"\0\1\0\0\1\0")
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag.db3"):
        with pytest.raises(InputError, match="another version of uwb_tdoa_msgs/msg/Tdoa"):
            read_bag(path, anchors=ANCHORS)


def odometry_message(stamp, p, q, twist, pose_covariance, twist_covariance):
    types = typestore().types
    header = types["std_msgs/msg/Header"](
        types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), "map"
    )
    point, vector = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Vector3"]
    pose = types["geometry_msgs/msg/Pose"](point(*p), types["geometry_msgs/msg/Quaternion"](*q))
    speed = types["geometry_msgs/msg/Twist"](vector(*twist), vector(0.0, 0.0, 0.0))
    return stamp, types["nav_msgs/msg/Odometry"](
        header,
        "base_link",
        types["geometry_msgs/msg/PoseWithCovariance"](pose, pose_covariance),
        types["geometry_msgs/msg/TwistWithCovariance"](speed, twist_covariance),
    )


def test_odometry(tmp_path):
    covariance = np.arange(36.0)
    half = np.sqrt(0.5)
    messages = [
        odometry_message(
            2_000_000_001, (4.0, 5.0, 6.0), (0, 0, 0, 1), (1.0, 0.0, 0.0), covariance, -covariance
        ),
        odometry_message(
            1_000_000_000,
            (1.0, 2.0, 3.0),
            (0, 0, half, half),
            (1.0, 0.0, 0.0),
            2 * covariance,
            covariance,
        ),
    ]
    write_topics(tmp_path / "bag", ("/odometry", "nav_msgs/msg/Odometry", messages))
    odometry = read_odometry(tmp_path / "bag")
    assert len(odometry) == 2
    np.testing.assert_array_equal(odometry.t, [1.0, 2.000000001])
    np.testing.assert_array_equal(odometry.p, [[1, 2, 3], [4, 5, 6]])
    # rotated from body to world
    np.testing.assert_allclose(odometry.v, [[0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(odometry.q[0], [0, 0, half, half])
    np.testing.assert_array_equal(odometry.covariance[0], 2 * covariance.reshape(6, 6))
    with pytest.raises(InputError, match="no message on /tag1/odometry"):
        read_odometry(tmp_path / "bag", namespace="tag1")


def test_not_a_bag(tmp_path):
    for path in (tmp_path, tmp_path / "flight"):
        with pytest.raises(InputError, match="is not a bag"):
            read_bag(path)


def test_anchors_without_a_frame_are_in_the_map(tmp_path):
    flight = small_flight(0.01)
    write_bag(
        dataclasses.replace(flight, anchors=dataclasses.replace(flight.anchors, frame="")),
        tmp_path / "flight",
    )
    assert read_bag(tmp_path / "flight").anchors.frame == "map"


def test_anchors_of_no_use_are_told_with_the_bag(tmp_path):
    store = typestore()
    with new_bag(tmp_path / "bad") as writer:
        tdoa = writer.add_connection("/uwb/tdoa", "uwb_tdoa_msgs/msg/Tdoa", typestore=store)
        one = Tdoas(np.ones(1), np.zeros(1, int), np.ones(1, int), np.ones(1))
        ((stamp, message),) = STREAMS["tdoa"].messages(one, "base_link", store)
        writer.write(tdoa, stamp, store.serialize_cdr(message, tdoa.msgtype))
        anchors = writer.add_connection(
            "/uwb/anchors", "uwb_tdoa_msgs/msg/AnchorArray", typestore=store
        )
        empty = store.types["uwb_tdoa_msgs/msg/AnchorArray"](message.header, [])
        writer.write(anchors, stamp, store.serialize_cdr(empty, anchors.msgtype))
    with pytest.raises(InputError, match=r"bad: /uwb/anchors: anchors: the list is empty"):
        read_bag(tmp_path / "bad")
