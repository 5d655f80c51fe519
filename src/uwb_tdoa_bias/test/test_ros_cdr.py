# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
from copy import deepcopy
from functools import reduce
from itertools import product
import struct
import time

import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from geometry_msgs.msg import Point, TransformStamped, TwistStamped, TwistWithCovarianceStamped
from hypothesis import given, strategies as st
from nav_msgs.msg import Odometry, Path
import numpy as np
import rclpy
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import FluidPressure, Imu, Range
from tf2_msgs.msg import TFMessage

from uwb_tdoa_bias.ros import cdr
from uwb_tdoa_bias.ros.anchors import read_transforms
from uwb_tdoa_bias.ros.cdr import LONGEST_TEXT, MOST_ELEMENTS, CdrCodec, Unreadable, decode
from uwb_tdoa_msgs.msg import AnchorArray, Calibration, Tdoa, TdoaCorrected, TdoaResidual

# --- encodings ---


POSE = "pose.pose.position", "pose.pose.orientation", "pose.covariance"


def corrected(k, frame="base_link", model="none"):
    message = TdoaCorrected(
        anchor_a=k, anchor_b=k + 1, raw=0.5 * k, bias=0.1, bias_std=0.2, corrected=-k / 3, status=2
    )
    message.model, message.header.frame_id = model, frame
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000 + k, 999_999_999 - k
    return message


def put(message, path, values):
    """Set a number, or an array of numbers, of a message."""
    *above, name = path.split(".")
    holder = reduce(getattr, above, message)
    before = getattr(holder, name)
    if isinstance(before, bytes):  # octet: bytes in Python
        setattr(holder, name, bytes([int(values[0])]))
    elif isinstance(before, np.ndarray):
        setattr(holder, name, np.asarray(values, dtype=before.dtype))
    else:
        setattr(holder, name, type(before)(values[0]))


def test_the_definition_fits_the_types_of_our_topics():
    """The middleware lays messages out as the definition says."""
    for kind, *fields in (
        (Imu, "angular_velocity", "linear_acceleration_covariance"),
        (Tdoa, "distance_difference"),
        (TdoaCorrected, "raw"),
        (TdoaResidual, "innovation", "verdict"),
        (Odometry, *POSE, "twist.covariance"),
        (Range, "range", "max_range"),
        (FluidPressure, "fluid_pressure"),
        (TwistWithCovarianceStamped, "twist.twist.linear", "twist.covariance"),
        (Path,),
    ):
        message = kind()
        message.header.frame_id = "a frame"
        if kind is Odometry:
            message.child_frame_id = "a frame"
        for k, (leaf, code, count) in enumerate(cdr._leaves(kind)[0]):
            if code != cdr.TEXT:
                put(message, leaf, (np.arange(count) + k % 100).astype(code))
        data = serialize_message(message)
        for of_twist in (False, True):
            codec = CdrCodec(kind, *fields, of_twist=of_twist)
            ((frame, rows, _),) = codec.read([data])
            assert frame == "a frame"
            np.testing.assert_array_equal(rows.astype(codec.dtype), codec._convert(data)[1])


def test_messages_are_read_in_order_in_runs_of_one_frame():
    frames = ["tag", "tag", "gat", "longer", "longer", ""]
    messages = [corrected(k, frame, model="x" * (k % 2)) for k, frame in enumerate(frames)]
    codec = CdrCodec(TdoaCorrected, "corrected", "anchor_b", "status")
    parts = codec.read([serialize_message(message) for message in messages])
    assert [frame for frame, rows, _ in parts for _ in rows] == frames
    assert [k for *_, some in parts for k in range(6)[some]] == list(range(6))
    names = ["sec", "nanosec", "corrected", "anchor_b", "status"]
    assert [row for _, rows, _ in parts for row in rows[names].tolist()] == [
        (m.header.stamp.sec, m.header.stamp.nanosec, m.corrected, m.anchor_b, 2) for m in messages
    ]


def test_the_frame_of_a_twist_is_that_of_the_child():
    message = Odometry(child_frame_id="camera")
    message.header.frame_id = "odom"
    for of_twist, frame in ((False, "odom"), (True, "camera")):
        codec = CdrCodec(Odometry, "twist.covariance", of_twist=of_twist)
        assert codec.read([serialize_message(message)])[0][0] == frame


def test_vectors_and_arrays_are_columns():
    message = Odometry(child_frame_id="body")
    message.pose.pose.position.y, message.pose.pose.orientation.x = 2.0, 0.5
    message.pose.covariance = np.arange(36.0)
    ((frame, rows, _),) = CdrCodec(Odometry, *POSE).read([serialize_message(message)])
    assert rows["pose.pose.position"].tolist() == [[0.0, 2.0, 0.0]]
    assert rows["pose.pose.orientation"].tolist() == [[0.5, 0.0, 0.0, 1.0]]
    assert rows["pose.covariance"].tolist() == [list(range(36))]


def test_what_is_written_is_what_an_object_would_be():
    # The order differs from the definition.
    codec = CdrCodec(TdoaCorrected, "corrected", "anchor_b", "anchor_a", "raw")
    template = codec.template(corrected(7, model="effects"))
    wanted = [corrected(k, model="effects") for k in (7, 8, 300)]
    rows = template.rows(3)
    for name in ("anchor_a", "anchor_b", "raw", "corrected"):
        rows[name] = [getattr(message, name) for message in wanted]
    rows["sec"], rows["nanosec"] = zip(
        *((m.header.stamp.sec, m.header.stamp.nanosec) for m in wanted)
    )
    for made, message in zip(template.messages(rows), wanted):
        assert deserialize_message(made, TdoaCorrected) == message


def tdoa_bytes(order="<", options=0, frame=b"tag", variance=True, more=b""):
    """Serialize a Tdoa by hand: 1 s, 2 ns, anchors 3 and 4, 0.5 m, 0.25 m^2."""
    kind = b"\0\1" if order == "<" else b"\0\0"
    body = struct.pack(f"{order}iII", 1, 2, len(frame) + 1) + frame + b"\0"
    body += b"\0" * (-len(body) % 2) + struct.pack(f"{order}HH", 3, 4)
    body += (
        b"\0" * (-len(body) % 8)
        + struct.pack(f"{order}d", 0.5)
        + (struct.pack(f"{order}d", 0.25) if variance else b"")
    )
    return kind + bytes([0, options]) + body + more


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("options", [0, 1, 3])
@pytest.mark.parametrize("more", [b"", b"\0\0\0"])
def test_every_encoding_that_means_something_is_read(order, options, more):
    codec = CdrCodec(Tdoa, "anchor_a", "anchor_b", "distance_difference", "variance")
    ((frame, rows, some),) = codec.read([tdoa_bytes(order, options, more=more)])
    assert (frame, some) == ("tag", slice(0, 1))
    assert rows[list(codec.dtype.names)].tolist() == [(1, 2, 3, 4, 0.5, 0.25)]


BAD = {
    "8 too few for uwb_tdoa_msgs/Tdoa: cut off, or of another version of the type": tdoa_bytes(
        variance=False
    ),
    "8 too many for uwb_tdoa_msgs/Tdoa: of another version of the type": tdoa_bytes(more=bytes(8)),
    "header.frame_id is no UTF-8": tdoa_bytes(frame=b"t\xff"),
    "header.frame_id does not end where it says": tdoa_bytes(frame=b"t\0g"),
    "header.frame_id would be 4294967295 bytes long": tdoa_bytes()[:12]
    + b"\xff" * 4
    + tdoa_bytes()[16:],
    "header.frame_id would be 5001 bytes long": tdoa_bytes(frame=b"x" * 5000),
    "it ends after 14 bytes, before header.frame_id": tdoa_bytes()[:14],
    "not plain CDR": b"\0\7\0\0" + tdoa_bytes()[4:],
    "cannot be read as|bytes are|it has|not plain CDR": b"",
    "another version|cannot be read as uwb_tdoa_msgs/Tdoa": tdoa_bytes(">", variance=False),
    "cannot be read as uwb_tdoa_msgs/Tdoa|another version": tdoa_bytes(">", more=bytes(8)),
    "another version|cannot be read as": tdoa_bytes("<", 1, variance=False),
    "no UTF-8": tdoa_bytes(">", frame=b"t\xff"),
}


@pytest.mark.parametrize("reason", BAD)
def test_what_cannot_be_read_is_left_out_and_said(reason):
    codec, refused = CdrCodec(Tdoa, "anchor_a"), []
    parts = codec.read(
        [tdoa_bytes(), BAD[reason], tdoa_bytes(">"), BAD[reason], tdoa_bytes()], refused.append
    )
    assert [some.start for *_, some in parts] == [0, 2, 4] and [
        rows["anchor_a"].tolist() for _, rows, _ in parts
    ] == [[3]] * 3
    assert len(refused) == 2
    with pytest.raises(Unreadable, match=reason):
        codec.read([BAD[reason]])


def test_empty_lists_of_numbers_are_read_as_they_are_published():
    """The middleware serializes them to more bytes than it sends."""
    rclpy.init()
    node, sent = rclpy.create_node("sender"), []
    try:
        qos = QoSProfile(depth=100)
        publisher = node.create_publisher(Calibration, "calibration", qos)
        node.create_subscription(Calibration, "calibration", sent.append, qos, raw=True)
        frames = "m", "map", "frame"
        messages = [
            Calibration(
                ids=range(n), shifts=[0.5] * some, delays=[0.5] * n, covariance=[0.5] * more
            )
            for n, some, more in product(range(4), (0, 3), (0, 1))
        ]
        for message, frame in product(messages, frames):
            message = deepcopy(message)
            message.header.frame_id = frame
            before = len(sent)
            until = time.monotonic() + 60.0
            while len(sent) == before:
                assert time.monotonic() < until
                if publisher.get_subscription_count() and len(sent) == before:
                    publisher.publish(message)
                rclpy.spin_once(node, timeout_sec=0.5)
            assert decode(sent[-1], Calibration) == message
            for end in range(len(sent[-1])):
                with pytest.raises(Unreadable):
                    decode(sent[-1][:end], Calibration)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_lists_are_bounded_before_anything_is_allocated():
    array = AnchorArray()
    array.header.frame_id = "map"
    data = serialize_message(array)
    assert decode(data, AnchorArray) == array
    for count, reason in (
        (MOST_ELEMENTS + 1, f"at most {MOST_ELEMENTS}"),
        (2**32 - 1, "at most"),
        (1000, "1000 elements, in"),
    ):
        with pytest.raises(Unreadable, match=reason):
            decode(data[:-4] + struct.pack("<I", count), AnchorArray)
    with pytest.raises(Unreadable, match="bytes are too many"):
        decode(data + bytes(10_000_000), AnchorArray)
    with pytest.raises(Unreadable, match="bytes are too many"):
        decode(tdoa_bytes() + bytes(3 * LONGEST_TEXT), Tdoa)


def test_noise_is_refused_or_read_and_nothing_else():
    rng, refused, read = np.random.default_rng(1), [], 0
    codec = CdrCodec(TdoaCorrected, "corrected", "bias_slope")
    whole = serialize_message(corrected(1))
    for _ in range(300):
        data = bytearray(whole[: rng.integers(len(whole) + 1)] if rng.random() < 0.3 else whole)
        for place in rng.integers(len(data), size=rng.integers(1, 6)) if data else ():
            data[place] ^= 1 << rng.integers(8)
        read += sum(len(rows) for _, rows, _ in codec.read([bytes(data)], refused.append))
    assert read + len(refused) == 300 and read > 50 and len(refused) > 50


@pytest.mark.parametrize("field", ["twist.linear.w", "twst"])
def test_a_field_that_a_type_lacks_is_named(field):
    with pytest.raises(ValueError, match=f"TwistStamped has no field {field}; check its spelling"):
        CdrCodec(TwistStamped, field)


def test_a_type_without_a_header_is_named():
    with pytest.raises(ValueError, match="Point has no field header.stamp.sec"):
        CdrCodec(Point, "x")


# --- transforms ---

NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
NUMBERS = st.floats(allow_nan=False)


def message(transforms):
    """Return a TFMessage of tuples (sec, nanosec, parent, child, q, p)."""
    out = TFMessage()
    for sec, nanosec, parent, child, q, p in transforms:
        one = TransformStamped(child_frame_id=child)
        one.header.stamp.sec, one.header.stamp.nanosec, one.header.frame_id = sec, nanosec, parent
        one.transform.translation.x, one.transform.translation.y, one.transform.translation.z = p
        (
            one.transform.rotation.x,
            one.transform.rotation.y,
            one.transform.rotation.z,
            one.transform.rotation.w,
        ) = q
        out.transforms.append(one)
    return out


TRANSFORM = st.tuples(
    st.integers(-(2**31), 2**31 - 1),
    st.integers(0, 10**9 - 1),
    NAMES,
    NAMES,
    st.tuples(*[NUMBERS] * 4),
    st.tuples(*[NUMBERS] * 3),
)


@given(st.lists(TRANSFORM, max_size=4))
def test_transforms_are_read_as_they_were_written(transforms):
    expected = [
        (*one[:2], *(name.lstrip("/") for name in one[2:4]), *one[4:]) for one in transforms
    ]
    data = serialize_message(message(transforms))
    assert read_transforms(decode(data, TFMessage)) == expected


def test_what_is_no_list_of_transforms_is_refused():
    data = serialize_message(message([(1, 2, "a", "b", (0.0, 0.0, 0.0, 1.0), (1.0, 2.0, 3.0))]))
    for bad, reason in (
        (data[:-8], "too few|cannot be read"),
        (data[:6], "before its list"),
        (b"", "not plain CDR|bytes"),
        (data + bytes(8), "8 too many"),
        (data[:4] + struct.pack("<I", MOST_ELEMENTS + 1) + data[8:], "10001 elements"),
        (data[:4] + struct.pack("<I", 9) + data[8:], "too few|cannot be read"),
        (b"\0\x09" + data[2:], "not plain CDR"),
    ):
        with pytest.raises(Unreadable, match=reason):
            decode(bad, TFMessage)
