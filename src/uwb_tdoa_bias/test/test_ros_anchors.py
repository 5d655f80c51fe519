from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible  # noqa: E402

from uwb_tdoa_bias.foundation.ros_anchors import (
    ANCHORS_QOS,
    ANY_QOS,
    anchors_to_message,
    in_words,
    same_anchors,
)  # noqa: E402


def test_anchors_survive_the_message():
    anchors = Anchors(
        [7, 3], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0.6, 0.8], [np.nan] * 4], frame="hall"
    )
    message = anchors_to_message(anchors)
    unknown = message.anchors[1].pose.orientation
    assert (unknown.x, unknown.y, unknown.z, unknown.w) == (0.0, 0.0, 0.0, 0.0)
    assert same_anchors(Anchors.from_message(message), anchors)


def test_a_message_without_a_frame_is_in_the_map():
    message = anchors_to_message(Anchors.from_positions(np.eye(3)))
    message.header.frame_id = ""
    assert Anchors.from_message(message).frame == "map"


def test_what_has_changed_is_said_in_words():
    before = Anchors.from_positions(np.arange(12.0).reshape(4, 3), ids=[5, 6, 7, 8])
    after = Anchors.from_positions(
        np.vstack([before.positions[1:3], before.positions[3] + 1.0, [1.0, 1.0, 1.0]]),
        ids=[6, 7, 8, 9],
    )
    assert in_words(before, after) == "new: 9; gone: 5; elsewhere: 8; going on with the 2 that stay"
    assert (
        in_words(before, before.at(before.positions + 1.0))
        == "elsewhere: 5, 6, 7, 8; starting over"
    )
    assert (
        in_words(before, replace(after, frame="hall"))
        == "they are in frame 'hall', and were in 'map': starting over"
    )
    many = Anchors.from_positions(np.arange(60.0).reshape(20, 3), ids=np.arange(5, 25))
    assert (
        in_words(before, many)
        == "new: 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, ...; going on with the 4 that stay"
    )


def test_same_anchors_notices_every_difference_but_jitter():
    anchors = Anchors(
        [7, 3], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0.6, 0.8], [np.nan] * 4], frame="hall"
    )
    ids, positions, orientations = anchors.ids, anchors.positions, anchors.orientations
    for other in (
        Anchors([7, 4], positions, orientations, "hall"),
        Anchors(ids, positions + [[0, 0, 0], [0, 0, 0.02]], orientations, "hall"),
        Anchors(ids, positions, orientations[::-1], "hall"),
        Anchors(ids, positions, orientations, "map"),
        Anchors(ids[:1], positions[:1], orientations[:1], "hall"),
    ):
        assert not same_anchors(anchors, other)


def test_bad_anchors_are_refused():
    message = anchors_to_message(Anchors.from_positions(np.eye(3)))
    message.anchors[1].id = 0
    with pytest.raises(InputError, match="id 0 is given twice"):
        Anchors.from_message(message)
    message.anchors.clear()
    with pytest.raises(InputError, match="empty"):
        Anchors.from_message(message)


def test_anchors_need_a_publisher_that_keeps_them():
    assert qos_check_compatible(ANCHORS_QOS, ANCHORS_QOS)[0] != QoSCompatibility.ERROR
    assert qos_check_compatible(QoSProfile(depth=1), ANCHORS_QOS)[0] == QoSCompatibility.ERROR
    assert (
        qos_check_compatible(QoSProfile(depth=1), ANY_QOS)[0] != QoSCompatibility.ERROR
    )  # but takes them when repeated
