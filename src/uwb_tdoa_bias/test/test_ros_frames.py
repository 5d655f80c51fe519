# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import struct

from hypothesis import given, strategies as st
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TransformStamped  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from uwb_tdoa_bias.ros.cdr import MOST_ELEMENTS, Unreadable, decode  # noqa: E402
from uwb_tdoa_bias.ros.frames import read_transforms  # noqa: E402

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
