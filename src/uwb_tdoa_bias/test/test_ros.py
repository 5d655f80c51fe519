import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from geometry_msgs.msg import Quaternion  # noqa: E402
from rclpy.qos import QoSCompatibility, QoSPresetProfiles, QoSProfile, qos_check_compatible  # noqa: E402
from uwb_tdoa_bias.foundation import ros  # noqa: E402

NANOSECONDS = st.integers(0, 10**9 - 1)
MONTH = 30 * 86400


@given(st.integers(0, 2**31 - 1 - 2 * MONTH), st.lists(st.tuples(st.integers(-MONTH, MONTH), NANOSECONDS), min_size=1))
def test_stamps_survive_to_the_nanosecond(first, others):
    epoch = ros.Epoch()
    epoch.seconds(ros.Time(sec=first, nanosec=999_999_999))
    for second, nanosecond in others:
        if first + second >= 0:
            stamp = ros.Time(sec=first + second, nanosec=nanosecond)
            assert epoch.stamp(epoch.seconds(stamp)) == stamp


@given(st.integers(0, 2**31 - 10), st.lists(st.tuples(st.integers(0, 9), NANOSECONDS), min_size=2))
def test_seconds_do_not_depend_on_the_epoch(first, stamps):
    now, long_ago = ros.Epoch(), ros.Epoch()
    a = [now.seconds(ros.Time(sec=first + second, nanosec=nanosecond)) for second, nanosecond in stamps]
    b = [long_ago.seconds(ros.Time(sec=second, nanosec=nanosecond)) for second, nanosecond in stamps]
    assert a == b


def test_an_orientation_of_zeros_is_not_known():
    assert ros.orientation_of(Quaternion(x=0.1, y=0.2, z=0.3, w=0.4)) == (0.1, 0.2, 0.3, 0.4)
    assert ros.orientation_of(Quaternion()) == (0.0, 0.0, 0.0, 1.0)  # the default of ROS is the identity
    assert all(map(math.isnan, ros.orientation_of(Quaternion(w=0.0))))


def test_anchors_survive_the_message():
    anchors = Anchors([7, 3], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0.6, 0.8], [np.nan] * 4], frame="hall")
    message = ros.anchors_to_message(anchors)
    unknown = message.anchors[1].pose.orientation
    assert (unknown.x, unknown.y, unknown.z, unknown.w) == (0.0, 0.0, 0.0, 0.0)
    assert ros.same_anchors(Anchors.from_message(message), anchors)


def test_a_message_without_a_frame_is_in_the_map():
    message = ros.anchors_to_message(Anchors.from_positions(np.eye(3)))
    message.header.frame_id = ""
    assert Anchors.from_message(message).frame == "map"


def test_same_anchors_notices_every_difference():
    anchors = Anchors([7, 3], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0.6, 0.8], [np.nan] * 4], frame="hall")
    ids, positions, orientations = anchors.ids, anchors.positions, anchors.orientations
    for other in (
        Anchors([7, 4], positions, orientations, "hall"),
        Anchors(ids, positions + [0, 0, 1e-6], orientations, "hall"),
        Anchors(ids, positions, orientations[::-1], "hall"),
        Anchors(ids, positions, orientations, "map"),
        Anchors(ids[:1], positions[:1], orientations[:1], "hall"),
    ):
        assert not ros.same_anchors(anchors, other)


def test_bad_anchors_are_refused():
    message = ros.anchors_to_message(Anchors.from_positions(np.eye(3)))
    message.anchors[1].id = 0
    with pytest.raises(InputError, match="id 0 is given twice"):
        Anchors.from_message(message)
    message.anchors.clear()
    with pytest.raises(InputError, match="empty"):
        Anchors.from_message(message)


def test_stream_subscriptions_match_every_usual_publisher():
    usual = [QoSPresetProfiles.SENSOR_DATA.value, QoSPresetProfiles.SYSTEM_DEFAULT.value, QoSProfile(depth=10)]
    for publisher in [*usual, ros.STREAM_QOS]:
        assert qos_check_compatible(publisher, ros.STREAM_QOS)[0] != QoSCompatibility.ERROR
    assert ros.STREAM_QOS.reliability == ros.ReliabilityPolicy.BEST_EFFORT


def test_anchors_need_a_publisher_that_keeps_them():
    assert qos_check_compatible(ros.ANCHORS_QOS, ros.ANCHORS_QOS)[0] != QoSCompatibility.ERROR
    assert qos_check_compatible(QoSProfile(depth=1), ros.ANCHORS_QOS)[0] == QoSCompatibility.ERROR
